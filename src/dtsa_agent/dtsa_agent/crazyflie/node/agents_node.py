"""The same agents on vehicles that fly elsewhere: state from `/cfN/odom`, commands to `/cfN/cmd_velocity_world`.

    python -m dtsa_agent.crazyflie.node.agents_node --ros-args -p agents:=12 -p policy:=lease ...

The node is a `swarm_host` whose vehicles are not simulated. Protocol, estimator and avoider are the same.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

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
from dtsa_agent.crazyflie.state import Vector
from dtsa_agent.keys import authenticator
from dtsa_agent.priority import set_realtime
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.checks import OTHER_SENDER, BadMessage, PublisherGuard, check_odometry
from dtsa_agent.ros.common.loop import Feed
from dtsa_agent.ros.common.messages import Fields
from dtsa_agent.ros.common.node_process import run_node
from dtsa_agent.ros.common.parameters import check_parameters, declare_settings, swarm_wide_node
from dtsa_agent.ros.odometry_vehicle import rotate
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
SPREAD_M = 0.45  # horizontal distance at which agents come to rest, since all land straight down
SAME_PLACE_M = 1e-3
PUSH_M = 0.3  # farthest that an agent makes way at once
FENCE_GAIN = 1.5  # 1/s: commands towards the fence shrink with the distance, for a vehicle outside ends the mission


def steer(
    swarm: Swarm, slot: int, fence: NDArray[np.float64] | None = None, way: NDArray[np.float64] | None = None
) -> None:
    """Decide the commands (`swarm.command`) of agents whose vehicles another program flies.

    :param fence: m, (2, 3, 1), frame map, corners of the box that no command leads out of; None: there is none.
    :param way: m, (3, L), from where they are to where they come to rest; None: they fly on to their goals.
    """
    goal = swarm.goal.copy()  # the protocol still counts with it
    if way is not None:
        swarm.goal[:] = swarm.position + way
    swarm.steer(slot, 0)
    swarm.goal[:] = goal
    still = swarm.active == 0
    if still.any():
        away = (swarm.scenario.start[:, swarm.local] - swarm.position)[:, still]
        swarm.command[:, still] = np.clip(HOLD_GAIN * away, -HOLD_MPS, HOLD_MPS)
    if fence is not None:
        swarm.command[:] = np.clip(swarm.command, *(FENCE_GAIN * (fence - swarm.position)))


def ways_apart(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the ways of all agents (m, (3, N)) to get away from those that are near horizontally."""
    apart = position[:2, :, None] - position[:2, None, :]
    distance = np.linalg.norm(apart, axis=0)
    index = np.arange(distance.shape[0])
    above = (distance < SAME_PLACE_M) & (index[:, None] != index)  # one right above another: by their numbers
    apart[0] += np.where(above, np.sign(index[:, None] - index) * SAME_PLACE_M, 0.0)
    distance = np.maximum(np.linalg.norm(apart, axis=0), SAME_PLACE_M)
    push = np.zeros_like(position)
    push[:2] = (apart / distance * np.maximum(SPREAD_M - distance, 0.0)).sum(axis=2)
    return np.asarray(push * np.minimum(1.0, PUSH_M / np.maximum(np.linalg.norm(push, axis=0), SAME_PLACE_M)))


@dataclass(frozen=True, slots=True)
class CrazyflieAgentsSettings(Settings):
    """What the node needs beside what the whole swarm agrees on."""

    command_hz: float = setting(50.0, "rate of the commands", unit="Hz", minimum=1, maximum=100)
    priority: int = setting(0, "real-time priority; 0: none", minimum=0, maximum=90)
    vehicles: str = setting("", "names of the vehicles of all agents, with blanks between; empty: cf1, cf2, ...")
    origin: Vector = setting((0.0, 0.0, 0.0), "where the vehicles' world sees the origin of map", unit="m")
    fence: bool = setting(False, "give no command that leads out of the box between fence_min and fence_max")
    fence_min: Vector = setting((-1.5, -2.3, -0.95), "lower corner of the box, frame map", unit="m")
    fence_max: Vector = setting((1.5, 2.3, 0.95), "upper corner of the box, frame map", unit="m")


class CrazyflieAgents(RealtimeNode):
    """Agents that begin their slots by the station's clock and whose vehicles (names) are flown elsewhere."""

    def __init__(
        self, node: Node, config: SwarmConfig, ids: Sequence[int], space: str, settings: CrazyflieAgentsSettings,
        vehicles: Sequence[str],
    ) -> None:  # fmt: skip
        # One station, one clock: no offsets, and nothing to align.
        super().__init__(node, config, ids, space, authenticator=authenticator(config), align=False)
        self._every, count = max(1, round(1.0 / settings.command_hz / config.slot_s)), len(self.agents)
        self._fence = np.array([settings.fence_min, settings.fence_max])[:, :, None] if settings.fence else None
        self._stopping = False
        self._names, self._origin = vehicles, np.array(settings.origin)
        self._odometry_time = np.full(count, -np.inf)  # s, monotonic: when each vehicle's odometry last came
        self._measured = np.zeros((3, count))  # m, where each was by its last odometry
        self._stamp = np.zeros(count)  # s, system clock, of that
        intake = self.intake
        self._stop_here = Feed(node, Empty, STOP_HERE, LATEST, intake=intake)
        self._inputs = [Feed(node, Odometry, f"/{name}/{names.ODOMETRY}", LATEST, intake=intake) for name in vehicles]
        self._bridges = [PublisherGuard() for _ in vehicles]  # sources of odometry
        self._outputs = [node.create_publisher(VelocityWorld, f"/{name}/cmd_velocity_world", 1) for name in vehicles]

    def _sense(self) -> None:
        self._stopping |= self._stop_here.take() is not None
        for index, feed in enumerate(self._inputs):
            message = feed.take()
            if message is not None:
                with self.intake.guard():
                    self._accept(index, message, feed)
        # What was measured is as old as its stamp: a vehicle at 1 m/s has moved on by centimetres since.
        age = np.clip(time.time() - self._stamp, 0.0, LONGEST_PREDICTION_S)
        velocity = np.concatenate([agent.swarm.velocity for agent in self.agents], axis=1)
        position = self._measured + velocity * age
        for index, agent in enumerate(self.agents):
            agent.swarm.position[:] = agent.swarm.track[:] = position[:, index : index + 1]

    def _accept(self, index: int, message: Odometry, feed: Feed) -> None:
        """Check and store a vehicle's odometry. Without any for a while it gets no commands, and the bridge holds it.

        :raises BadMessage: it is not from the bridge that sent it so far, or cannot be.
        """
        check_odometry(message)
        if not self._bridges[index].admits(time.monotonic(), feed.sender):
            raise BadMessage(OTHER_SENDER, f"odometry of {self._names[index]} from two publishers")
        place, q, speed = message.pose.pose.position, message.pose.pose.orientation, message.twist.twist.linear
        self._measured[:, index] = place.x, place.y, place.z
        if message.header.frame_id == WORLD:
            self._measured[:, index] -= self._origin
        self._stamp[index] = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        # The twist of an odometry message is in the body's frame (REP-103).
        self.agents[index].swarm.velocity[:, 0] = rotate((q.x, q.y, q.z, q.w), (speed.x, speed.y, speed.z))
        self._odometry_time[index] = time.monotonic()

    def _prepare(self, message: Fields) -> bool:
        self._sense()
        if message.phase == Slot.PREPARE and np.isinf(self._odometry_time).any():
            return True
        return super()._prepare(message)

    def _fly(self, index: int) -> None:
        swarm, slot = self.agents[index].swarm, self.agents[index].slot
        if slot % self._every:
            return
        ways = ways_apart(np.concatenate([a.swarm.position for a in self.agents], axis=1)) if self._stopping else None
        steer(swarm, slot, self._fence, None if ways is None else ways[:, index : index + 1])
        if time.monotonic() - self._odometry_time[index] < STALE_S:
            message = VelocityWorld()
            message.vel.x, message.vel.y, message.vel.z = swarm.command[:, 0].tolist()
            self._outputs[index].publish(message)


def _body(stop: Stop, supervised: bool) -> None:
    plain = {"start_parameter_services": False, "enable_rosout": False} if supervised else {}
    node, space = swarm_wide_node("crazyflie_agents", plain)
    try:
        config = declare_swarm(node)
        ids = declare_ids(node, config.agents)
        station = CrazyflieAgentsSettings(**declare_settings(node, CrazyflieAgentsSettings))
        set_realtime(station.priority)
        check_parameters(node)
        vehicles = station.vehicles.split() or [f"cf{k}" for k in range(1, config.agents + 1)]
        if len(vehicles) != config.agents:
            raise ConfigError("vehicles", station.vehicles, f"{config.agents} names")
        agents = CrazyflieAgents(node, config, ids, space, station, [vehicles[k - 1] for k in ids])
        try:
            agents.run(stop)
        finally:
            agents.loop.close()
    finally:
        node.destroy_node()


def main(args: Sequence[str] | None = None) -> int:
    return run_node("crazyflie_agents", _body, args)


if __name__ == "__main__":
    sys.exit(main())
