"""RotorPy's Crazyflies in a process of their own: odometry out, velocities in, as fast as the clock on the wall.

`python -m dtsa_dev.soak.air.multirotors AGENTS SECONDS FILE` flies until all have arrived, or so long after the first
one has moved, and writes what came of it as JSON. RotorPy is in the extra `benchmark`.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rotorpy.vehicles.crazyflie_params import quad_params
from rotorpy.vehicles.multirotor import Multirotor

from dtsa_agent.core import SwarmConfig, make_scenario
from dtsa_agent.ros.common.process.priority import take_priority
from dtsa_agent.ros.odometry_vehicle import turned

STEP_S = 0.02
_ARRIVED_M = 0.3
_PRIORITY = 30  # above agents: the world waits for nobody
_STARTS_S = 240.0  # until the first one moves
_MOVES_MPS = 0.05
_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


class Vehicle:
    """One multirotor that takes velocities, on topics of its own.

    :param node: the node whose topics they are.
    :param number: id of its agent.
    :param place: (3,) m, where it hovers.
    """

    def __init__(self, node: Node, number: int, place: Any) -> None:
        hover = np.sqrt(quad_params["mass"] * 9.81 / (quad_params["num_rotors"] * quad_params["k_eta"]))
        self.state = {
            "x": np.array(place), "v": np.zeros(3), "q": np.array((0.0, 0.0, 0.0, 1.0)), "w": np.zeros(3),
            "wind": np.zeros(3), "rotor_speeds": np.full(4, hover),
        }  # fmt: skip
        self._body = Multirotor(quad_params, self.state, control_abstraction="cmd_vel")
        self.command = np.zeros(3)
        self.commands, self.has_moved = 0, False
        self._publisher = node.create_publisher(Odometry, f"/uav{number}/odom", _QOS)
        node.create_subscription(TwistStamped, f"/uav{number}/cmd_vel", self._take, _QOS)

    def _take(self, message: TwistStamped) -> None:
        v = message.twist.linear
        self.command, self.commands = np.array((v.x, v.y, v.z)), self.commands + 1

    def step(self) -> None:
        """Flies on, and says where it is."""
        self.state = self._body.step(self.state, {"cmd_v": self.command}, STEP_S)
        message, (x, y, z, w) = Odometry(), map(float, self.state["q"])
        place, q, speed = message.pose.pose.position, message.pose.pose.orientation, message.twist.twist.linear
        place.x, place.y, place.z = map(float, self.state["x"])
        q.x, q.y, q.z, q.w = x, y, z, w
        speed.x, speed.y, speed.z = map(float, turned((-x, -y, -z, w), self.state["v"]))
        self._publisher.publish(message)


class World:
    """All of them, and what is measured.

    :param node: the node whose topics they are.
    :param agents: how many.
    """

    def __init__(self, node: Node, agents: int) -> None:
        scenario = make_scenario(SwarmConfig(agents=agents, policy="lease"))
        self._target, self._moving = np.array(scenario.target), scenario.moving
        self.vehicles = [Vehicle(node, k + 1, scenario.start[:, k]) for k in range(agents)]
        self.closest_m, self.late_s, self.moved_s = np.inf, 0.0, -1.0
        self._errors: list[float] = []  # m/s, of velocities

    def step(self, now_s: float) -> bool:
        """One step; whether all have arrived.

        :param now_s: s, since the beginning.
        """
        for vehicle in self.vehicles:
            vehicle.step()
        x = np.array([vehicle.state["x"] for vehicle in self.vehicles])
        apart = np.sqrt(((x[:, None] - x[None]) ** 2).sum(axis=2)) + 1e9 * np.eye(len(x))
        self.closest_m = min(self.closest_m, float(apart.min()))
        for vehicle in self.vehicles:
            vehicle.has_moved |= float(np.linalg.norm(vehicle.command)) > _MOVES_MPS
        if self.moved_s < 0 and any(v.has_moved for v in self.vehicles):
            self.moved_s = now_s
        if self.moved_s >= 0:
            self._errors += [float(np.linalg.norm(v.state["v"] - v.command)) for v in self.vehicles]
        here = all(v.has_moved for v, moves in zip(self.vehicles, self._moving, strict=True) if moves)
        return here and self.arrived() == len(x)

    def arrived(self) -> int:
        """How many are where they fly to."""
        away = [np.linalg.norm(v.state["x"] - self._target[:, k]) for k, v in enumerate(self.vehicles)]
        return sum(bool(d < _ARRIVED_M) for d in away)

    def summary(self, now_s: float) -> dict[str, Any]:
        """What came of it.

        :param now_s: s, since the beginning.
        """
        return {
            "vehicles": len(self.vehicles),
            "arrived": self.arrived(),
            "flown_s": now_s - self.moved_s if self.moved_s >= 0 else 0.0,
            "min_distance_m": self.closest_m,
            "velocity_error_mean_mps": float(np.mean(self._errors)) if self._errors else None,
            "commands": [vehicle.commands for vehicle in self.vehicles],
            "world_late_max_s": self.late_s,
        }


def main(agents: int, seconds: float, path: Path) -> None:
    """Flies, and writes what came of it.

    :param agents: how many.
    :param seconds: s, at most, from when all move.
    :param path: the file.
    """
    rclpy.init(args=[])
    node = Node("world", enable_rosout=False, start_parameter_services=False)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    world, begin = World(node, agents), time.monotonic()
    take_priority(_PRIORITY)
    due = begin
    while True:
        while time.monotonic() < due:
            executor.spin_once(timeout_sec=max(0.0, due - time.monotonic()))
        for _ in range(agents):
            executor.spin_once(timeout_sec=0.0)
        now = time.monotonic() - begin
        if world.moved_s >= 0:
            world.late_s = max(world.late_s, time.monotonic() - due)
        due = max(due + STEP_S, time.monotonic() - 5 * STEP_S)  # it does not catch up with a long stall
        if world.step(now) or (now > world.moved_s + seconds if world.moved_s >= 0 else now > _STARTS_S):
            break
    path.write_text(json.dumps(world.summary(time.monotonic() - begin)), encoding="utf-8")
    rclpy.shutdown()


if __name__ == "__main__":
    main(int(sys.argv[1]), float(sys.argv[2]), Path(sys.argv[3]))
