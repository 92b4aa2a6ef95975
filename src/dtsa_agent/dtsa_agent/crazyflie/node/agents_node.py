"""The same agents on vehicles that fly elsewhere: state from `/cfN/odom`, commands to `/cfN/cmd_velocity_world`.

    python -m dtsa_agent.crazyflie.node.agents_node --ros-args -p agents:=12 -p policy:=lease ...

The node is a `swarm_host` whose vehicles are flown by somebody else. Protocol, estimator and avoider are untouched:
only the motion of the vehicles is not simulated.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from dtsa_msgs.msg import Slot
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Empty

from dtsa_agent.core import ConfigError, SwarmConfig
from dtsa_agent.core.settings.declaration import Settings, setting
from dtsa_agent.core.swarm import Swarm
from dtsa_agent.crazyflie.state import Vector, rotate
from dtsa_agent.keys import authenticator
from dtsa_agent.priority import set_realtime
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.checks import OTHER_SENDER, BadMessage, PublisherGuard, check_odometry
from dtsa_agent.ros.common.loop import Feed
from dtsa_agent.ros.common.messages import Fields
from dtsa_agent.ros.common.node_process import run_node
from dtsa_agent.ros.common.parameters import check_parameters, declare_settings, swarm_wide_node
from dtsa_agent.ros.realtime import RealtimeNode
from dtsa_agent.ros.swarm_host import declare_ids, declare_swarm
from dtsa_agent.stop import Stop

from .interfaces import STOP_HERE, VelocityWorld

LATEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
STALE_S = 0.3  # an agent that does not know where it is gives no commands: the bridge then holds its vehicle
LONGEST_PREDICTION_S = 0.15
WORLD = "world"  # frame of the bridge's odometry
HOLD_GAIN = 1.0  # 1/s, for agents that hover: real air does not leave them where they are
HOLD_MPS = 0.3
SPREAD_M = 0.45  # horizontally: closer than this nobody comes to rest, since all land straight down
NOWHERE_M = 1e-3
PUSH_M = 0.3  # farther than this at once nobody makes way


class ExternalVehicles:
    """Vehicles that agents steer and somebody else flies.

    :param swarms: the agents, in one or several swarms; positions and velocities are written into them from outside.
    :param every: slots between two commands.
    :param send: takes the place of a swarm and its agents' commanded velocities, m/s, frame map.
    """

    def __init__(self, swarms: Sequence[Swarm], every: int, send: Callable[[int, NDArray[np.float64]], None]) -> None:
        self._swarms, self._every, self._send = swarms, every, send
        ends = np.cumsum([len(swarm.ids) for swarm in swarms]).tolist()
        self._columns = [slice(end - len(swarm.ids), end) for swarm, end in zip(swarms, ends, strict=True)]
        self._stopping = False

    def place(self, position: NDArray[np.float64]) -> None:
        """Takes in where the vehicles are, (3, L) m, frame map."""
        for swarm, columns in zip(self._swarms, self._columns, strict=True):
            swarm.position[:] = swarm.track[:] = position[:, columns]

    def stop_here(self) -> None:
        """From now on nobody flies to its goal: all come to rest, and nobody above another one.

        They keep out of each other's way as before.
        """
        self._stopping = True

    def fly(self, slot: int, index: int = 0) -> None:
        """Sends the commands of a slot to the vehicles of a swarm."""
        if slot % self._every:
            return
        swarm = self._swarms[index]
        goal = swarm.goal.copy()  # the protocol still counts with it
        if self._stopping:
            swarm.goal[:] = swarm.position + self._way()[:, self._columns[index]]
        swarm.steer(slot, 0)
        swarm.goal[:] = goal
        still = swarm.active == 0
        if still.any():
            away = (swarm.scenario.start[:, swarm.local] - swarm.position)[:, still]
            swarm.command[:, still] = np.clip(HOLD_GAIN * away, -HOLD_MPS, HOLD_MPS)
        self._send(index, swarm.command)

    def _way(self) -> NDArray[np.float64]:
        """Where each goes to make way for those that are near horizontally, at whatever height, (3, L) m."""
        position = np.concatenate([swarm.position for swarm in self._swarms], axis=1)
        apart = position[:2, :, None] - position[:2, None, :]
        distance = np.linalg.norm(apart, axis=0)
        index = np.arange(distance.shape[0])
        above = (distance < NOWHERE_M) & (index[:, None] != index)  # one right above the other: by their numbers
        apart[0] += np.where(above, np.sign(index[:, None] - index) * NOWHERE_M, 0.0)
        distance = np.maximum(np.linalg.norm(apart, axis=0), NOWHERE_M)
        way = np.zeros_like(position)
        way[:2] = (apart / distance * np.maximum(SPREAD_M - distance, 0.0)).sum(axis=2)
        return way * np.minimum(1.0, PUSH_M / np.maximum(np.linalg.norm(way, axis=0), NOWHERE_M))


class StationNode(RealtimeNode):
    """Agents that begin their slots by the station's clock and whose vehicles are flown elsewhere.

    :param command_hz: rate of the commands, Hz; at most one a slot.
    :param vehicles: names of the agents' vehicles.
    :param origin: m, where the vehicles' world sees the origin of `map`.
    """

    def __init__(
        self, node: Node, config: SwarmConfig, *args: Any, command_hz: float, vehicles: Sequence[str],
        origin: Vector, **more: Any,
    ) -> None:  # fmt: skip
        super().__init__(node, config, *args, **more)
        every, swarms = max(1, round(1.0 / command_hz / config.slot_s)), [agent.swarm for agent in self.agents]
        self._vehicles, count = ExternalVehicles(swarms, every, self._command), len(swarms)
        self._names, self._origin = vehicles, origin
        self._heard = np.full(count, -np.inf)  # s, monotonic: when each vehicle's odometry last came
        self._measured = np.zeros((3, count))  # m, where each was by its last odometry
        self._stamp = np.zeros(count)  # s, system clock, of that
        self._inputs: list[Feed] = []
        self._bridges: list[PublisherGuard] = []  # who tells where each vehicle is
        self._outputs = []
        self._stop_here = Feed(node, Empty, STOP_HERE, LATEST, intake=self.membership.intake)
        for name in vehicles:
            self._inputs.append(
                Feed(node, Odometry, f"/{name}/{names.ODOMETRY}", LATEST, intake=self.membership.intake)
            )
            self._bridges.append(PublisherGuard())
            self._outputs.append(node.create_publisher(VelocityWorld, f"/{name}/cmd_velocity_world", 1))

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

        :raises BadMessage: if it cannot. Without any for a while the vehicle gets no commands, and the bridge holds it.
        """
        check_odometry(message)
        if not self._bridges[index].admits(time.monotonic(), feed.sender):
            raise BadMessage(OTHER_SENDER, f"odometry of {self._names[index]} from two publishers")

    def _note(self, index: int, message: Odometry) -> None:
        place, q, speed = message.pose.pose.position, message.pose.pose.orientation, message.twist.twist.linear
        x, y, z = self._origin if message.header.frame_id == WORLD else (0.0, 0.0, 0.0)
        self._measured[:, index] = place.x - x, place.y - y, place.z - z
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
    vehicles: str = setting("", "names of the vehicles of all agents, with blanks between; empty: cf1, cf2, ...")
    origin: Vector = setting((0.0, 0.0, 0.0), "where the vehicles' world sees the origin of map", unit="m")


def _body(stop: Stop, supervised: bool) -> None:
    plain = {"start_parameter_services": False, "enable_rosout": False} if supervised else {}
    node, space = swarm_wide_node("crazyflie_agents", plain)
    try:
        config = declare_swarm(node)
        ids = declare_ids(node, config.agents)
        station = StationNodeSettings(**declare_settings(node, StationNodeSettings))
        set_realtime(station.priority)
        check_parameters(node)
        vehicles = station.vehicles.split() or [f"cf{k}" for k in range(1, config.agents + 1)]
        if len(vehicles) != config.agents:
            raise ConfigError("vehicles", station.vehicles, f"{config.agents} names")
        # One station, one clock: no offsets, and nothing to align.
        more = {"authenticator": authenticator(config), "align": False, "command_hz": station.command_hz}
        more |= {"vehicles": [vehicles[k - 1] for k in ids], "origin": station.origin}
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
