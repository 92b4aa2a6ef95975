"""An agent over UDP that flies a vehicle of somebody else: odometry in, velocities out. The test is the vehicle."""

from __future__ import annotations

import math
import random
import signal
import time
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from node_helpers import Graph, end_of, graph_in, ros_graph
from rclpy.publisher import Publisher
from waiting import wait_for

pytest.importorskip("dtsa_msgs.msg")

from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.plugins import make_swarm
from dtsa_agent.ros.common.checks import OTHER_SENDER, Intake
from dtsa_agent.ros.odometry_vehicle import OdometryVehicle, VehicleOdometry, VehicleSettings, rotate
from dtsa_bench.flights.domain import ros_domain

AGENT = "dtsa_agent.ros.agent_node"
STEP_S = 0.02
# Its body looks to the left: what is ahead of it is the map's y.
ATTITUDE = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))


class Vehicle:
    """A point that flies as it is told, on topics as MAVROS has them."""

    def __init__(self, graph: Graph, place: tuple[float, float, float]) -> None:
        self.graph = graph
        self.position, self.velocity = np.array(place), np.zeros(3)
        self.commands: list[np.ndarray] = []
        self.speaks, self.jump = True, 0.0
        self._next = time.monotonic()
        self._publisher = graph.node.create_publisher(Odometry, "/uav1/local_position/odom", 1)
        graph.node.create_subscription(TwistStamped, "/uav1/setpoint_velocity/cmd_vel", self._take, 10)

    def _take(self, message: TwistStamped) -> None:
        assert message.header.frame_id == "map"
        v = message.twist.linear
        self.velocity = np.array((v.x, v.y, v.z))
        self.commands.append(self.velocity)

    def act(self) -> None:
        if time.monotonic() < self._next:
            return
        self._next = time.monotonic() + STEP_S
        self.position = self.position + self.velocity * STEP_S
        if self.speaks:
            message = Odometry()
            place, q, speed = message.pose.pose.position, message.pose.pose.orientation, message.twist.twist.linear
            place.x, place.y, place.z = (self.position + self.jump).tolist()
            q.x, q.y, q.z, q.w = ATTITUDE
            speed.x, speed.y, speed.z = (self.velocity[1], -self.velocity[0], self.velocity[2])
            self._publisher.publish(message)

    def until_commands(self, still: bool) -> None:
        """Waits for ten commands in a row that hold the vehicle, or fly it."""
        self.commands.clear()

        def there() -> bool:
            last = [float(np.linalg.norm(command)) for command in self.commands[-10:]]
            return len(last) == 10 and (max(last) == 0.0 if still else min(last) > 0.1)

        self.graph.until(there, self.act)


def test_axes_of_the_body_are_turned_into_those_of_the_map() -> None:
    assert rotate(ATTITUDE, np.array((1.0, 0.0, 0.0))) == pytest.approx((0.0, 1.0, 0.0))
    assert rotate(ATTITUDE, np.array((0.0, 1.0, 3.0))) == pytest.approx((-1.0, 0.0, 3.0))


@pytest.mark.ros
def test_odometry_of_one_publisher_is_used_until_it_is_silent(tmp_path: Path) -> None:
    with ros_domain() as domain, ExitStack() as stack:
        nodes = [stack.enter_context(graph_in(domain, tmp_path)).node for _ in range(3)]
        intake = Intake()
        odometry = VehicleOdometry(nodes[0], VehicleSettings(odometry_topic="/odom"), intake, standstill_s=0.3)
        stack.callback(odometry.feed.close)
        swarm = make_swarm(SwarmConfig(agents=2), None, local=[1])
        first, second = (node.create_publisher(Odometry, "/odom", 1) for node in nodes[1:])
        wait_for(lambda: first.get_subscription_count() and second.get_subscription_count())

        def x_after(publisher: Publisher, x: float, seconds: float = 0.02) -> float:
            message = Odometry()
            message.pose.pose.position.x, message.pose.pose.orientation.w = x, 1.0
            publisher.publish(message)
            time.sleep(seconds)
            odometry.sense(swarm)
            return float(swarm.position[0, 0])

        wait_for(lambda: x_after(first, 1.0) == 1.0)
        # Each in its turn, for the feed keeps the last message.
        wait_for(lambda: x_after(first, 1.0) == x_after(second, 1.2) == 1.0 and intake.counts[OTHER_SENDER])
        wait_for(lambda: x_after(second, 1.2) == 1.2)
        # The agent stands still: what has waited is old, and the vehicle elsewhere.
        assert x_after(second, 1.4, seconds=1.0) == 1.2
        assert not odometry.is_fresh
        wait_for(lambda: x_after(second, 1.6) == 1.6)


def words(agents: int, slot_ms: float) -> list[str]:
    """Parameters of agent 1, which flies the vehicle above."""
    group = f"239.255.{random.randrange(256)}.{random.randrange(256)}:{random.randrange(20_000, 30_000)}"
    values = {
        "id": 1, "agents": agents, "air": "udp", "interface": "lo", "group": group, "auth": False, "axis_x_m": 50.0,
        "vehicle": "odometry", "odometry_topic": "/uav1/local_position/odom", "odometry_origin": "[1.0, 2.0, 0.5]",
        "command_topic": "/uav1/setpoint_velocity/cmd_vel", "slot_ms": slot_ms, "quorum": "0%",
    }  # fmt: skip
    return [word for name, value in values.items() for word in ("-p", f"{name}:={str(value).lower()}")]


@pytest.mark.ros
def test_an_agent_that_listens_holds_its_vehicle(tmp_path: Path) -> None:
    """For minutes, with slots of a second."""
    with ros_graph(tmp_path) as graph:
        vehicle = Vehicle(graph, (3.0, -1.0, 0.0))
        process = graph.start(AGENT, *words(agents=100, slot_ms=1000.0))
        graph.until(lambda: len(vehicle.commands) > 10, vehicle.act)
        assert not np.any(vehicle.commands)
        vehicle.position[0] += 0.25  # the wind
        graph.until(lambda: vehicle.commands[-1][0] < -0.1, vehicle.act)
        graph.until(lambda: abs(vehicle.position[0] - 3.0) < 0.05, vehicle.act)
        assert end_of(process, signal.SIGTERM) == (0, "")


@pytest.mark.ros
def test_an_agent_flies_a_vehicle_and_holds_it_without_odometry_that_can_be(tmp_path: Path) -> None:
    with ros_graph(tmp_path) as graph:
        vehicle = Vehicle(graph, (3.0, -1.0, 0.0))
        process = graph.start(AGENT, *words(agents=2, slot_ms=20.0))
        vehicle.until_commands(still=False)
        first = vehicle.position.copy()
        graph.until(lambda: float(np.linalg.norm(vehicle.position - first)) > 0.3, vehicle.act)
        vehicle.speaks = False
        vehicle.until_commands(still=True)  # stale
        vehicle.speaks, vehicle.jump = True, 1000.0
        vehicle.until_commands(still=True)  # wild
        vehicle.jump = 0.0
        vehicle.until_commands(still=False)
        vehicle.commands.clear()
        code, said = end_of(process, signal.SIGTERM)
        assert (code, said) == (0, "")
        # Not once: a single message may be lost, and the vehicle would fly on.
        graph.until(lambda: len(vehicle.commands) > 1 and not np.any(vehicle.commands[-2:]), vehicle.act)


def test_an_agent_that_never_had_odometry_says_so_and_fails(tmp_path: Path) -> None:
    values = {"id": 1, "agents": 2, "air": "udp", "interface": "lo", "auth": "false", "vehicle": "odometry"}
    with ros_graph(tmp_path) as graph:
        words = [word for name, value in values.items() for word in ("-p", f"{name}:={value}")]
        process = graph.start(AGENT, *words, "-p", "duration_s:=1.5", logs=True)
        code, said = end_of(process)
        assert code == 1
        assert "no odometry that can be used: none came on odom" in said


def test_a_vehicle_that_has_to_hover_returns_to_where_that_began(monkeypatch: pytest.MonkeyPatch) -> None:
    vehicle = OdometryVehicle.__new__(OdometryVehicle)
    vehicle._every, vehicle._hold, sent = 1, None, []
    vehicle._odometry = SimpleNamespace(is_fresh=True)
    monkeypatch.setattr(vehicle, "_command", lambda velocity: sent.append(velocity.tolist()))
    swarm = make_swarm(SwarmConfig(agents=2, policy="lease"), None, local=[1])

    def fly(x: float, active: int) -> None:
        swarm.position[:, 0], swarm.active[0] = (x, 0.0, 0.0), active
        vehicle.fly(swarm, 0)

    fly(-1.0, 0)  # it begins, and nobody knows it yet
    fly(-1.1, 0)
    assert sent[-1] == pytest.approx([0.1, 0.0, 0.0])
    fly(1.0, 1)
    for x, command in ((2.0, 0.0), (2.1, -0.1), (3.0, -0.3), (1.9, 0.1)):
        fly(x, 0)
        assert sent[-1] == pytest.approx([command, 0.0, 0.0])
    fly(2.0, 1)
    fly(4.0, 0)
    assert sent[-1] == [0.0, 0.0, 0.0]
