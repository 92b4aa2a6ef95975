"""The bridge as a ROS node: `ros2 run dtsa_agent crazyflie_bridge --ros-args -p config:=swarm.yaml`.

Topics and services have the names that Crazyswarm2's users know. The node is a thin shell: its start and end are here,
what comes in and goes out is in `topics`; everything that decides is in `bridge`, `vehicle` and `safety`.
"""

from __future__ import annotations

import dataclasses
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TypeVar

import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import named
from dtsa_agent.crazyflie.bridge import Bridge
from dtsa_agent.crazyflie.commands import TopicThread
from dtsa_agent.crazyflie.positions import PositionSettings
from dtsa_agent.crazyflie.safety import SafetySettings
from dtsa_agent.crazyflie.settings import load_swarm
from dtsa_agent.crazyflie.state import State
from dtsa_agent.priority import set_realtime, use_last_processor
from dtsa_agent.ros.common.loop import ExecutorThread
from dtsa_agent.ros.common.node_process import follow_supervisor, init_ros, limit_to_machine
from dtsa_agent.ros.common.parameters import check_parameters, declare_settings

from .interfaces import NODE
from .preflight import FAIL, check_preflight
from .topics import BridgeInputs, BridgeOutputs, subscribe_positions

STATUS_HZ = 5.0
SETTLE_S = 1.2  # of a check before flight
SWITCH_S = 0.0005

Given = TypeVar("Given", SafetySettings, PositionSettings)


def settings_parameters(node: Node, name: str, given: Given) -> Given:
    """Declare one parameter a setting; a parameter that was set beats the YAML's value."""
    values = declare_settings(node, type(given), defaults=given.to_dict(), prefix=f"{name}.")
    with named(name):
        return type(given)(**values)


class BridgeNode(Node):
    """ROS side of the bridge.

    :raises ConfigError: the configuration is not usable, or a parameter is not known.
    """

    def __init__(self) -> None:
        super().__init__(NODE, enable_rosout=False)
        text = ParameterDescriptor(description="the swarm's YAML file", read_only=True)
        given = self.declare_parameter("config", "", text).value
        if not given:
            raise ConfigError("config", "", "the path of a swarm's YAML file")
        settings = load_swarm(Path(given))
        safety = settings_parameters(self, "safety", settings.station.safety)
        positions = settings_parameters(self, "positions", settings.station.positions)
        check_parameters(self)
        station = dataclasses.replace(settings.station, safety=safety, positions=positions)
        self.settings = dataclasses.replace(settings, station=station)
        self.outputs = BridgeOutputs(self, self.settings)
        self.bridge = Bridge(self.settings, self.log, self.outputs.publish_report)
        self._commands, self.positions = self._topic_thread("commands"), self._topic_thread("positions")
        self._inputs = BridgeInputs(self, self.bridge, self._commands, self.log)
        subscribe_positions(self.positions, positions, self.bridge.vehicles)

    def _topic_thread(self, name: str) -> TopicThread:
        plain = {"enable_rosout": False, "start_parameter_services": False, "use_global_arguments": False}
        node = Node(f"{self.get_name()}_{name}", namespace=self.get_namespace(), context=self.context, **plain)
        return TopicThread(node, name)

    def close(self) -> None:
        """End of what this node added to itself."""
        self._commands.close()
        self.positions.close()
        self.destroy_node()

    def log(self, level: str, line: str) -> None:
        """One line in the log, and on the topic of events."""
        self.outputs.publish_event(level, line)
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
        self.positions.start()
        missing = self.bridge.connect(stop)
        if stop():
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
        self.create_timer(1.0 / STATUS_HZ, lambda: self.outputs.publish_status(self.bridge.vehicles))
        self.create_timer(1.0, lambda: self.outputs.publish_diagnostics(self.bridge.vehicles))
        return ""


class _Interrupts:
    """The first Ctrl-C (or SIGTERM, or a terminal that is closed) lands all; one more Ctrl-C is the emergency stop.

    Only that: programs that start processes, like `ros2 launch`, send SIGTERM to those that take long to end.
    Signals may come at once. A handler that interrupts another one must not wait for a lock that this one holds, as
    that of `threading.Event` does: the bridge would stand still, and no vehicle would land.
    """

    def __init__(self) -> None:
        self.count = 0
        self._come: SimpleQueue[int] = SimpleQueue()  # its `put` may interrupt itself
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:  # nohup wants it to go on
                signal.signal(number, self._handle)

    def _handle(self, number: int, frame: object) -> None:
        if number == signal.SIGINT or not self.count:
            self.count += 1
        self._come.put(number)

    def any(self) -> bool:
        """Whether a signal has come."""
        return self.count > 0

    def wait(self, timeout_s: float | None = None) -> None:
        """Wait for a signal (s at most; None: as long as it takes), unless one has come."""
        if not self.any():
            with suppress(Empty):
                self._come.get(timeout=timeout_s)


def run_node(node: BridgeNode) -> int:
    """Spin until Ctrl-C, then land all and close; exit code."""
    interrupts = _Interrupts()
    # Several threads a Crazyflie share one interpreter; a command that waits for its turn shall not wait 5 ms.
    sys.setswitchinterval(SWITCH_S)
    level = node.settings.station.priority
    if level and (problem := set_realtime(level)):
        node.log("warn", f"no real-time priority ({problem}): keep this station free of other work")
    elif level:
        use_last_processor()
    if problem := node.start(interrupts.any):
        node.log("error", problem)
        node.bridge.close()
        return 1
    serving = ExecutorThread(node.context, "executor", node)
    serving.start()
    node.log("info", "ready; Ctrl-C lands all, a second one stops all motors")
    interrupts.wait()
    code = _end(node, interrupts)
    serving.close()
    return code


def check_node(node: BridgeNode, print_line: Callable[[str], None]) -> int:
    """Connect, look at everything that a flight needs, and close; exit code 1 if something is missing.

    No motor turns, and the emergency watchdog is not fed: afterwards all can fly as before.
    """
    interrupts = _Interrupts()
    level = node.settings.station.priority
    problem = set_realtime(level) if level else ""
    node.positions.start()
    node.bridge.connect(interrupts.any)
    interrupts.wait(SETTLE_S)  # rates and qualities are counted over a second
    findings = check_preflight(node.bridge, problem)
    node.bridge.close()
    for item, level_text, text in findings:
        print_line(f"{level_text:4}  {item:9}  {text}")
    return int(any(level_text == FAIL for _, level_text, _ in findings))


def _end(node: BridgeNode, interrupts: _Interrupts) -> int:
    bridge = node.bridge
    bridge.heartbeat = None  # from here on the bridge alone brings them down
    flying = first = bridge.names_in_air(time.monotonic())
    if flying:
        node.log("warn", f"landing {', '.join(flying)}; Ctrl-C again stops all motors")
        bridge.land_all("the bridge ends")
        flying = bridge.wait_landed(lambda: interrupts.count > 1)
    if interrupts.count > 1:
        bridge.stop_all("second Ctrl-C")
        time.sleep(0.3)  # three packets a vehicle, then the links may close
    elif flying:
        node.log("error", f"still flying: {', '.join(flying)}")
    lost = [name for name in first if name not in flying and bridge.vehicles[name].state == State.LOST]
    if lost:
        node.log("error", f"not known to have landed: {', '.join(lost)}")
    bridge.close()
    return 0 if interrupts.count == 1 and not (flying or lost) else 1


def main(args: Sequence[str] | None = None, use: Callable[[BridgeNode], int] = run_node) -> int:
    """Entry point of the executable `crazyflie_bridge`; `use` returns the exit code."""
    argv = list(sys.argv if args is None else args)
    follow_supervisor()
    limit_to_machine(os.environ)
    try:
        init_ros(argv)
    except Exception as error:  # rclpy's errors for a wrong command line have no common base
        print(f"crazyflie_bridge: {str(error).splitlines()[0]}", file=sys.stderr)
        return 2
    node = None
    try:
        node = BridgeNode()
        code = use(node)
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
