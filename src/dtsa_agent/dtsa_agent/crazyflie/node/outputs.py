"""What goes out over the graph: odometry, pose, status and diagnostics."""

from __future__ import annotations

import math
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from dtsa_msgs.msg import Status
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Log
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from dtsa_agent.crazyflie.positions.motion_capture import PositionNumbers
from dtsa_agent.crazyflie.settings import SwarmSettings
from dtsa_agent.crazyflie.state import conversions
from dtsa_agent.crazyflie.state.conversions import VehicleState, to_map
from dtsa_agent.crazyflie.state.state_machine import State
from dtsa_agent.crazyflie.vehicle.reports import Snapshot, snapshot
from dtsa_agent.crazyflie.vehicle.vehicle import Vehicle
from dtsa_agent.ros.common.wire.packing import UNKNOWN, diagonal

LATEST_ONLY = QoSProfile(depth=1)
FRAME = "map"
EVENTS = "/all/events"  # what the bridge does, and what it was ordered to do: its log
EVENTS_QOS = QoSProfile(depth=500, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # also for those who come late
LEVELS = {"info": 20, "warn": 30, "error": 40}
# The firmware logs no variances: standard deviations of 3 cm, 0.1 rad and 0.1 m/s are cautious for its estimator with a
# positioning system. Body rates are not logged.
POSE_COVARIANCE = diagonal(0.03**2, 0.1**2)
TWIST_COVARIANCE = diagonal(0.1**2, UNKNOWN)


class Outputs:
    """Publishers of all vehicles."""

    frame = FRAME
    status_type: Any = Status

    def __init__(self, node: Node, settings: SwarmSettings) -> None:
        self._clock = node.get_clock()
        self._name = node.get_name()
        self._origin = settings.station.room_origin_in_world
        self._told: dict[str, State] = {}  # the last state that was not left to the regular status
        self._odom: dict[str, Any] = {}
        self._pose: dict[str, Any] = {}
        self._status: dict[str, Any] = {}
        self._odom_message: dict[str, Odometry] = {}
        self._wanted: dict[str, tuple[bool, bool]] = {}  # odometry, pose: does somebody listen?
        positions = settings.station.positions
        for robot in settings.robots:
            name = robot.name
            self._odom[name] = node.create_publisher(Odometry, f"{name}/odom", LATEST_ONLY)
            if not positions.on or positions.topic_of(name).lstrip("/") != f"{name}/pose":  # motion capture's own
                self._pose[name] = node.create_publisher(PoseStamped, f"{name}/pose", LATEST_ONLY)
            self._status[name] = node.create_publisher(self.status_type, f"{name}/status", QoSProfile(depth=10))
        self._events = node.create_publisher(Log, EVENTS.lstrip("/"), EVENTS_QOS)
        self._diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))

    def _place(self, state: VehicleState) -> conversions.Vector:
        """Where a vehicle is, m, in the frame of what is published."""
        return to_map(state.position, self._origin)

    def publish_state(self, vehicle: Vehicle, state: VehicleState) -> None:
        """Odometry and pose of one log packet, in the link's thread; only what somebody listens to.

        Whoever has entered another state says so at once: others may fly towards it.
        """
        name = vehicle.name
        if vehicle.state != self._told.get(name):
            self._told[name] = vehicle.state
            message = self._status_message(snapshot(vehicle, time.monotonic()), self._clock.now().to_msg())
            self._status[name].publish(message)
        odom, pose = self._wanted.get(name, (False, False))
        if not (odom or pose):
            return
        stamp = self._clock.now().to_msg()
        x, y, z = self._place(state)
        qx, qy, qz, qw = state.orientation
        message = self._odom_message.get(name)
        if message is None:
            message = self._odom_message[name] = Odometry(child_frame_id=f"{name}/base_link")
            message.header.frame_id = self.frame
            message.pose.covariance, message.twist.covariance = POSE_COVARIANCE, TWIST_COVARIANCE
        message.header.stamp = stamp
        p, q = message.pose.pose.position, message.pose.pose.orientation
        p.x, p.y, p.z = x, y, z
        q.x, q.y, q.z, q.w = qx, qy, qz, qw
        if odom:
            v = message.twist.twist.linear  # REP-103: the twist of an odometry is in the child's frame
            v.x, v.y, v.z = conversions.rotate_inverse(state.orientation, state.velocity)
            self._odom[name].publish(message)
        if pose:
            self._pose[name].publish(PoseStamped(header=message.header, pose=message.pose.pose))

    def publish_event(self, level: str, line: str) -> None:
        """One line of the log, for those who record a mission."""
        self._events.publish(
            Log(stamp=self._clock.now().to_msg(), level=LEVELS.get(level, 20), name=self._name, msg=line)
        )

    def publish_status(self, snapshots: list[Snapshot]) -> None:
        """Status of all; also looks who listens to odometry and pose."""
        stamp = self._clock.now().to_msg()
        for s in snapshots:
            self._wanted[s.name] = (
                self._odom[s.name].get_subscription_count() > 0,
                s.name in self._pose and self._pose[s.name].get_subscription_count() > 0,
            )
            self._status[s.name].publish(self._status_message(s, stamp))

    def _status_message(self, s: Snapshot, stamp: Any) -> Any:
        return status_message(s, stamp)

    def publish_diagnostics(self, snapshots: list[Snapshot]) -> None:
        """Diagnostics of all."""
        message = DiagnosticArray()
        message.header.stamp = self._clock.now().to_msg()
        message.status = [diagnostic(s) for s in snapshots]
        self._diagnostics.publish(message)


def status_message(s: Snapshot, stamp: Any) -> Status:
    """A vehicle's status on the wire."""
    message = Status(
        supervisor_info=s.vehicle.info & 0xFFFF if s.vehicle else 0,
        battery_voltage=s.vehicle.battery if s.vehicle else 0.0,
        rssi=s.rssi,
        num_tx_unicast=s.sent,
        num_rx_unicast=s.received,
        state=int(s.state),
        state_name=s.state.name.lower(),
        link_quality=s.link_quality,
        log_age=s.log_age if math.isfinite(s.log_age) else -1.0,
        command_age=s.command_age if math.isfinite(s.command_age) else -1.0,
        latency_ms=s.latency_p99 * 1000,
        reason=s.reason,
    )
    message.header.stamp = stamp
    message.header.frame_id = FRAME
    return message


def diagnostic(s: Snapshot) -> DiagnosticStatus:
    """A vehicle's line in /diagnostics."""
    level = DiagnosticStatus.OK
    if s.state in (State.EMERGENCY, State.LOST):
        level = DiagnosticStatus.ERROR
    elif s.state in (State.DISCONNECTED, State.CONNECTING) or s.reason.startswith(("battery", "hold", "land:")):
        level = DiagnosticStatus.WARN
    values = {
        "battery [V]": f"{s.vehicle.battery:.2f}" if s.vehicle else "unknown",
        "link quality": f"{s.link_quality:.2f}",
        "log age [s]": f"{s.log_age:.2f}",
        "last command age [s]": f"{s.command_age:.2f}",
        "commands [Hz]": f"{s.command_hz:.0f}",
        "command latency, 99th percentile [ms]": f"{s.latency_p99 * 1000:.1f}",
        "commands refused": str(s.refused),
        "reason": s.reason,
    }
    if s.positions is not None:
        values |= position_values(s.positions)
        if level == DiagnosticStatus.OK and s.positions.rate == 0.0:
            level = DiagnosticStatus.WARN
    return DiagnosticStatus(
        level=level,
        name=f"crazyflie_bridge: {s.name}",
        message=s.state.name.lower(),
        hardware_id=s.name,
        values=[KeyValue(key=key, value=value) for key, value in values.items()],
    )


def position_values(p: PositionNumbers) -> dict[str, str]:
    """What /diagnostics says about motion capture and one vehicle."""
    refused = ", ".join(f"{kind} {number}" for kind, number in sorted(p.refused.items()))
    return {
        "positions [Hz]": f"{p.rate:.0f}",
        "positions sent": str(p.sent),
        "position age [s]": f"{p.age:.2f}",
        "position latency, median [ms]": f"{p.latency_p50 * 1000:.1f}",
        "position latency, 99th percentile [ms]": f"{p.latency_p99 * 1000:.1f}",
        "positions refused": refused or "0",
        "last refusal": p.reason,
    }
