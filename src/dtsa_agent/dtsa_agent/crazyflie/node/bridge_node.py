"""The bridge as a ROS node: `ros2 run dtsa_agent crazyflie_bridge --ros-args -p config:=swarm.yaml`.

Topics and services have the names that Crazyswarm2's users know. The node is a thin shell: its start and end are here,
what comes in and goes out is in `topics`; everything that decides is in `bridge`, `vehicle` and `safety`.
"""

from __future__ import annotations

import dataclasses
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Log, ParameterDescriptor
from rclpy.node import Node

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import named
from dtsa_agent.crazyflie.bridge import Bridge
from dtsa_agent.crazyflie.commands import TopicThread
from dtsa_agent.crazyflie.settings import load_swarm
from dtsa_agent.crazyflie.state import State
from dtsa_agent.priority import set_realtime, use_last_processor
from dtsa_agent.ros.common.loop import ExecutorThread
from dtsa_agent.ros.common.node_process import run_node
from dtsa_agent.ros.common.parameters import check_parameters, declare_settings
from dtsa_agent.stop import Stop

from .interfaces import EVENTS, EVENTS_QOS, NODE
from .preflight import FAIL, check_preflight
from .topics import BridgeInputs, VehicleOutputs, diagnostic, subscribe_positions

STATUS_HZ = 5.0
SETTLE_S = 1.2  # of a check before flight
SWITCH_S, POLL_S = 0.0005, 0.1
LEVELS = {"info": 20, "warn": 30, "error": 40}


class BridgeNode(Node):
    """ROS side of the bridge.

    :raises ConfigError: the configuration is not usable, or a parameter is not known.
    """

    def __init__(self) -> None:
        super().__init__(NODE, enable_rosout=False)
        text = ParameterDescriptor(description="the swarm's YAML file", read_only=True)
        path = self.declare_parameter("config", "", text).value
        if not path:
            raise ConfigError("config", "", "the path of a swarm's YAML file")
        settings = load_swarm(Path(path))
        station = settings.station
        own = {}  # parameters that were set beat the YAML's values
        for name in ("safety", "positions"):
            given = getattr(station, name)
            values = declare_settings(self, type(given), defaults=given.to_dict(), prefix=f"{name}.")
            with named(name):
                own[name] = type(given)(**values)
        check_parameters(self)
        self.settings = dataclasses.replace(settings, station=dataclasses.replace(station, **own))
        self._events = self.create_publisher(Log, EVENTS.lstrip("/"), EVENTS_QOS)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._outputs = {r.name: VehicleOutputs(self, r.name, own["positions"]) for r in settings.robots}
        report = lambda vehicle, *state: self._outputs[vehicle.name].publish_report(vehicle, *state)  # noqa: E731
        self.bridge = Bridge(self.settings, self.log, report)
        self._commands, self.positions = TopicThread(self, "commands"), TopicThread(self, "positions")
        self._inputs = BridgeInputs(self, self.bridge, self._commands, self.log)
        subscribe_positions(self.positions, own["positions"], self.bridge.vehicles)

    def close(self) -> None:
        self._commands.close()
        self.positions.close()
        self.destroy_node()

    def log(self, level: str, line: str) -> None:
        """One line in the log, and on the topic of events."""
        stamp, logger = self.get_clock().now().to_msg(), self.get_logger()
        self._events.publish(Log(stamp=stamp, level=LEVELS[level], name=NODE, msg=line))
        # rclpy wants each place in the code to keep to one level
        if level == "error":
            logger.error(line)
        elif level == "warn":
            logger.warning(line)
        else:
            logger.info(line)

    def start(self, stop: Stop) -> str:
        """Connect all, then offer topics and services; why the swarm cannot fly, or an empty text."""
        began = time.monotonic()
        self.positions.start()
        missing = self.bridge.connect(stop)
        if stop:
            return "interrupted while connecting"
        total = len(self.bridge.vehicles)
        self.log("info", f"{total - len(missing)} of {total} connected in {time.monotonic() - began:.2f} s")
        if missing:
            self.log("warn", f"not connected: {', '.join(missing)} (service reconnect)")
        if total - len(missing) < self.settings.station.min_connected:
            return f"{total - len(missing)} connected, min_connected is {self.settings.station.min_connected}"
        if self.settings.station.on_board.enabled:
            if problem := self.bridge.start_agents():
                return problem
            rate = self.settings.station.on_board.polls_hz
            self.log("info", f"agents started on board; from now on {rate:g} packets a second to each")
        self._inputs.offer()
        self.create_timer(1.0 / STATUS_HZ, self._publish_status)
        self.create_timer(1.0, self._publish_diagnostics)
        return ""

    def _publish_status(self) -> None:
        for name, vehicle in self.bridge.vehicles.items():
            self._outputs[name].publish_status(vehicle)

    def _publish_diagnostics(self) -> None:
        message = DiagnosticArray(status=[diagnostic(v, time.monotonic()) for v in self.bridge.vehicles.values()])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)


def is_urgent(stop: Stop) -> bool:
    """The first signal lands all; one more Ctrl-C is the emergency stop.

    Only that: programs that start processes, like `ros2 launch`, send SIGTERM to those that take long to end.
    """
    return stop.interrupts > (stop.signal == signal.SIGINT)


def run_bridge(node: BridgeNode, stop: Stop) -> int:
    """Spin until Ctrl-C, then land all and close; exit code."""
    # Several threads a Crazyflie share one interpreter; a command that waits for its turn shall not wait 5 ms.
    sys.setswitchinterval(SWITCH_S)
    level = node.settings.station.priority
    if level and (problem := set_realtime(level)):
        node.log("warn", f"no real-time priority ({problem}): keep this station free of other work")
    elif level:
        use_last_processor()
    if problem := node.start(stop):
        node.log("error", problem)
        node.bridge.close()
        return 1
    serving = ExecutorThread(node, "executor")
    node.log("info", "ready; Ctrl-C lands all, a second one stops all motors")
    while not stop:
        time.sleep(POLL_S)
    code = _end(node, stop)
    serving.close()
    return code


def check_bridge(node: BridgeNode, stop: Stop) -> int:
    """Connect, print everything that a flight needs, and close; exit code 1 if something is missing.

    No motor turns, and the emergency watchdog is not fed: afterwards all can fly as before.
    """
    level = node.settings.station.priority
    priority_problem = set_realtime(level) if level else ""
    node.positions.start()
    node.bridge.connect(stop)
    time.sleep(0.0 if stop else SETTLE_S)  # rates and qualities are counted over a second
    findings = check_preflight(node.bridge, priority_problem)
    node.bridge.close()
    for item, found, text in findings:
        print(f"{found:4}  {item:9}  {text}")
    return int(any(found == FAIL for _, found, _ in findings))


def _end(node: BridgeNode, stop: Stop) -> int:
    bridge = node.bridge
    bridge.ends = True
    flying = first = bridge.names_in_air(time.monotonic())
    if flying:
        node.log("warn", f"landing {', '.join(flying)}; Ctrl-C again stops all motors")
        bridge.land_all("the bridge ends")
        flying = bridge.wait_landed(lambda: is_urgent(stop))
    ended = [name for name in first if name not in flying]
    lost = [name for name in ended if bridge.vehicles[name].state in (State.LOST, State.EMERGENCY)]
    urgent = is_urgent(stop)
    if urgent:
        bridge.stop_all("second Ctrl-C")
        time.sleep(0.3)  # three packets a vehicle, then the links may close
    elif flying:
        node.log("error", f"still flying: {', '.join(flying)}")
    if lost:
        node.log("error", f"not known to have landed: {', '.join(lost)}")
    bridge.close()
    return int(urgent or bool(flying or lost))


def main(args: Sequence[str] | None = None, use: Callable[[BridgeNode, Stop], int] = run_bridge) -> int:
    """Entry point of the executable `crazyflie_bridge`; `use` returns the exit code."""

    def body(stop: Stop, supervised: bool) -> int:
        node = BridgeNode()
        try:
            return use(node, stop)
        finally:
            node.close()

    return run_node("crazyflie_bridge", body, args)


if __name__ == "__main__":
    sys.exit(main())
