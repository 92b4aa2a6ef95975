"""What comes in over the graph: streamed commands, services, the ground station's heartbeat, motion capture."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from builtin_interfaces.msg import Duration as DurationMsg
from dtsa_msgs.msg import FullState, Position, VelocityWorld
from dtsa_msgs.srv import Arm, GoTo, Land, NotifySetpointsStop, Takeoff
from geometry_msgs.msg import Point, PoseStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Empty as EmptyMsg
from std_srvs.srv import Empty, SetBool, Trigger

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.crazyflie.motion.limits import check_stream
from dtsa_agent.crazyflie.positions.motion_capture import NAMED_POSES, PositionSettings
from dtsa_agent.crazyflie.state import conversions
from dtsa_agent.crazyflie.state.conversions import to_world
from dtsa_agent.crazyflie.vehicle.vehicle import Vehicle

from .bridge import Bridge
from .command_thread import CommandThread

MAX_CLOCK_S = 0.1
LATEST_ONLY = QoSProfile(depth=1)
# Whoever publishes, reliably or not; a pose that is late is worth nothing.
SENSOR = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


def seconds(duration: DurationMsg) -> float:
    """A duration of a message, s."""
    return duration.sec + duration.nanosec * 1e-9


def _short(value: Any) -> str:
    """A field of a request for people."""
    if isinstance(value, DurationMsg):
        return f"{seconds(value):g} s"
    if isinstance(value, Point):
        return conversions.place_text((value.x, value.y, value.z))
    return f"{value:g}" if isinstance(value, float) else str(value)


def helper_node(node: Node, name: str) -> Node:
    """A node beside another one, with a longer name, whose topics are read by a thread of their own."""
    return Node(
        f"{node.get_name()}_{name}",
        namespace=node.get_namespace(),
        context=node.context,
        enable_rosout=False,
        start_parameter_services=False,
        use_global_arguments=False,
    )


@dataclass(frozen=True, slots=True)
class Types:
    """Messages of the streamed commands and services: ours, or others with the same fields."""

    full_state: Any = FullState
    position: Any = Position
    velocity_world: Any = VelocityWorld
    takeoff: Any = Takeoff
    land: Any = Land
    go_to: Any = GoTo
    arm: Any = Arm
    notify_setpoints_stop: Any = NotifySetpointsStop


class Inputs:
    """Topics and services of all vehicles.

    :param commands: reads the streamed commands; not started yet.
    """

    types = Types()

    def __init__(self, node: Node, bridge: Bridge, commands: CommandThread, say: Callable[[str, str], None]) -> None:
        self._say = say
        self._node, self._bridge, self._commands = node, bridge, commands
        self._origin = bridge.settings.station.room_origin_in_world
        self._on_board = bridge.settings.station.on_board.on

    def offer(self) -> None:
        """Create everything; `/all/emergency` is last: whoever waits for it knows that everything else is there."""
        streams = (
            (self.types.full_state, "cmd_full_state", self._full_state),
            (self.types.position, "cmd_position", self._position),
            (self.types.velocity_world, "cmd_velocity_world", self._velocity_world),
        )
        for vehicle in self._bridge.vehicles.values():
            name = vehicle.name
            for kind, topic, callback in () if self._on_board else streams:  # agents on board steer themselves
                self._commands.subscribe(
                    kind, f"{name}/{topic}", partial(self._command, vehicle, callback), LATEST_ONLY
                )
            self._create_services(name, [name])
            self._node.create_service(Trigger, f"{name}/reconnect", partial(self._reconnect, name))
        self._commands.start()
        self._node.create_subscription(EmptyMsg, "all/heartbeat", lambda _: self._bridge.heartbeat(), LATEST_ONLY)
        self._node.create_service(Trigger, "all/end_heartbeat", self._end_heartbeat)
        self._create_services("all", list(self._bridge.vehicles))

    def _create_services(self, prefix: str, names: list[str]) -> None:
        for kind, service, callback in self._services():
            name = f"{prefix}/{service}"
            self._node.create_service(kind, name, partial(self._ordered, name, partial(callback, names)))

    def _services(self) -> list[tuple[Any, str, Callable[[list[str], Any, Any], Any]]]:
        """Type, name and callback of each service that takes an order to one or all; `emergency` is the last."""
        enable = [(SetBool, "enable", self._enable)] if self._on_board else []
        return [
            *enable,
            (self.types.takeoff, "takeoff", self._takeoff),
            (self.types.land, "land", self._land),
            (self.types.go_to, "go_to", self._go_to),
            (self.types.arm, "arm", self._arm),
            (self.types.notify_setpoints_stop, "notify_setpoints_stop", self._notify),
            (Empty, "emergency", self._emergency),
        ]

    def _ordered(self, name: str, callback: Callable[[Any, Any], Any], request: Any, response: Any) -> Any:
        """Carry out an order, and say so: what an operator did belongs to what happened."""
        result = callback(request, response)
        fields = ", ".join(f"{key} {_short(getattr(request, key))}" for key in request.get_fields_and_field_types())
        answer = "" if getattr(result, "success", True) else f": {result.message}"
        self._say("info" if not answer else "warn", f"order /{name} ({fields}){answer or ': done'}")
        return result

    # -- commands ---------------------------------------------------------------------------------------------------
    def _command(
        self, vehicle: Vehicle, convert: Callable[[Any, float], conversions.Setpoint], message: Any, info: Any
    ) -> None:
        # The command is as old as its publication; a sender's clock that is wrong makes it at most a tenth older.
        age = (time.time_ns() - info["source_timestamp"]) * 1e-9
        try:
            setpoint = convert(message, time.monotonic() - min(max(age, 0.0), MAX_CLOCK_S))
            check_stream(setpoint, vehicle.station)
        except ValueError as error:
            vehicle.refused += 1
            self._node.get_logger().warning(f"{vehicle.name}: {error}", throttle_duration_sec=1.0)
            return
        if not vehicle.command(setpoint):
            self._node.get_logger().warning(
                f"{vehicle.name}: commands are not accepted while {vehicle.state.name.lower()} ({vehicle.action})",
                throttle_duration_sec=5.0,
            )

    def _world(self, frame: str, x: float, y: float, z: float) -> conversions.Vector:
        return (x, y, z) if frame == "world" else to_world((x, y, z), self._origin)

    def _full_state(self, m: Any, stamp: float) -> conversions.Setpoint:
        p, q, v, w, a = m.pose.position, m.pose.orientation, m.twist.linear, m.twist.angular, m.acc
        place = self._world(m.header.frame_id, p.x, p.y, p.z)
        return conversions.full_state(
            place, (v.x, v.y, v.z), (a.x, a.y, a.z), (q.x, q.y, q.z, q.w), (w.x, w.y, w.z), stamp
        )

    def _position(self, m: Any, stamp: float) -> conversions.Setpoint:
        return conversions.position(self._world(m.header.frame_id, m.x, m.y, m.z), m.yaw, stamp)

    def _velocity_world(self, m: Any, stamp: float) -> conversions.Setpoint:
        return conversions.velocity_world((m.vel.x, m.vel.y, m.vel.z), m.yaw_rate, stamp)

    # -- services ---------------------------------------------------------------------------------------------------
    def _groups(self, name: str) -> int:
        """The groups that a vehicle belongs to, a bit each."""
        return self._bridge.vehicles[name].robot.group_mask

    def _each(self, names: list[str], order: Callable[[Vehicle], str | None], response: Any, group: int = 0) -> Any:
        """Give an order to those that are addressed (group 0: to all of them; else to those in one of these groups)."""
        if group:
            members = [name for name in names if self._groups(name) & group]
            if not members:
                response.success, response.message = False, f"nobody of {', '.join(names)} is in a group of {group}"
                return response
            names = members
        response.success, response.message = self._bridge.each(names, order)
        return response

    def _takeoff(self, names: list[str], request: Any, response: Any) -> Any:
        problem = self._bridge.enough()
        if problem:
            self._node.get_logger().error(f"no take-off: {problem}")
            response.success, response.message = False, problem
            return response
        duration = seconds(request.duration)
        return self._each(names, lambda v: self._climb(v, request.height, duration), response, request.group_mask)

    def _climb(self, vehicle: Vehicle, height: float, duration: float) -> str:
        return vehicle.takeoff(height, duration)

    def _land(self, names: list[str], request: Any, response: Any) -> Any:
        duration = seconds(request.duration)
        notes: list[str] = []
        self._each(
            names,
            lambda v: v.land("service", request.height, duration, notes.append),
            response,
            request.group_mask,
        )
        response.message = "; ".join(filter(None, (response.message, *notes)))
        return response

    def _go_to(self, names: list[str], request: Any, response: Any) -> Any:
        goal, duration = request.goal, seconds(request.duration)
        place = (goal.x, goal.y, goal.z)
        if not all(math.isfinite(v) for v in (*place, request.yaw)):
            response.success, response.message = False, "the goal is not finite"
            return response
        if not request.relative:
            place = self._world("", *place)
        return self._each(
            names,
            lambda v: v.go_to(place, request.yaw, duration, request.relative),
            response,
            request.group_mask,
        )

    def _arm(self, names: list[str], request: Any, response: Any) -> Any:
        return self._each(names, lambda v: v.arm(request.arm), response)

    def _enable(self, names: list[str], request: Any, response: Any) -> Any:
        return self._each(names, lambda v: v.enable(request.data), response)

    def _notify(self, names: list[str], request: Any, response: Any) -> Any:
        valid_ms = request.remain_valid_millisecs
        return self._each(names, lambda v: v.notify_setpoints_stop(valid_ms), response, request.group_mask)

    def _emergency(self, names: list[str], request: Any, response: Any) -> Any:
        for name in names:
            self._bridge.vehicles[name].stop("service emergency")
        self._node.get_logger().error(f"EMERGENCY STOP of {', '.join(names)}: service")
        return response

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
    """The type of the named poses.

    :raises ConfigError: its package is not in the workspace.
    """
    try:
        from motion_capture_tracking_interfaces.msg import NamedPoseArray
    except ImportError:
        raise ConfigError(
            "station.positions.source", NAMED_POSES,
            "pose, or named_poses with the package motion_capture_tracking_interfaces in the workspace (it is not)",
        ) from None  # fmt: skip
    return NamedPoseArray


def subscribe_positions(poses: CommandThread, settings: PositionSettings, vehicles: dict[str, Vehicle]) -> None:
    """Listen to motion capture, if there is one, in a thread that is not started yet.

    :raises ConfigError: the type of the named poses is not there.
    """
    if settings.source == NAMED_POSES:
        for topic in sorted({settings.topic_of(name) for name in vehicles}):
            poses.subscribe(named_pose_array(), topic, partial(_named, vehicles), SENSOR)
    elif settings.on:
        for name, vehicle in vehicles.items():
            poses.subscribe(PoseStamped, settings.topic_of(name), partial(_one, vehicle), SENSOR)


def _one(vehicle: Vehicle, message: PoseStamped, info: Any) -> None:
    _pass_on(vehicle, message.header, message.pose)


def _named(vehicles: dict[str, Vehicle], message: Any, info: Any) -> None:
    for named in message.poses:
        if (vehicle := vehicles.get(named.name)) is not None:
            _pass_on(vehicle, message.header, named.pose)


def _pass_on(vehicle: Vehicle, header: Any, pose: Any) -> None:
    p, q = pose.position, pose.orientation
    stamp = header.stamp.sec + header.stamp.nanosec * 1e-9
    vehicle.see((p.x, p.y, p.z), (q.x, q.y, q.z, q.w), header.frame_id, stamp)
