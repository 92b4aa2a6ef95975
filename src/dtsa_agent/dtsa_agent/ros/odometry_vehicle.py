"""A vehicle that offers odometry and takes velocities, flown by an agent on a network. docs/how-to/vehicles.md."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from dtsa_msgs.msg import VelocityWorld
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from dtsa_agent.core.settings.declaration import Settings, setting
from dtsa_agent.core.swarm import Swarm
from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.process.loop import HOUSEKEEPING_S, Feed
from dtsa_agent.ros.common.wire.checks import OTHER_SENDER, RANGE, OnePublisher, Unusable, check_odometry
from dtsa_agent.ros.common.wire.intake import Intake

SIMULATED, ODOMETRY = "simulated", "odometry"
BODY, MAP = "body", "map"
TWIST, VELOCITY_WORLD = "twist", "velocity_world"
_LATEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
_LONGEST_PREDICTION_S = 0.15
_SLACK_M = 0.5  # odometry may be off by this from one message to the next
_HOLD_GAIN, _HOLD_MPS = 1.0, 0.3  # 1/s, m/s: of an agent that hovers
_STOPS, _STOPS_S = 5, 0.1  # how often an agent that ends says to its vehicle to stop, within which time


@dataclass(frozen=True, slots=True)
class VehicleSettings(Settings):
    """The vehicle of an agent on a network.

    :raises ConfigError: for values that are not allowed.
    """

    vehicle: str = setting(
        SIMULATED, "what the agent flies: the simulated vehicle, or one with odometry", choices=(SIMULATED, ODOMETRY)
    )
    odometry_topic: str = setting("odom", "topic of the vehicle's odometry, nav_msgs/Odometry")
    odometry_origin: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), "where the origin of the odometry lies in the swarm's map", unit="m", kind="vector"
    )
    twist_frame: str = setting(
        BODY, "axes of the velocity in the odometry: the body's (REP-103), or the map's", choices=(BODY, MAP)
    )
    command_topic: str = setting("cmd_vel", "topic on which the vehicle takes velocities")
    command_frame: str = setting(MAP, "axes of these velocities: the map's, or the body's", choices=(MAP, BODY))
    command_type: str = setting(
        TWIST,
        "geometry_msgs/TwistStamped, or dtsa_msgs/VelocityWorld as the bridge takes",
        choices=(TWIST, VELOCITY_WORLD),
    )
    command_hz: float = setting(50.0, "rate of the commands, at most one a slot", unit="Hz", minimum=1, maximum=200)
    stale_s: float = setting(0.3, "odometry older than this holds the vehicle", unit="s", minimum=0.02, maximum=5)
    fastest_mps: float = setting(
        5.0, "odometry that moves faster than this is refused", unit="m/s", minimum=0.1, maximum=50
    )


class OdometryVehicle:
    """See the module; a :class:`~dtsa_agent.air.vehicle.Vehicle`.

    Odometry that cannot be, or lies where the vehicle cannot have got since the last one that was believed, is counted
    and not used. Without any for a while the vehicle gets the velocity 0, and the agent says that it stands.

    :param node: the node whose topics they are.
    :param settings: names and limits.
    :param slot_s: s, length of a slot.
    """

    def __init__(self, node: Node, settings: VehicleSettings, slot_s: float) -> None:
        self._settings, self._node = settings, node
        self._every = max(1, round(1.0 / settings.command_hz / slot_s))
        self.intake = Intake(node.get_logger())
        self._origin = np.array(settings.odometry_origin)
        self._last: tuple[float, Any, Any] | None = None  # s, monotonic; m, m/s, map: last believed
        self._attitude = (0.0, 0.0, 0.0, 1.0)  # of the same, x, y, z, w
        self._hold: Any = None  # m, map: where it was when it began to hover
        kind = TwistStamped if settings.command_type == TWIST else VelocityWorld
        self._publisher = node.create_publisher(kind, settings.command_topic, 1)
        self._feed = Feed(node, Odometry, settings.odometry_topic, _LATEST, intake=self.intake)
        self._pilot = OnePublisher()  # who tells where the vehicle is
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self._next_service_s = 0.0

    def close(self) -> None:
        """The agent has ended, however that came: the vehicle shall stand.

        One message may be lost, above all one whose publisher is gone a moment later: it is said several times, and
        who takes it reliably has a while to say that it has it.
        """
        try:
            for _ in range(_STOPS):
                self._command(np.zeros(3))
                time.sleep(_STOPS_S / _STOPS)
            self._publisher.wait_for_all_acked(Duration(seconds=_STOPS_S))
        finally:
            self._feed.close()
            self._executor.shutdown(timeout_sec=0)

    def ready(self) -> bool:
        """Whether odometry has come, and is fresh."""
        self._look()
        return self._fresh() is not None

    def _fresh(self) -> tuple[float, Any, Any] | None:
        last = self._last
        return last if last is not None and time.monotonic() - last[0] < self._settings.stale_s else None

    def _look(self) -> None:
        """Takes in what has come, and serves whoever asks for parameters."""
        message = self._feed.take()
        if message is not None:
            self._take(message)
        if time.monotonic() >= self._next_service_s:
            self._next_service_s = time.monotonic() + HOUSEKEEPING_S
            self._executor.spin_once(timeout_sec=0.0)

    def _take(self, message: Odometry) -> None:
        with self.intake.guard():
            check_odometry(message)
            if not self._pilot.admits(self._feed.number, time.monotonic(), self._feed.sender):
                raise Unusable(OTHER_SENDER, "odometry from two publishers")
            now, last = time.monotonic(), self._last
            place, speed = message.pose.pose.position, message.twist.twist.linear
            position = np.array((place.x, place.y, place.z)) + self._origin
            velocity = np.array((speed.x, speed.y, speed.z))
            q = message.pose.pose.orientation
            attitude = (q.x, q.y, q.z, q.w)
            if self._settings.twist_frame == BODY:
                velocity = turned(attitude, velocity)
            fastest = self._settings.fastest_mps
            if math.sqrt(float(velocity @ velocity)) > fastest:
                raise Unusable(RANGE, f"odometry of more than {fastest:g} m/s")
            if last is not None:
                away = position - last[1]
                if math.sqrt(float(away @ away)) > _SLACK_M + fastest * (now - last[0]):
                    raise Unusable(RANGE, "odometry that has jumped")
            self._last, self._attitude = (now, position, velocity), attitude

    def sense(self, swarm: Swarm) -> None:
        """See Vehicle.

        :param swarm: the agent.
        """
        self._look()
        fresh = self._fresh()
        if fresh is None:
            swarm.velocity[:, 0] = 0.0
            return
        since, position, velocity = fresh
        swarm.velocity[:, 0] = velocity
        # What was measured is as old as it is: a vehicle at 1 m/s has moved on by centimetres since.
        swarm.position[:, 0] = position + velocity * min(time.monotonic() - since, _LONGEST_PREDICTION_S)
        swarm.track[:, :, 0] = swarm.position[:, 0]

    def fly(self, swarm: Swarm, slot: int) -> None:
        """See Vehicle.

        :param swarm: the agent.
        :param slot: the slot.
        """
        if slot % self._every:
            return
        swarm.steer(slot, 0)
        if self._fresh() is None:
            swarm.command[:, 0] = 0.0
        elif swarm.active[0]:
            self._hold = None
        else:
            if self._hold is None:
                self._hold = swarm.position[:, 0].copy()
            swarm.command[:, 0] = np.clip(_HOLD_GAIN * (self._hold - swarm.position[:, 0]), -_HOLD_MPS, _HOLD_MPS)
        self._command(swarm.command[:, 0])

    def _command(self, velocity: Any) -> None:
        """Publishes a velocity.

        :param velocity: (3,) m/s, map.
        """
        if self._settings.command_frame == BODY:
            x, y, z, w = self._attitude
            velocity = turned((-x, -y, -z, w), velocity)
        if self._settings.command_type == TWIST:
            message = TwistStamped()
            message.header.frame_id = (
                names.FRAME if self._settings.command_frame == MAP else names.body_frame(self._node.get_namespace())
            )
            speed = message.twist.linear
        else:
            message = VelocityWorld()
            speed = message.vel
        message.header.stamp = self._node.get_clock().now().to_msg()
        speed.x, speed.y, speed.z = map(float, velocity)
        self._publisher.publish(message)


def turned(q: tuple[float, float, float, float], v: Any) -> Any:
    """A vector of the body in the map's axes.

    :param q: (4,) attitude as a quaternion x, y, z, w, body in map.
    :param v: (3,), in the body's axes.
    """
    axis, w = np.array(q[:3]), q[3]
    across = 2.0 * np.cross(axis, v)
    return v + w * across + np.cross(axis, across)
