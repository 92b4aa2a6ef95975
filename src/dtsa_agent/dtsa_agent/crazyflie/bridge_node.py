"""The bridge as a ROS node: `ros2 run dtsa_agent crazyflie_bridge --ros-args -p config:=swarm.yaml`.

Topics and services have the names that Crazyswarm2's users know. The node is a thin shell: everything that decides is
in `bridge`, `vehicle` and `safety`.
"""

from __future__ import annotations

import dataclasses
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from builtin_interfaces.msg import Duration as DurationMsg
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from dtsa_msgs.msg import FullState, Hover, Position, Status, VelocityWorld
from dtsa_msgs.srv import Arm, GoTo, Land, NotifySetpointsStop, Takeoff
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Empty as EmptyMsg
from std_srvs.srv import Empty, Trigger

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.crazyflie import units
from dtsa_agent.crazyflie.bridge import Bridge
from dtsa_agent.crazyflie.config import SwarmSettings, load_swarm
from dtsa_agent.crazyflie.pump import CommandPump
from dtsa_agent.crazyflie.safety import SafetySettings
from dtsa_agent.crazyflie.state_machine import State
from dtsa_agent.crazyflie.units import VehicleState, to_map, to_world
from dtsa_agent.crazyflie.vehicle import Snapshot, Vehicle
from dtsa_agent.ros.process import follow_supervisor

STATUS_HZ = 5.0
SWITCH_S = 0.0005
MAX_CLOCK_S = 0.1
LATEST_ONLY = QoSProfile(depth=1)
FRAME = "map"


def _seconds(duration: DurationMsg) -> float:
    return duration.sec + duration.nanosec * 1e-9


def safety_parameters(node: Node, given: SafetySettings) -> SafetySettings:
    """Declare one parameter a safety setting; a parameter that was set beats the YAML's value.

    :raises ConfigError: a value is out of range.
    """
    values: dict[str, Any] = {}
    for field in dataclasses.fields(SafetySettings):
        meta = field.metadata
        unit = f" [{meta['unit']}]" if meta.get("unit") else ""
        descriptor = ParameterDescriptor(description=meta["help"] + unit, read_only=True)
        if meta.get("minimum") is not None and isinstance(getattr(given, field.name), float):
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(meta["minimum"]), to_value=float(meta["maximum"]), step=0.0)
            ]
        default = getattr(given, field.name)
        default = list(default) if isinstance(default, tuple) else default
        try:
            value = node.declare_parameter(f"safety.{field.name}", default, descriptor).value
        except Exception as error:  # rclpy has a class of its own for each way to be wrong
            raise ConfigError(f"safety.{field.name}", "see the message", str(error)) from error
        values[field.name] = tuple(value) if isinstance(value, (list, tuple)) or hasattr(value, "typecode") else value
    return SafetySettings(**values)


class BridgeNode(Node):
    """ROS side of the bridge.

    :param config: the swarm's YAML; None: the node's parameter `config`.
    :raises ConfigError: the configuration is not usable.
    """

    def __init__(self, config: Path | None = None, **node_options: Any) -> None:
        super().__init__("crazyflie_bridge", enable_rosout=False, **node_options)
        given = self.declare_parameter(
            "config", str(config or ""), ParameterDescriptor(description="the swarm's YAML file", read_only=True)
        ).value
        if not given:
            raise ConfigError("config", "", "the path of a swarm's YAML file")
        settings = load_swarm(Path(given))
        safety = safety_parameters(self, settings.station.safety)
        station = dataclasses.replace(settings.station, safety=safety)
        self.settings = SwarmSettings(settings.robots, station)
        self.origin = station.room_origin_in_world
        self._odom: dict[str, Any] = {}
        self._pose: dict[str, Any] = {}
        self._status: dict[str, Any] = {}
        self._odom_message: dict[str, Odometry] = {}
        self._last_state: dict[str, State] = {}
        for robot in self.settings.robots:
            name = robot.name
            self._odom[name] = self.create_publisher(Odometry, f"{name}/odom", LATEST_ONLY)
            self._pose[name] = self.create_publisher(PoseStamped, f"{name}/pose", LATEST_ONLY)
            self._status[name] = self.create_publisher(Status, f"{name}/status", QoSProfile(depth=10))
        self.diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))
        self._wanted: dict[str, tuple[bool, bool]] = {}
        self._commands = Node(
            "crazyflie_bridge_commands",
            namespace=self.get_namespace(),
            context=self.context,
            enable_rosout=False,
            start_parameter_services=False,
            use_global_arguments=False,
        )
        self.pump = CommandPump(self._commands)
        self.bridge = Bridge(self.settings, self.say, self._publish_state)

    def close(self) -> None:
        """End of what this node added to itself."""
        self.pump.close()
        self._commands.destroy_node()
        self.destroy_node()

    def say(self, level: str, line: str) -> None:
        """One line in the log."""
        logger = self.get_logger()  # rclpy wants each place in the code to keep to one level
        if level == "error":
            logger.error(line)
        elif level == "warn":
            logger.warning(line)
        else:
            logger.info(line)

    # -- connection -------------------------------------------------------------------------------------------------
    def start(self, stop: Callable[[], bool] = lambda: False) -> str:
        """Connect all, then offer topics and services; why the swarm cannot fly, or an empty text.

        :param stop: asked ten times a second; True ends the wait for the connections.
        """
        began = time.monotonic()
        missing = self.bridge.connect(stop=stop)
        if stop():
            return "interrupted while connecting"
        total = len(self.bridge.vehicles)
        self.say("info", f"{total - len(missing)} of {total} connected in {time.monotonic() - began:.2f} s")
        if missing:
            self.say("warn", f"not connected: {', '.join(missing)} (service reconnect)")
        if self.bridge.connected < self.settings.station.min_connected:
            return f"{self.bridge.connected} connected, min_connected is {self.settings.station.min_connected}"
        self._create_interfaces()
        self.create_timer(1.0 / STATUS_HZ, self._publish_status)
        self.create_timer(1.0, self._publish_diagnostics)
        return ""

    def _create_interfaces(self) -> None:
        for vehicle in self.bridge.vehicles.values():
            name = vehicle.name
            for kind, topic, callback in (
                (FullState, "cmd_full_state", self._full_state),
                (Position, "cmd_position", self._position),
                (VelocityWorld, "cmd_velocity_world", self._velocity_world),
                (Hover, "cmd_hover", self._hover),
            ):
                self.pump.subscribe(kind, f"{name}/{topic}", partial(self._command, vehicle, callback), LATEST_ONLY)
            self._create_services(name, [name])
            self.create_service(Trigger, f"{name}/reconnect", partial(self._reconnect, name))
        self.pump.start()
        self.create_subscription(EmptyMsg, "all/heartbeat", lambda _: self.bridge.heartbeat(), LATEST_ONLY)
        self.create_service(Trigger, "all/end_heartbeat", self._end_heartbeat)
        # all/emergency is created last: whoever waits for it knows that everything else is there.
        self._create_services("all", list(self.bridge.vehicles))

    def _create_services(self, prefix: str, names: list[str]) -> None:
        self.create_service(Takeoff, f"{prefix}/takeoff", partial(self._takeoff, names))
        self.create_service(Land, f"{prefix}/land", partial(self._land, names))
        self.create_service(GoTo, f"{prefix}/go_to", partial(self._go_to, names))
        self.create_service(Arm, f"{prefix}/arm", partial(self._arm, names))
        self.create_service(NotifySetpointsStop, f"{prefix}/notify_setpoints_stop", partial(self._notify, names))
        self.create_service(Empty, f"{prefix}/emergency", partial(self._emergency, names))

    # -- commands ---------------------------------------------------------------------------------------------------
    def _command(
        self, vehicle: Vehicle, convert: Callable[[Any, float], units.Setpoint], message: Any, info: Any
    ) -> None:
        # The command is as old as its publication; a sender's clock that is wrong makes it at most a tenth older.
        age = (time.time_ns() - info["source_timestamp"]) * 1e-9
        try:
            setpoint = convert(message, time.monotonic() - min(max(age, 0.0), MAX_CLOCK_S))
        except ValueError as error:
            self.get_logger().warning(f"{vehicle.name}: {error}", throttle_duration_sec=1.0)
            return
        if not vehicle.command(setpoint):
            self.get_logger().warning(
                f"{vehicle.name}: commands are not accepted while {vehicle.state.name.lower()} ({vehicle.action})",
                throttle_duration_sec=5.0,
            )

    def _world(self, frame: str, x: float, y: float, z: float) -> units.Vector:
        return (x, y, z) if frame == "world" else to_world((x, y, z), self.origin)

    def _full_state(self, m: FullState, stamp: float) -> units.Setpoint:
        p, q, v, w, a = m.pose.position, m.pose.orientation, m.twist.linear, m.twist.angular, m.acc
        place = self._world(m.header.frame_id, p.x, p.y, p.z)
        return units.full_state(place, (v.x, v.y, v.z), (a.x, a.y, a.z), (q.x, q.y, q.z, q.w), (w.x, w.y, w.z), stamp)

    def _position(self, m: Position, stamp: float) -> units.Setpoint:
        return units.position(self._world(m.header.frame_id, m.x, m.y, m.z), m.yaw, stamp)

    def _velocity_world(self, m: VelocityWorld, stamp: float) -> units.Setpoint:
        return units.velocity_world((m.vel.x, m.vel.y, m.vel.z), m.yaw_rate, stamp)

    def _hover(self, m: Hover, stamp: float) -> units.Setpoint:
        return units.hover(m.vx, m.vy, m.yaw_rate, m.z_distance, stamp)

    # -- services ---------------------------------------------------------------------------------------------------
    def _each(self, names: list[str], order: Callable[[Vehicle], str | None], response: Any) -> Any:
        response.success, response.message = self.bridge.each(names, order)
        return response

    def _takeoff(self, names: list[str], request: Any, response: Any) -> Any:
        problem = self.bridge.enough()
        if problem:
            self.say("error", f"no take-off: {problem}")
            response.success, response.message = False, problem
            return response
        return self._each(names, lambda v: v.takeoff(request.height, _seconds(request.duration)), response)

    def _land(self, names: list[str], request: Any, response: Any) -> Any:
        duration = _seconds(request.duration)
        notes: list[str] = []
        self._each(names, lambda v: v.land("service", request.height, duration, notes.append), response)
        response.message = "; ".join(filter(None, (response.message, *notes)))
        return response

    def _go_to(self, names: list[str], request: Any, response: Any) -> Any:
        goal, duration = request.goal, _seconds(request.duration)
        place = (goal.x, goal.y, goal.z)
        if not all(math.isfinite(v) for v in (*place, request.yaw)):
            response.success, response.message = False, "the goal is not finite"
            return response
        if not request.relative:
            place = to_world(place, self.origin)
        return self._each(names, lambda v: v.go_to(place, request.yaw, duration, request.relative), response)

    def _arm(self, names: list[str], request: Any, response: Any) -> Any:
        return self._each(names, lambda v: v.arm(request.arm), response)

    def _notify(self, names: list[str], request: Any, response: Any) -> Any:
        return self._each(names, lambda v: v.notify_setpoints_stop(request.remain_valid_millisecs), response)

    def _emergency(self, names: list[str], request: Any, response: Any) -> Any:
        for name in names:
            self.bridge.vehicles[name].stop("service emergency")
        self.say("error", f"EMERGENCY STOP of {', '.join(names)}: service")
        return response

    def _reconnect(self, name: str, request: Any, response: Any) -> Any:
        problem = self.bridge.reconnect(name)
        response.success, response.message = not problem, problem or "connecting"
        return response

    def _end_heartbeat(self, request: Any, response: Any) -> Any:
        self.bridge.end_heartbeat()
        response.success = True
        return response

    # -- what goes out ----------------------------------------------------------------------------------------------
    def _publish_state(self, vehicle: Vehicle, state: VehicleState) -> None:
        """Odometry and pose of one log packet, in the link's thread; only what somebody listens to."""
        name = vehicle.name
        odom, pose = self._wanted.get(name, (False, False))
        if not (odom or pose):
            return
        stamp = self.get_clock().now().to_msg()
        x, y, z = to_map(state.position, self.origin)
        qx, qy, qz, qw = state.orientation
        message = self._odom_message.get(name)
        if message is None:
            message = self._odom_message[name] = Odometry(child_frame_id=f"{name}/base_link")
            message.header.frame_id = FRAME
        message.header.stamp = stamp
        p, q = message.pose.pose.position, message.pose.pose.orientation
        p.x, p.y, p.z = x, y, z
        q.x, q.y, q.z, q.w = qx, qy, qz, qw
        if odom:
            v = message.twist.twist.linear  # REP-103: the twist of an odometry is in the child's frame
            v.x, v.y, v.z = units.rotate_inverse(state.orientation, state.velocity)
            self._odom[name].publish(message)
        if pose:
            self._pose[name].publish(PoseStamped(header=message.header, pose=message.pose.pose))

    def _publish_status(self) -> None:
        stamp = self.get_clock().now().to_msg()
        for s in self.bridge.snapshots():
            self._wanted[s.name] = (
                self._odom[s.name].get_subscription_count() > 0,
                self._pose[s.name].get_subscription_count() > 0,
            )
            self._status[s.name].publish(status_message(s, stamp))

    def _publish_diagnostics(self) -> None:
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        message.status = [diagnostic(s) for s in self.bridge.snapshots()]
        self.diagnostics.publish(message)


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
    return DiagnosticStatus(
        level=level,
        name=f"crazyflie_bridge: {s.name}",
        message=s.state.name.lower(),
        hardware_id=s.name,
        values=[KeyValue(key=key, value=value) for key, value in values.items()],
    )


class _Interrupts:
    """The first Ctrl-C (or SIGTERM, or a terminal that is closed) lands all, the second is the emergency stop."""

    def __init__(self) -> None:
        self.count = 0
        self.event = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:  # nohup wants it to go on
                signal.signal(number, self._handle)

    def _handle(self, number: int, frame: object) -> None:
        self.count += 1
        self.event.set()


def run_node(node: BridgeNode) -> int:
    """Spin until Ctrl-C, then land all and close; exit code."""
    interrupts = _Interrupts()
    # Several threads a Crazyflie share one interpreter; a command that waits for its turn shall not wait 5 ms.
    sys.setswitchinterval(SWITCH_S)
    problem = node.start(interrupts.event.is_set)
    if problem:
        node.say("error", problem)
        node.bridge.close()
        return 1
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    spinner = threading.Thread(target=executor.spin, name="executor", daemon=True)
    spinner.start()
    node.say("info", "ready; Ctrl-C lands all, a second one stops all motors")
    interrupts.event.wait()
    code = _end(node, interrupts)
    executor.shutdown()
    spinner.join(2.0)
    return code


def _end(node: BridgeNode, interrupts: _Interrupts) -> int:
    bridge = node.bridge
    bridge.end_heartbeat()  # from here on the bridge alone brings them down
    flying = bridge.in_air(time.monotonic())
    if flying:
        node.say("warn", f"landing {', '.join(flying)}; Ctrl-C again stops all motors")
        bridge.land_all("the bridge ends")
        flying = bridge.wait_landed(lambda: interrupts.count > 1)
    if interrupts.count > 1:
        bridge.stop_all("second Ctrl-C")
        time.sleep(0.3)  # three packets a vehicle, then the links may close
    elif flying:
        node.say("error", f"still flying: {', '.join(flying)}")
    bridge.close()
    return 0 if interrupts.count == 1 and not flying else 1


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of the executable `crazyflie_bridge`."""
    argv = list(sys.argv if args is None else args)
    follow_supervisor()
    rclpy.init(args=argv, signal_handler_options=SignalHandlerOptions.NO)
    node = None
    try:
        node = BridgeNode()
        code = run_node(node)
    except ConfigError as error:
        print(f"crazyflie_bridge: {error}", file=sys.stderr)
        code = 2
    finally:
        if node is not None:
            node.close()
        rclpy.try_shutdown()
    return code


if __name__ == "__main__":
    sys.exit(main())
