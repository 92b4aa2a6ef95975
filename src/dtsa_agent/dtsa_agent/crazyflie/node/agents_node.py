"""The same agents on vehicles that fly elsewhere: state from `/cfN/odom`, commands to `/cfN/cmd_velocity_world`.

    python -m dtsa_agent.crazyflie.node.agents_node --ros-args -p agents:=12 -p policy:=lease ...

The node is a `swarm_host` whose vehicles are flown by somebody else. Protocol, estimator and avoider are untouched:
only the motion of the vehicles is not simulated (:mod:`dtsa_agent.crazyflie.node.external_vehicles`).
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from dtsa_msgs.msg import Slot, VelocityWorld
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Empty

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.settings.declaration import Settings, setting
from dtsa_agent.crazyflie.state.conversions import rotate
from dtsa_agent.keys import authenticator
from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.graph.parameters import declare_settings, swarm_wide_node
from dtsa_agent.ros.common.process.loop import Feed, Stop
from dtsa_agent.ros.common.process.node_process import run_node
from dtsa_agent.ros.common.process.priority import take_priority
from dtsa_agent.ros.common.wire.checks import OTHER_SENDER, OnePublisher, Unusable, check_odometry
from dtsa_agent.ros.common.wire.messages import Fields
from dtsa_agent.ros.realtime import RealtimeNode
from dtsa_agent.ros.swarm_host import declare_ids, declare_swarm

from .external_vehicles import ExternalVehicles

LATEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
STALE_S = 0.3  # an agent that does not know where it is gives no commands: the bridge then holds its vehicle
LONGEST_PREDICTION_S = 0.15
STOP_HERE = "/all/stop_here"  # of the ground station: nobody flies on to its goal


class StationNode(RealtimeNode):
    """Agents that begin their slots by the station's clock and whose vehicles are flown elsewhere.

    :param command_hz: rate of the commands, Hz; at most one a slot.
    """

    def __init__(self, node: Node, config: SwarmConfig, *args: Any, command_hz: float, **more: Any) -> None:
        super().__init__(node, config, *args, **more)
        every, swarms = max(1, round(1.0 / command_hz / config.slot_s)), [agent.swarm for agent in self.agents]
        self._vehicles, count = ExternalVehicles(swarms, every, self._command), len(swarms)
        self._heard = np.full(count, -np.inf)  # s, monotonic: when each vehicle's odometry last came
        self._measured = np.zeros((3, count))  # m, where each was by its last odometry
        self._stamp = np.zeros(count)  # s, system clock, of that
        self._inputs: list[Feed] = []
        self._bridges: list[OnePublisher] = []  # who tells where each vehicle is
        self._outputs = []
        self._stop_here = Feed(node, Empty, STOP_HERE, LATEST, intake=self.membership.intake)
        for agent in self.ids:
            space = names.agent_namespace(agent, self._namespace)
            topic = f"{space}/{names.ODOMETRY}"
            self._inputs.append(Feed(node, Odometry, topic, LATEST, intake=self.membership.intake))
            self._bridges.append(OnePublisher())
            self._outputs.append(node.create_publisher(VelocityWorld, f"{space}/cmd_velocity_world", 1))

    @property
    def _blind(self) -> bool:
        """Whether some agent does not know yet where it is."""
        return bool(np.isinf(self._heard).any())

    def _sense(self) -> None:
        if self._stop_here.take() is not None:
            self._vehicles.stop_here()
        for index, feed in enumerate(self._inputs):
            message = feed.take()
            if message is not None:
                with self.membership.intake.guard():
                    self._check(index, message, feed)
                    self._note(index, message)
        # What was measured is as old as its stamp: a vehicle at 1 m/s has moved on by centimetres since.
        age = np.clip(time.time() - self._stamp, 0.0, LONGEST_PREDICTION_S)
        velocity = np.concatenate([agent.swarm.velocity for agent in self.agents], axis=1)
        self._vehicles.place(self._measured + velocity * age)

    def _check(self, index: int, message: Odometry, feed: Feed) -> None:
        """Whether odometry can be that of a vehicle, and of the bridge that has told of it so far.

        :raises Unusable: if it cannot. Without any for a while the vehicle gets no commands, and the bridge holds it.
        """
        check_odometry(message)
        if not self._bridges[index].admits(time.monotonic(), feed.sender):
            raise Unusable(OTHER_SENDER, f"odometry of cf{self.ids[index]} from two publishers")

    def _note(self, index: int, message: Odometry) -> None:
        place, q, speed = message.pose.pose.position, message.pose.pose.orientation, message.twist.twist.linear
        self._measured[:, index] = place.x, place.y, place.z
        self._stamp[index] = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        # The twist of an odometry message is in the body's frame (REP-103).
        self.agents[index].swarm.velocity[:, 0] = rotate((q.x, q.y, q.z, q.w), (speed.x, speed.y, speed.z))
        self._heard[index] = time.monotonic()

    def _command(self, index: int, velocity: NDArray[np.float64]) -> None:
        """Publishes the command to a vehicle, (3, 1), m/s, frame map."""
        if time.monotonic() - self._heard[index] < STALE_S:
            message = VelocityWorld()
            message.vel.x, message.vel.y, message.vel.z = velocity[:, 0].tolist()
            self._outputs[index].publish(message)

    def _prepare(self, message: Fields) -> bool:
        self._sense()
        if message.phase == Slot.PREPARE and self._blind:
            return True
        return super()._prepare(message)

    def _fly(self, index: int) -> None:
        self._vehicles.fly(self.agents[index].slot, index)


@dataclass(frozen=True, slots=True)
class StationNodeSettings(Settings):
    """What the node needs beside what the whole swarm agrees on.

    :raises ConfigError: for values that are not allowed.
    """

    command_hz: float = setting(50.0, "rate of the commands", unit="Hz", minimum=1, maximum=100)
    priority: int = setting(0, "real-time priority; 0: none", minimum=0, maximum=90)


def _body(stop: Stop, supervised: bool) -> None:
    plain = {"start_parameter_services": False, "enable_rosout": False} if supervised else {}
    node, space = swarm_wide_node("crazyflie_agents", plain)
    try:
        config = declare_swarm(node)
        ids = declare_ids(node, config.agents)
        station = StationNodeSettings(**declare_settings(node, StationNodeSettings))
        take_priority(station.priority)
        # One station, one clock: no offsets, and nothing to align.
        more = {"authenticator": authenticator(config), "align": False, "command_hz": station.command_hz}
        agents = StationNode(node, config, ids, space, **more)
        try:
            agents.run(stop)
        finally:
            agents.loop.close()
    finally:
        node.destroy_node()


def main(args: Sequence[str] | None = None) -> int:
    """Runs the node."""
    return run_node("crazyflie_agents", _body, args)


if __name__ == "__main__":
    sys.exit(main())
