"""Topics and services of all vehicles: what comes in, and what goes out. Names, units and frames are Crazyswarm2's.

Places are in the Crazyflies' world (z = 0 is the floor), yaw of services in radians.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from builtin_interfaces.msg import Duration as DurationMsg
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from dtsa_msgs.msg import Status as StateMessage
from geometry_msgs.msg import Point, PoseStamped
from nav_msgs.msg import Odometry
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from std_msgs.msg import Empty as EmptyMsg
from std_srvs.srv import Empty, SetBool, Trigger

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.crazyflie.bridge import Bridge
from dtsa_agent.crazyflie.commands import FULL_STATE, POSITION, VELOCITY_WORLD, TopicThread, of_message
from dtsa_agent.crazyflie.positions import NAMED_POSES, PositionSettings, quantile
from dtsa_agent.crazyflie.state import OFF, State, VehicleState, place_text, rotate_inverse
from dtsa_agent.crazyflie.vehicle import CrazyflieVehicle
from dtsa_agent.ros.common.cdr import UNKNOWN, diagonal

from .interfaces import STATE, TRAJECTORIES, msg, srv
from .parameters import declare_firmware

FRAME = "world"
LATEST_ONLY = QoSProfile(depth=1)
# Takes reliable publishers and others; a pose that is late is worth nothing.
SENSOR = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
ARMED_S, ARMED_POLL_S = 3.0, 0.02  # longest wait for motors that are to run, or to be locked
LOW_POWER = 3  # pm_state
MAX_CLOCK_S = 0.1  # a sender's clock that is wrong makes a command at most so much older
# The firmware logs no variances: standard deviations of 3 cm, 0.1 rad and 0.1 m/s are cautious for its estimator with a
# positioning system. Body rates are not logged.
POSE_COVARIANCE = diagonal(0.03**2, 0.1**2)
TWIST_COVARIANCE = diagonal(0.1**2, UNKNOWN)
Order = Callable[[CrazyflieVehicle, Any], str | None]  # of a request to a vehicle; why not, if it is refused


def seconds(duration: DurationMsg) -> float:
    """Return a duration of a message, s."""
    return float(duration.sec + duration.nanosec * 1e-9)


def _short(value: Any) -> str:
    if isinstance(value, DurationMsg):
        return f"{seconds(value):g} s"
    if isinstance(value, Point):
        return place_text((value.x, value.y, value.z))
    return f"{value:g}" if isinstance(value, float) else str(value)


# Services that take an order to one or all; the last one tells programs that all are there.
ORDERS: list[tuple[Any, str, Order | None]] = [
    *((kind, name, None) for kind, name in TRAJECTORIES),
    (srv.Takeoff, "takeoff", lambda v, r: v.takeoff(r.height, seconds(r.duration))),
    (srv.Land, "land", lambda v, r: v.land("service", r.height, seconds(r.duration))),
    (srv.GoTo, "go_to", lambda v, r: v.go_to((r.goal.x, r.goal.y, r.goal.z), r.yaw, seconds(r.duration), r.relative)),
    (srv.Arm, "arm", lambda v, r: v.arm(r.arm)),
    (srv.NotifySetpointsStop, "notify_setpoints_stop", lambda v, r: v.notify_setpoints_stop(r.remain_valid_millisecs)),
    (Empty, "emergency", lambda v, r: v.stop("service emergency")),
]
STREAMS = (
    (msg.FullState, "cmd_full_state", FULL_STATE),
    (msg.Position, "cmd_position", POSITION),
    (msg.VelocityWorld, "cmd_velocity_world", VELOCITY_WORLD),
)


# -- what comes in ----------------------------------------------------------------------------------------------------
class BridgeInputs:
    """Streamed commands, services, the ground station's heartbeat.

    :param commands: reads the streamed commands; not started yet.
    """

    def __init__(self, node: Node, bridge: Bridge, commands: TopicThread, log: Callable[[str, str], None]) -> None:
        self._node, self._bridge, self._commands, self._log = node, bridge, commands, log
        self._on_board = bridge.settings.station.on_board.enabled
        self._waiting = ReentrantCallbackGroup()  # of services that wait: the others are served meanwhile
        self._masks = {name: vehicle.robot.group_mask for name, vehicle in bridge.vehicles.items()}

    def offer(self) -> None:
        """Create everything; `/all/emergency` is last: a program that waits for it knows that all else is there."""
        declare_firmware(self._node, self._bridge, self._log, self._masks)
        for name, vehicle in self._bridge.vehicles.items():
            for message, topic, kind in () if self._on_board else STREAMS:  # agents on board steer themselves
                self._commands.subscribe(message, f"{name}/{topic}", partial(self._stream, kind, vehicle), LATEST_ONLY)
            self._create_services(name, [name])
            self._node.create_service(Trigger, f"{name}/reconnect", partial(self._reconnect, name))
        self._commands.start()
        self._node.create_subscription(EmptyMsg, "all/heartbeat", self._note_heartbeat, LATEST_ONLY)
        self._node.create_service(Trigger, "all/end_heartbeat", self._end_heartbeat)
        self._create_services("all", list(self._bridge.vehicles))

    def _create_services(self, prefix: str, names: list[str]) -> None:
        enable: list[tuple[Any, str, Order]] = [(SetBool, "enable", lambda v, r: v.enable(r.data))]
        for kind, service, order in [*(enable if self._on_board else []), *ORDERS]:
            group = self._waiting if service == "arm" else None
            callback = partial(self._serve, prefix, names, service, order)
            self._node.create_service(kind, f"{prefix}/{service}", callback, callback_group=group)

    async def _serve(
        self, prefix: str, names: list[str], service: str, order: Order | None, request: Any, response: Any
    ) -> Any:
        """Carry out an order, and say so: what an operator did belongs to what happened."""
        try:
            done, text = self._carry_out(names, service, order, request)
            if service == "arm":
                done, text = await self._wait_armed(names, request.arm, done, text)
        except Exception as error:  # of this order: emergency stops must still be answered
            done, text = False, f"{type(error).__name__}: {error}"
        fields = ", ".join(f"{key} {_short(getattr(request, key))}" for key in request.get_fields_and_field_types())
        self._log("info" if done else "warn", f"order /{prefix}/{service} ({fields}): {'done' if done else text}")
        if hasattr(response, "success"):
            response.success, response.message = done, text
        return response

    def _carry_out(self, names: list[str], service: str, order: Order | None, request: Any) -> tuple[bool, str]:
        """Give an order to those that are addressed: all in group 0, else those in one of these groups."""
        group = getattr(request, "group_mask", 0)
        members = [name for name in names if not group or self._masks[name] & group]
        if order is None:
            return False, "trajectories are not supported: send positions, velocities or go_to"
        if service == "emergency":
            for name in names:
                order(self._bridge.vehicles[name], request)
            self._log("error", f"EMERGENCY STOP of {', '.join(names)}: service")
            return True, ""
        if not members:
            return False, f"none of {', '.join(names)} is in a group of {group}"
        if service == "takeoff" and (problem := self._bridge.why_no_takeoff()):
            return False, problem
        if service == "go_to" and len(members) > 1 and not request.relative:
            return False, "a go_to of all must be relative: they would meet in one place"
        done, text = self._bridge.order_each(members, lambda vehicle: order(vehicle, request))
        notes = [self._bridge.vehicles[name].longer for name in members] if service == "land" else []
        return done, "; ".join(filter(None, (text, *notes)))

    async def _wait_armed(self, names: list[str], arm: bool, done: bool, text: str) -> tuple[bool, str]:
        """Wait until motors may run, or are locked; the executor serves others meanwhile."""
        wanted, before = (State.ARMED, State.READY) if arm else (State.READY, State.ARMED)
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

    def _stream(self, kind: str, vehicle: CrazyflieVehicle, message: Any, published: float) -> None:
        """Give a message, published at a Unix time (s), to its vehicle, and say why it does not count."""
        stamp = time.monotonic() - min(max(time.time() - published, 0.0), MAX_CLOCK_S)  # as old as its publication
        try:
            problem = vehicle.command(of_message(kind, message, vehicle.station.room_origin_in_world, stamp))
        except ValueError as error:
            vehicle.refused, problem = vehicle.refused + 1, str(error)
        if problem:
            self._node.get_logger().warning(f"{vehicle.name}: {problem}", throttle_duration_sec=1.0)

    def _reconnect(self, name: str, request: Any, response: Any) -> Any:
        problem = self._bridge.reconnect(name)
        response.success, response.message = not problem, problem or "connecting"
        return response

    def _note_heartbeat(self, message: Any) -> None:
        self._bridge.heartbeat = time.monotonic()

    def _end_heartbeat(self, request: Any, response: Any) -> Any:
        self._bridge.heartbeat, response.success = None, True
        return response


# -- motion capture ---------------------------------------------------------------------------------------------------
def subscribe_positions(poses: TopicThread, settings: PositionSettings, vehicles: dict[str, CrazyflieVehicle]) -> None:
    """Listen to motion capture, if there is one, in a thread that is not started yet.

    :raises ConfigError: the package of the named poses is not in the workspace.
    """

    def receive_named(message: Any, _: float) -> None:
        for named in message.poses:
            if named.name in vehicles:
                _receive(vehicles[named.name], message.header, named.pose)

    if settings.source == NAMED_POSES:
        try:
            from motion_capture_tracking_interfaces.msg import NamedPoseArray
        except ImportError:
            allowed = "pose, or named_poses with motion_capture_tracking_interfaces in the workspace (it is not there)"
            raise ConfigError("station.positions.source", NAMED_POSES, allowed) from None
        for topic in sorted({settings.topic_of(name) for name in vehicles}):
            poses.subscribe(NamedPoseArray, topic, receive_named, SENSOR)
    elif settings.enabled:
        for name, vehicle in vehicles.items():
            receive = lambda message, _, vehicle=vehicle: _receive(vehicle, message.header, message.pose)  # noqa: E731
            poses.subscribe(PoseStamped, settings.topic_of(name), receive, SENSOR)


def _receive(vehicle: CrazyflieVehicle, header: Any, pose: Any) -> None:
    p, q = pose.position, pose.orientation
    stamp = header.stamp.sec + header.stamp.nanosec * 1e-9
    vehicle.receive_pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w), header.frame_id, stamp)


# -- what goes out ----------------------------------------------------------------------------------------------------
class VehicleOutputs:
    """Odometry, pose and status of one vehicle. There is no topic of poses where motion capture's has its name."""

    def __init__(self, node: Node, name: str, positions: PositionSettings) -> None:
        self._clock = node.get_clock()
        self._odom = node.create_publisher(Odometry, f"{name}/odom", LATEST_ONLY)
        captured = positions.enabled and positions.topic_of(name).lstrip("/") == f"{name}/pose"
        self._pose = None if captured else node.create_publisher(PoseStamped, f"{name}/pose", LATEST_ONLY)
        self._state = node.create_publisher(StateMessage, f"{name}/{STATE}", 10)
        ours = STATE == "status"  # Crazyswarm2's status is published beside ours
        self._status = None if ours else node.create_publisher(msg.Status, f"{name}/status", 10)
        self._reported: State | None = None  # the last state that was not left to the regular status
        self._odom_wanted = self._pose_wanted = False  # is there a subscriber?
        self._counted = 0, 0  # packets sent and received up to the last status
        self._message = Odometry(child_frame_id=f"{name}/base_link")
        self._message.header.frame_id = FRAME
        self._message.pose.covariance, self._message.twist.covariance = POSE_COVARIANCE, TWIST_COVARIANCE

    def publish_report(self, vehicle: CrazyflieVehicle, report: VehicleState, taken: float) -> None:
        """Odometry and pose of one log packet, in the link's thread, if there are subscribers.

        They are stamped with when their values were taken (s, monotonic): a packet waits for its turn on the air. A new
        state is published at once: other vehicles may fly towards it.
        """
        now, message = self._clock.now(), self._message
        if vehicle.state != self._reported:
            self._reported = vehicle.state
            self._state.publish(state_message(vehicle, now.to_msg()))
        if not (self._odom_wanted or self._pose_wanted):
            return
        message.header.stamp = (now - Duration(seconds=time.monotonic() - taken)).to_msg()
        p, q = message.pose.pose.position, message.pose.pose.orientation
        p.x, p.y, p.z = report.position
        q.x, q.y, q.z, q.w = report.orientation
        if self._odom_wanted:
            v = message.twist.twist.linear  # REP-103: the twist of an odometry is in the child's frame
            v.x, v.y, v.z = rotate_inverse(report.orientation, report.velocity)
            self._odom.publish(message)
        if self._pose_wanted and self._pose is not None:
            self._pose.publish(PoseStamped(header=message.header, pose=message.pose.pose))

    def publish_status(self, vehicle: CrazyflieVehicle) -> None:
        """Publish the status, ours and Crazyswarm2's; also count the subscribers of odometry and pose."""
        self._odom_wanted = self._odom.get_subscription_count() > 0
        self._pose_wanted = self._pose is not None and self._pose.get_subscription_count() > 0
        ours = state_message(vehicle, self._clock.now().to_msg())
        self._state.publish(ours)
        if self._status is not None:  # its packets are those since the one before
            (sent, received), critical = self._counted, vehicle.robot.battery.voltage_critical
            self._counted = ours.num_tx_unicast, ours.num_rx_unicast
            message = msg.Status(
                header=ours.header, supervisor_info=ours.supervisor_info, battery_voltage=ours.battery_voltage,
                rssi=ours.rssi, pm_state=LOW_POWER if 0.0 < ours.battery_voltage < critical else 0,
                num_tx_unicast=ours.num_tx_unicast - sent, num_rx_unicast=ours.num_rx_unicast - received,
                latency_unicast=min(round(ours.latency_ms), 0xFFFF),
            )  # fmt: skip
            self._status.publish(message)


def state_message(vehicle: CrazyflieVehicle, stamp: Any) -> StateMessage:
    """Return a vehicle's state on the wire; ages of what never came are -1."""
    now, last, link = time.monotonic(), vehicle.last, vehicle.link
    log_age, command_age = (a if math.isfinite(a) else -1.0 for a in (vehicle.log_age(now), vehicle.command_age(now)))
    message = StateMessage(
        supervisor_info=last.info & 0xFFFF if last else 0, battery_voltage=last.battery if last else 0.0,
        rssi=getattr(link.driver, "rssi", 0), link_quality=vehicle.link_quality(now), num_tx_unicast=link.sent,
        num_rx_unicast=link.received, latency_ms=vehicle.command_rate(now)[1] * 1000, log_age=log_age,
        command_age=command_age, state=int(vehicle.state), state_name=vehicle.state.name.lower(), reason=vehicle.action,
    )  # fmt: skip
    message.header.stamp, message.header.frame_id = stamp, FRAME
    return message


def diagnostic(vehicle: CrazyflieVehicle, now: float) -> DiagnosticStatus:
    """Return what /diagnostics says about a vehicle, and about motion capture, if there is any."""
    level, state, reason, tracker = DiagnosticStatus.OK, vehicle.state, vehicle.action, vehicle.tracker
    silent = tracker.settings.enabled and tracker.rate_hz(now) == 0.0
    if state in (State.EMERGENCY, State.LOST):
        level = DiagnosticStatus.ERROR
    elif state in OFF or reason.startswith(("battery", "hold", "land:")) or silent:
        level = DiagnosticStatus.WARN
    rate, latency = vehicle.command_rate(now)
    values = {
        "battery [V]": f"{vehicle.last.battery:.2f}" if vehicle.last else "unknown",
        "link quality": f"{vehicle.link_quality(now):.2f}",
        "log age [s]": f"{vehicle.log_age(now):.2f}",
        "last command age [s]": f"{vehicle.command_age(now):.2f}",
        "commands [Hz]": f"{rate:.0f}",
        "command latency, 99th percentile [ms]": f"{latency * 1000:.1f}",
        "commands refused": str(vehicle.refused),
        "reason": reason,
    }
    if tracker.settings.enabled:
        refused = ", ".join(f"{kind} {number}" for kind, number in sorted(tracker.refused.items()))
        values |= {
            "positions [Hz]": f"{tracker.rate_hz(now):.0f}",
            "positions sent": str(tracker.sent),
            "position age [s]": f"{tracker.age(now):.2f}",
            "position latency, median [ms]": f"{quantile(tracker.latencies, 0.5) * 1000:.1f}",
            "position latency, 99th percentile [ms]": f"{quantile(tracker.latencies, 0.99) * 1000:.1f}",
            "positions refused": refused or "0",
            "last refusal": tracker.reason,
        }
    return DiagnosticStatus(
        level=level, name=f"crazyflie_bridge: {vehicle.name}", message=state.name.lower(), hardware_id=vehicle.name,
        values=[KeyValue(key=key, value=value) for key, value in values.items()],
    )  # fmt: skip
