"""The same agents on vehicles that fly elsewhere: state from `/cfN/odom`, commands to `/cfN/cmd_velocity_world`.

    python -m dtsa_agent.crazyflie.node.agents_node --ros-args -p agents:=12 -p policy:=lease ...

The node is a `swarm_host` whose vehicles are not simulated. Protocol, estimator and avoider are the same.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from std_msgs.msg import Empty

from dtsa_agent.air.driver import AgentVehicle
from dtsa_agent.core import ConfigError
from dtsa_agent.core.settings.declaration import Settings, setting
from dtsa_agent.core.swarm import Swarm
from dtsa_agent.crazyflie.state import Vector
from dtsa_agent.keys import authenticator
from dtsa_agent.priority import set_realtime
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.checks import Intake
from dtsa_agent.ros.common.loop import Feed
from dtsa_agent.ros.common.node_process import ending, node_options, run_node
from dtsa_agent.ros.common.parameters import check_parameters, declare_settings, swarm_wide_node
from dtsa_agent.ros.odometry_vehicle import LATEST, VehicleOdometry, VehicleSettings, velocity_to
from dtsa_agent.ros.realtime import RealtimeNode
from dtsa_agent.ros.swarm_host import declare_ids, declare_swarm
from dtsa_agent.stop import Stop

from .interfaces import STOP_HERE, VelocityWorld

FASTEST_MPS = 50.0  # odometry that moves faster is refused
WORLD = "world"  # frame of the bridge's odometry
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
        swarm.command[:, still] = velocity_to(away)
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


class BridgedVehicle(AgentVehicle):
    """A vehicle that the bridge flies. Without odometry for a while it gets no commands, and the bridge holds it.

    :param name: of the vehicle.
    :param stop_order: whether all vehicles are to stop.
    """

    def __init__(
        self, node: Node, name: str, settings: CrazyflieAgentsSettings, slot_s: float, stop_order: StopOrder,
        intake: Intake,
    ) -> None:  # fmt: skip
        self._every = max(1, round(1.0 / settings.command_hz / slot_s))
        self._fence = np.array([settings.fence_min, settings.fence_max])[:, :, None] if settings.fence else None
        self._stop_order = stop_order
        x, y, z = settings.origin
        own = VehicleSettings(
            odometry_topic=f"/{name}/{names.ODOMETRY}", odometry_origin=(-x, -y, -z), fastest_mps=FASTEST_MPS
        )
        self._odometry = VehicleOdometry(node, own, intake, frame=WORLD, is_stamped=True)
        self._publisher = node.create_publisher(VelocityWorld, f"/{name}/cmd_velocity_world", 1)

    def is_ready(self) -> bool:
        self._odometry.feed.take()
        return self._odometry.is_known

    def sense(self, swarm: Swarm) -> None:
        self._odometry.sense(swarm)

    def fly(self, swarm: Swarm, slot: int) -> None:
        if slot % self._every:
            return
        steer(swarm, slot, self._fence, self._stop_order.offset_apart(swarm))
        if self._odometry.is_fresh:
            message = VelocityWorld()
            message.vel.x, message.vel.y, message.vel.z = swarm.command[:, 0].tolist()
            self._publisher.publish(message)


class StopOrder:
    """The agents of a process, and whether their vehicles are to stop where they are."""

    def __init__(self, node: Node, swarms: Sequence[Swarm], intake: Intake) -> None:
        self._swarms, self._stopping = swarms, False
        self._stop_here = Feed(node, Empty, STOP_HERE, LATEST, intake=intake)

    def offset_apart(self, swarm: Swarm) -> NDArray[np.float64] | None:
        """Return how far (m, (3, 1)) from an agent its vehicle comes to rest; None: it flies on."""
        self._stopping |= self._stop_here.take() is not None
        if not self._stopping:
            return None
        index = next(index for index, other in enumerate(self._swarms) if other is swarm)
        return ways_apart(np.concatenate([other.position for other in self._swarms], axis=1))[:, index : index + 1]


def _body(stop: Stop, supervised: bool) -> None:
    node, space = swarm_wide_node("crazyflie_agents", node_options(supervised))
    with ending(node):
        config = declare_swarm(node)
        ids = declare_ids(node, config.agents)
        station = CrazyflieAgentsSettings(**declare_settings(node, CrazyflieAgentsSettings))
        set_realtime(station.priority)
        check_parameters(node)
        vehicles = station.vehicles.split() or [f"cf{k}" for k in range(1, config.agents + 1)]
        if len(vehicles) != config.agents:
            raise ConfigError("vehicles", station.vehicles, f"{config.agents} names")
        # One station, one clock: no offsets, and nothing to align.
        agents = RealtimeNode(node, config, ids, space, authenticator=authenticator(config), align=False)
        stop_order = StopOrder(node, [agent.swarm for agent in agents.agents], agents.intake)
        for agent in agents.agents:
            name = vehicles[agent.id - 1]
            agent.vehicle = BridgedVehicle(node, name, station, config.slot_s, stop_order, agents.intake)
        try:
            agents.run(stop)
        finally:
            agents.close()


def main(args: Sequence[str] | None = None) -> int:
    return run_node("crazyflie_agents", _body, args)


if __name__ == "__main__":
    sys.exit(main())
