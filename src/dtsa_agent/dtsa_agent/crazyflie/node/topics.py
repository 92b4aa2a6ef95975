"""Topics and services of all vehicles: what comes in, and what goes out. Names, units and frames are Crazyswarm2's.

Places are in the Crazyflies' world (z = 0 is the floor), yaw of services in radians.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from builtin_interfaces.msg import Duration as DurationMsg
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from dtsa_msgs.msg import Status as StateMessage
from geometry_msgs.msg import Point, PoseStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Log
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from std_msgs.msg import Empty as EmptyMsg
from std_srvs.srv import Empty, SetBool, Trigger

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.crazyflie.bridge import Bridge
from dtsa_agent.crazyflie.commands import FULL_STATE, POSITION, VELOCITY_WORLD, CommandInput, CommandThread
from dtsa_agent.crazyflie.positions import NAMED_POSES, PoseTracker, PositionSettings
from dtsa_agent.crazyflie.settings import SwarmSettings
from dtsa_agent.crazyflie.state import State, VehicleState, place_text, rotate_inverse
from dtsa_agent.crazyflie.vehicle import OFF, CrazyflieVehicle, Snapshot
from dtsa_agent.ros.common.cdr import UNKNOWN, diagonal

from . import interfaces
from .interfaces import EVENTS, EVENTS_QOS, STATE, TRAJECTORIES
from .parameters import FirmwareParameters

FRAME = "world"
LATEST_ONLY = QoSProfile(depth=1)
# Takes reliable publishers and others; a pose that is late is worth nothing.
SENSOR = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
LEVELS = {"info": 20, "warn": 30, "error": 40}
ARMED_S, ARMED_POLL_S = 3.0, 0.02  # longest wait for motors that are to run, or to be locked
LOW_POWER = 3  # pm_state
# The firmware logs no variances: standard deviations of 3 cm, 0.1 rad and 0.1 m/s are cautious for its estimator with a
# positioning system. Body rates are not logged.
POSE_COVARIANCE = diagonal(0.03**2, 0.1**2)
TWIST_COVARIANCE = diagonal(0.1**2, UNKNOWN)
LogLine = Callable[[str, str], None]


def seconds(duration: DurationMsg) -> float:
    """Return a duration of a message, s."""
    return float(duration.sec + duration.nanosec * 1e-9)


def _short(value: Any) -> str:
    """A field of a request for people."""
    if isinstance(value, DurationMsg):
        return f"{seconds(value):g} s"
    if isinstance(value, Point):
        return place_text((value.x, value.y, value.z))
    return f"{value:g}" if isinstance(value, float) else str(value)


def helper_node(node: Node, name: str) -> Node:
    """Make a node beside another one, with a longer name, whose topics are read by a thread of their own."""
    plain = {"enable_rosout": False, "start_parameter_services": False, "use_global_arguments": False}
    return Node(f"{node.get_name()}_{name}", namespace=node.get_namespace(), context=node.context, **plain)


# -- what comes in ----------------------------------------------------------------------------------------------------
class BridgeInputs:
    """Streamed commands, services, the ground station's heartbeat.

    :param commands: reads the streamed commands; not started yet.
    """

    def __init__(self, node: Node, bridge: Bridge, commands: CommandThread, log: LogLine) -> None:
        self._node, self._bridge, self._commands, self._log = node, bridge, commands, log
        self._on_board = bridge.settings.station.on_board.enabled
        self._waiting = ReentrantCallbackGroup()  # of services that wait: the others are served meanwhile
        self._masks = {name: vehicle.robot.group_mask for name, vehicle in bridge.vehicles.items()}

    def offer(self) -> None:
        """Create everything; `/all/emergency` is last: a program that waits for it knows that all else is there."""
        streams = (
            (interfaces.FullState, "cmd_full_state", FULL_STATE),
            (interfaces.Position, "cmd_position", POSITION),
            (interfaces.VelocityWorld, "cmd_velocity_world", VELOCITY_WORLD),
        )
        warn = partial(self._node.get_logger().warning, throttle_duration_sec=1.0)
        FirmwareParameters(self._node, self._bridge, self._log, self._masks).declare()
        for name, vehicle in self._bridge.vehicles.items():
            for message, topic, kind in () if self._on_board else streams:  # agents on board steer themselves
                read = CommandInput(kind, vehicle.controls, vehicle.station, name, warn)
                self._commands.subscribe(message, f"{name}/{topic}", read, LATEST_ONLY)
            self._create_services(name, [name])
            self._node.create_service(Trigger, f"{name}/reconnect", partial(self._reconnect, name))
        self._commands.start()
        self._node.create_subscription(EmptyMsg, "all/heartbeat", lambda _: self._bridge.note_heartbeat(), LATEST_ONLY)
        self._node.create_service(Trigger, "all/end_heartbeat", self._end_heartbeat)
        self._create_services("all", list(self._bridge.vehicles))

    def _create_services(self, prefix: str, names: list[str]) -> None:
        for kind, service, callback in self._services():
            name, group = f"{prefix}/{service}", self._waiting if service == "arm" else None
            order = partial(self._ordered, name, partial(callback, names))
            self._node.create_service(kind, name, order, callback_group=group)

    def _services(self) -> list[tuple[Any, str, Callable[[list[str], Any], Any]]]:
        """Type, name and callback of each service that takes an order to one or all; `emergency` is the last."""
        enable = [(SetBool, "enable", self._enable)] if self._on_board else []
        return [
            *enable,
            *((kind, name, self._refuse) for kind, name in TRAJECTORIES),
            (interfaces.Takeoff, "takeoff", self._takeoff),
            (interfaces.Land, "land", self._land),
            (interfaces.GoTo, "go_to", self._go_to),
            (interfaces.Arm, "arm", self._arm),
            (interfaces.NotifySetpointsStop, "notify_setpoints_stop", self._notify),
            (Empty, "emergency", self._emergency),
        ]

    async def _ordered(self, name: str, callback: Callable[[Any], Any], request: Any, response: Any) -> Any:
        """Carry out an order, and say so: what an operator did belongs to what happened."""
        try:
            result = callback(request)
            done, text = await result if hasattr(result, "__await__") else result
        except Exception as error:  # of this order: emergency stops must still be answered
            done, text = False, f"{type(error).__name__}: {error}"
        fields = ", ".join(f"{key} {_short(getattr(request, key))}" for key in request.get_fields_and_field_types())
        self._log("info" if done else "warn", f"order /{name} ({fields}): {'done' if done else text}")
        if hasattr(response, "success"):
            response.success, response.message = done, text
        return response

    def _each(
        self, names: list[str], order: Callable[[CrazyflieVehicle], str | None], group: int = 0
    ) -> tuple[bool, str]:
        """Give an order to those that are addressed (group 0: to all of them; else to those in one of these groups)."""
        members = [name for name in names if not group or self._masks[name] & group]
        if not members:
            return False, f"none of {', '.join(names)} is in a group of {group}"
        return self._bridge.order_each(members, order)

    def _refuse(self, names: list[str], request: Any) -> tuple[bool, str]:
        return False, "trajectories are not supported: send positions, velocities or go_to"

    def _takeoff(self, names: list[str], request: Any) -> tuple[bool, str]:
        if problem := self._bridge.why_no_takeoff():
            return False, problem
        duration = seconds(request.duration)
        return self._each(names, lambda v: v.takeoff(request.height, duration), request.group_mask)

    def _land(self, names: list[str], request: Any) -> tuple[bool, str]:
        duration, notes = seconds(request.duration), list[str]()
        order = lambda v: v.land("service", request.height, duration, notes.append)  # noqa: E731
        done, text = self._each(names, order, request.group_mask)
        return done, "; ".join(filter(None, (text, *notes)))

    def _go_to(self, names: list[str], request: Any) -> tuple[bool, str]:
        members = [name for name in names if not request.group_mask or self._masks[name] & request.group_mask]
        if len(members) > 1 and not request.relative:
            return False, "a go_to of all must be relative: they would meet in one place"
        goal, duration = (request.goal.x, request.goal.y, request.goal.z), seconds(request.duration)
        return self._each(names, lambda v: v.go_to(goal, request.yaw, duration, request.relative), request.group_mask)

    async def _arm(self, names: list[str], request: Any) -> tuple[bool, str]:
        """Arm, or lock the motors, and wait until it is so; the executor serves others meanwhile."""
        done, text = self._each(names, lambda v: v.arm(request.arm))
        wanted, before = (State.ARMED, State.READY) if request.arm else (State.READY, State.ARMED)
        end, future = time.monotonic() + ARMED_S, Future()

        def waits_for() -> list[str]:
            return [n for n in names if self._bridge.vehicles[n].state == before and n not in text]

        def poll() -> None:
            if (time.monotonic() > end or not waits_for()) and not future.done():
                future.set_result(None)

        timer = self._node.create_timer(ARMED_POLL_S, poll, callback_group=self._waiting)
        try:
            await future
        finally:
            self._node.destroy_timer(timer)
        if late := waits_for():
            text = "; ".join(filter(None, (text, f"{', '.join(late)}: not {wanted.name.lower()}")))
        return done and not late, text

    def _enable(self, names: list[str], request: Any) -> tuple[bool, str]:
        return self._each(names, lambda v: v.enable(request.data))

    def _notify(self, names: list[str], request: Any) -> tuple[bool, str]:
        valid_ms = request.remain_valid_millisecs
        return self._each(names, lambda v: v.notify_setpoints_stop(valid_ms), request.group_mask)

    def _emergency(self, names: list[str], request: Any) -> tuple[bool, str]:
        for name in names:
            self._bridge.vehicles[name].stop("service emergency")
        self._log("error", f"EMERGENCY STOP of {', '.join(names)}: service")
        return True, ""

    def _reconnect(self, name: str, request: Any, response: Any) -> Any:
        problem = self._bridge.reconnect(name)
        response.success, response.message = not problem, problem or "connecting"
        return response

    def _end_heartbeat(self, request: Any, response: Any) -> Any:
        self._bridge.end_heartbeat()
        response.success = True
        return response


# -- motion capture ---------------------------------------------------------------------------------------------------
def named_pose_array() -> Any:
    """Return the type of the named poses; ConfigError: its package is not in the workspace."""
    try:
        from motion_capture_tracking_interfaces.msg import NamedPoseArray
    except ImportError:
        raise ConfigError(
            "station.positions.source", NAMED_POSES,
            "pose, or named_poses with the package motion_capture_tracking_interfaces in the workspace (it is not)",
        ) from None  # fmt: skip
    return NamedPoseArray


def subscribe_positions(
    poses: CommandThread, settings: PositionSettings, vehicles: dict[str, CrazyflieVehicle]
) -> None:
    """Listen to motion capture, if there is one, in a thread that is not started yet.

    :raises ConfigError: the type of the named poses is not there.
    """
    if settings.source == NAMED_POSES:
        for topic in sorted({settings.topic_of(name) for name in vehicles}):
            poses.subscribe(named_pose_array(), topic, partial(_named, vehicles), SENSOR)
    elif settings.enabled:
        for name, vehicle in vehicles.items():
            take = lambda message, info, vehicle=vehicle: _see(vehicle, message.header, message.pose)  # noqa: E731
            poses.subscribe(PoseStamped, settings.topic_of(name), take, SENSOR)


def _named(vehicles: dict[str, CrazyflieVehicle], message: Any, info: Any) -> None:
    for named in message.poses:
        if (vehicle := vehicles.get(named.name)) is not None:
            _see(vehicle, message.header, named.pose)


def _see(vehicle: CrazyflieVehicle, header: Any, pose: Any) -> None:
    p, q = pose.position, pose.orientation
    stamp = header.stamp.sec + header.stamp.nanosec * 1e-9
    vehicle.receive_pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w), header.frame_id, stamp)


# -- what goes out ----------------------------------------------------------------------------------------------------
class BridgeOutputs:
    """Odometry, pose, status, diagnostics and events."""

    def __init__(self, node: Node, settings: SwarmSettings) -> None:
        self._clock, self._name = node.get_clock(), node.get_name()
        self._reported: dict[str, State] = {}  # the last state that was not left to the regular status
        self._odom: dict[str, Any] = {}
        self._pose: dict[str, Any] = {}
        self._state: dict[str, Any] = {}
        self._status: dict[str, Any] = {}  # Crazyswarm2's, beside ours
        self._odom_message: dict[str, Odometry] = {}
        self._wanted: dict[str, tuple[bool, bool]] = {}  # odometry, pose: is there a subscriber?
        self._counted: dict[str, tuple[int, int]] = {}
        self._critical = {robot.name: robot.battery.voltage_critical for robot in settings.robots}
        positions = settings.station.positions
        for robot in settings.robots:
            name = robot.name
            self._odom[name] = node.create_publisher(Odometry, f"{name}/odom", LATEST_ONLY)
            if not positions.enabled or positions.topic_of(name).lstrip("/") != f"{name}/pose":  # motion capture's own
                self._pose[name] = node.create_publisher(PoseStamped, f"{name}/pose", LATEST_ONLY)
            self._state[name] = node.create_publisher(StateMessage, f"{name}/{STATE}", QoSProfile(depth=10))
            if STATE != "status":
                kind = interfaces.Status
                self._status[name] = node.create_publisher(kind, f"{name}/status", QoSProfile(depth=10))
        self._events = node.create_publisher(Log, EVENTS.lstrip("/"), EVENTS_QOS)
        self._diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))

    def publish_state(self, vehicle: CrazyflieVehicle, state: VehicleState) -> None:
        """Odometry and pose of one log packet, in the link's thread, if there are subscribers.

        A new state is published at once: other vehicles may fly towards it.
        """
        name = vehicle.name
        if vehicle.state != self._reported.get(name):
            self._reported[name] = vehicle.state
            message = state_message(vehicle.snapshot(time.monotonic()), self._clock.now().to_msg())
            self._state[name].publish(message)
        odom, pose = self._wanted.get(name, (False, False))
        if not (odom or pose):
            return
        message = self._odom_message.get(name)
        if message is None:
            message = self._odom_message[name] = Odometry(child_frame_id=f"{name}/base_link")
            message.header.frame_id = FRAME
            message.pose.covariance, message.twist.covariance = POSE_COVARIANCE, TWIST_COVARIANCE
        message.header.stamp = self._clock.now().to_msg()
        p, q = message.pose.pose.position, message.pose.pose.orientation
        p.x, p.y, p.z = state.position
        q.x, q.y, q.z, q.w = state.orientation
        if odom:
            v = message.twist.twist.linear  # REP-103: the twist of an odometry is in the child's frame
            v.x, v.y, v.z = rotate_inverse(state.orientation, state.velocity)
            self._odom[name].publish(message)
        if pose:
            self._pose[name].publish(PoseStamped(header=message.header, pose=message.pose.pose))

    def publish_event(self, level: str, line: str) -> None:
        """Publish one line of the log, for a mission's record."""
        stamp = self._clock.now().to_msg()
        self._events.publish(Log(stamp=stamp, level=LEVELS.get(level, 20), name=self._name, msg=line))

    def publish_status(self, snapshots: Sequence[Snapshot]) -> None:
        """Publish the status of all; also count the subscribers of odometry and pose."""
        stamp = self._clock.now().to_msg()
        for s in snapshots:
            self._wanted[s.name] = (
                self._odom[s.name].get_subscription_count() > 0,
                s.name in self._pose and self._pose[s.name].get_subscription_count() > 0,
            )
            self._state[s.name].publish(state_message(s, stamp))
            if s.name in self._status:
                self._status[s.name].publish(self._status_message(s, stamp))

    def _status_message(self, s: Snapshot, stamp: Any) -> Any:
        """Crazyswarm2's status; the packets are those since the one before."""
        sent, received = self._counted.get(s.name, (0, 0))
        self._counted[s.name] = s.sent, s.received
        volts = s.vehicle.battery if s.vehicle else 0.0
        message = interfaces.Status(
            supervisor_info=s.vehicle.info & 0xFFFF if s.vehicle else 0, battery_voltage=volts, rssi=s.rssi,
            pm_state=LOW_POWER if s.vehicle and volts < self._critical[s.name] else 0,
            num_tx_unicast=s.sent - sent, num_rx_unicast=s.received - received,
            latency_unicast=min(round(s.latency_p99 * 1000), 0xFFFF),
        )  # fmt: skip
        message.header.stamp, message.header.frame_id = stamp, FRAME
        return message

    def publish_diagnostics(self, snapshots: Sequence[Snapshot]) -> None:
        """Diagnostics of all."""
        message = DiagnosticArray()
        message.header.stamp = self._clock.now().to_msg()
        message.status = [diagnostic(s, time.monotonic()) for s in snapshots]
        self._diagnostics.publish(message)


def state_message(s: Snapshot, stamp: Any) -> StateMessage:
    """Return a vehicle's state on the wire."""
    message = StateMessage(
        supervisor_info=s.vehicle.info & 0xFFFF if s.vehicle else 0,
        battery_voltage=s.vehicle.battery if s.vehicle else 0.0, rssi=s.rssi, link_quality=s.link_quality,
        num_tx_unicast=s.sent, num_rx_unicast=s.received, latency_ms=s.latency_p99 * 1000,
        log_age=s.log_age if math.isfinite(s.log_age) else -1.0,
        command_age=s.command_age if math.isfinite(s.command_age) else -1.0,
        state=int(s.state), state_name=s.state.name.lower(), reason=s.reason,
    )  # fmt: skip
    message.header.stamp, message.header.frame_id = stamp, FRAME
    return message


def diagnostic(s: Snapshot, now: float) -> DiagnosticStatus:
    """Return a vehicle's line in /diagnostics."""
    level = DiagnosticStatus.OK
    if s.state in (State.EMERGENCY, State.LOST):
        level = DiagnosticStatus.ERROR
    elif s.state in OFF or s.reason.startswith(("battery", "hold", "land:")):
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
    if s.tracker is not None:
        values |= position_values(s.tracker, now)
        if level == DiagnosticStatus.OK and s.tracker.rate_hz(now) == 0.0:
            level = DiagnosticStatus.WARN
    pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
    name = f"crazyflie_bridge: {s.name}"
    return DiagnosticStatus(level=level, name=name, message=s.state.name.lower(), hardware_id=s.name, values=pairs)


def position_values(tracker: PoseTracker, now: float) -> dict[str, str]:
    """Return what /diagnostics says about motion capture and one vehicle."""
    refused = ", ".join(f"{kind} {number}" for kind, number in sorted(tracker.refused.items()))
    return {
        "positions [Hz]": f"{tracker.rate_hz(now):.0f}",
        "positions sent": str(tracker.sent),
        "position age [s]": f"{tracker.age(now):.2f}",
        "position latency, median [ms]": f"{tracker.latency_quantile(0.5) * 1000:.1f}",
        "position latency, 99th percentile [ms]": f"{tracker.latency_quantile(0.99) * 1000:.1f}",
        "positions refused": refused or "0",
        "last refusal": tracker.reason,
    }
