"""Integration: `dtsa bridge --backend sim`: simulated Crazyflies, the bridge, a flight, and nothing left behind."""

from __future__ import annotations

import json
import re
import runpy
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
import yaml

pytest.importorskip("cflib")
pytest.importorskip("rclpy")
pytest.importorskip("dtsa_msgs.srv")

from bridge_helpers import fake_fleet
from bridge_helpers import settings as fleet_settings
from builtin_interfaces.msg import Duration
from dtsa_msgs.msg import Status
from dtsa_msgs.srv import Arm, Land, Takeoff
from node_helpers import Graph, ros_graph
from std_srvs.srv import Empty
from waiting import wait_for

from dtsa_agent.crazyflie.settings.config import load_swarm
from dtsa_bench.commands.bridge import simulated
from dtsa_bench.crazyflies.simulated import process as simulated_process
from dtsa_bench.crazyflies.simulated.process import free_base_port

pytestmark = [pytest.mark.slow, pytest.mark.ros]
NAMES = ("cf1", "cf2")
PATIENT = {"link_age_s": 3.0, "command_age_s": 0.45}  # not what is tested here


class Bridge:
    """A bridge's process, and what it prints."""

    def __init__(self, environment: dict[str, str], command: Sequence[str]) -> None:
        self.process = subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.lines.extend(iter(self.process.stdout.readline, ""))

    def text(self) -> str:
        return "".join(self.lines)

    def end(self, patience: float = 60.0) -> int:
        code = self.process.wait(patience)
        self._reader.join(10)
        return code

    def children(self) -> list[int]:
        """Ids of the processes that it has started."""
        tasks = Path(f"/proc/{self.process.pid}/task")
        return [int(child) for task in tasks.iterdir() for child in (task / "children").read_text().split()]


def bridge(environment: dict[str, str], config: Path, *options: str) -> AbstractContextManager[Bridge]:
    """That of `dtsa bridge`."""
    return running(environment, [sys.executable, "-m", "dtsa_bench", "bridge", "--config", str(config), *options])


@contextmanager
def running(environment: dict[str, str], command: Sequence[str]) -> Iterator[Bridge]:
    started = Bridge(environment, command)
    try:
        yield started
    finally:
        started.process.kill()
        started.process.wait()
        started._reader.join(10)
        assert started.process.stdout is not None
        started.process.stdout.close()


def swarm_yaml(folder: Path, uri: str) -> Path:
    robots = {name: {"uri": uri.format(k), "initial_position": [0.5 * k, 0.3, 0.0]} for k, name in enumerate(NAMES)}
    station = {"toc_cache": str(folder / "cache"), "safety": PATIENT, "min_connected": 2}
    path = folder / "swarm.yaml"
    path.write_text(yaml.safe_dump({"robots": robots, "station": station}))
    return path


def gone(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


class Station:
    """Calls services and knows the states."""

    def __init__(self, graph: Graph, started: Bridge) -> None:
        self.graph, self.bridge = graph, started
        self.states: dict[str, str] = {}
        for name in NAMES:
            keep = self._keep(name)
            graph.node.create_subscription(Status, f"/{name}/status", keep, 10)

    def _keep(self, name: str) -> Callable[[Status], None]:
        return lambda message: self.states.__setitem__(name, message.state_name)

    def until(self, condition: Callable[[], object]) -> None:
        self.graph.until(lambda: condition() or self.bridge.process.poll() is not None)
        assert self.bridge.process.poll() is None, self.bridge.text()

    def all(self, state: str) -> None:
        self.until(lambda: [self.states.get(name) for name in NAMES] == [state] * len(NAMES))

    def call(self, kind: Any, name: str, **fields: Any) -> None:
        client = self.graph.node.create_client(kind, name)
        self.until(client.service_is_ready)
        future = client.call_async(kind.Request(**fields))
        self.until(future.done)
        assert getattr(future.result(), "success", True), future.result()


def test_take_off_landing_and_ctrl_c(tmp_path: Path) -> None:
    config = swarm_yaml(tmp_path, "radio://0/80/2M/E7E7E7E70{}")
    with ros_graph(tmp_path) as graph, bridge(graph.environment, config, "--backend", "sim") as started:
        station = Station(graph, started)
        station.until(graph.node.create_client(Empty, "/all/emergency").service_is_ready)
        assert re.search(r"2 simulated Crazyflies, protocol \d+; faults: UDP port \d+\n", started.text())
        (fleet,) = started.children()
        station.all("ready")
        station.call(Arm, "/all/arm", arm=True)
        station.all("armed")
        station.call(Takeoff, "/all/takeoff", height=0.5, duration=Duration(sec=2))
        station.all("flying")
        station.call(Land, "/all/land", duration=Duration(sec=2))
        station.all("ready")
        started.process.send_signal(signal.SIGINT)
        assert started.end() == 0, started.text()
        assert gone(fleet)
        assert "Traceback" not in started.text()


def launched(monkeypatch: pytest.MonkeyPatch, **arguments: str) -> list[SimpleNamespace]:
    """What crazyflie_launch.py starts, its words as `cmd`. In place of `launch`, which pip does not have: its names."""

    def action(*_: object, **values: Any) -> SimpleNamespace:
        return SimpleNamespace(**values)

    def node(package: str, executable: str, **values: Any) -> SimpleNamespace:
        words = [word for name, value in values["parameters"][0].items() for word in ("-p", f"{name}:={value}")]
        return action(cmd=["ros2", "run", package, executable, "--ros-args", *words], **values)

    actions = MagicMock(ExecuteProcess=action, EmitEvent=action, Shutdown=action, Node=node)
    events = MagicMock(matches_action=lambda found: found, SignalProcess=action)
    value = MagicMock(LaunchConfiguration=lambda name: MagicMock(perform=lambda context: arguments[name]))
    modules = {"launch": value, "launch.actions": actions, "launch.substitutions": value, "launch_ros": actions}
    modules |= {"launch.events": events, "launch.events.process": events, "launch_ros.actions": actions}
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    file = Path(__file__).parents[2] / "launch" / "crazyflie_launch.py"
    found: list[SimpleNamespace] = runpy.run_path(str(file))["_processes"](None)
    return found


def test_ctrl_c_in_a_launch_lands_simulated_ones_before_they_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, base = swarm_yaml(tmp_path, "usb://{}"), free_base_port(2)
    data = yaml.safe_load(config.read_text())
    for k, robot in enumerate(data["robots"].values()):
        robot["uri"] = f"udp://127.0.0.1:{base + k}"
    config.write_text(yaml.safe_dump(data))
    words = {"config": str(config), "simulated": "true", "mission": "false", "interfaces": "dtsa"}
    simulated, node = launched(monkeypatch, **words)
    with (
        ros_graph(tmp_path) as graph,
        running(graph.environment, simulated.cmd) as fleet,
        running(graph.environment, node.cmd) as started,
    ):
        station = Station(graph, started)
        station.all("ready")
        station.call(Arm, "/all/arm", arm=True)
        station.all("armed")
        station.call(Takeoff, "/all/takeoff", height=0.5, duration=Duration(sec=2))
        station.all("flying")
        for one in (fleet, started):  # a terminal's Ctrl-C is for all
            one.process.send_signal(signal.SIGINT)
        assert started.end() == 0, started.text()
        assert "landing cf1, cf2" in started.text()
        assert fleet.process.poll() is None
        (last,) = (over.event for over in node.on_exit if hasattr(over, "event"))
        assert last.process_matcher is simulated
        fleet.process.send_signal(last.signal_number)
        assert fleet.end() == 0


def test_check_lists_what_a_flight_lacks(tmp_path: Path) -> None:
    with fake_fleet(tmp_path, 3) as fleet:
        data = fleet_settings(fleet, {"safety": {"geofence_max": [1.0, 2.3, 0.95]}, "priority": 0})
        data["robots"]["cf1"]["initial_position"] = [1.2, 0.0, 0.0]
        data["robots"]["cf3"]["uri"] = "radio://0/80/2M/E7E7E7E703"
        data["all"] |= {"connect_attempts": 1, "connect_timeout_s": 20.0, "command_rate_hz": 100, "log_rate_hz": 100}
        data["station"]["force_budget"] = True
        config = tmp_path / "swarm.yaml"
        config.write_text(yaml.safe_dump(data))
        fleet.fault("battery", 2, voltage=3.1)
        with ros_graph(tmp_path) as graph, bridge(graph.environment, config, "--check") as started:
            assert started.end() == 1, started.text()
            lines = [line.split(maxsplit=2) for line in started.lines]
        for level, item, words in (
            ("FAIL", "links", "cf3: disconnected (attempt 1 of 1: "),
            ("ok", "firmware", "all 2: protocol 12, revision d75a0001"),
            ("FAIL", "batteries", "cf2: 3.10 V, critical 3.2 V"),
            ("warn", "positions", "cf2: at (-0."),
            ("ok", "clocks", "one clock"),
            ("FAIL", "geofence", "cf1: ("),
            ("ok", "budget", "radio 0: 1 Crazyflies"),
            ("warn", "priority", "none"),
        ):
            assert any(line[:2] == [level, item] and line[2].startswith(words) for line in lines), started.text()
        # The estimate is noisy, by about a centimetre.
        outside = next(line[2] for line in lines if line[1] == "geofence")
        assert float(outside.split("is ")[1].split(" m ")[0]) == pytest.approx(0.2, abs=0.05)
        wrong = next(line[2] for line in lines if line[1] == "positions")
        assert float(wrong.split(", ")[3].split(" m ")[0]) == pytest.approx(1.83, abs=0.05)
        assert not [e for e in fleet.events(name="state") if e["state"] in ("flying", "locked")]


@contextmanager
def hang_ups(handler: Any) -> Iterator[None]:
    """What this process does about a closed terminal; what it starts inherits that it is ignored, but no function."""
    before = signal.signal(signal.SIGHUP, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_closed_terminal_lands_all_and_sigterm_is_no_second_ctrl_c(tmp_path: Path) -> None:
    config = swarm_yaml(tmp_path, "udp://192.0.2.1:{}9")
    with (
        hang_ups(lambda *_: None),  # with nohup, as a long run of tests may have been started, they are ignored
        ros_graph(tmp_path) as graph,
        bridge(graph.environment, config, "--backend", "sim") as started,
    ):
        station = Station(graph, started)
        station.all("ready")
        (fleet,) = started.children()
        station.call(Arm, "/all/arm", arm=True)
        station.all("armed")
        station.call(Takeoff, "/all/takeoff", height=0.5, duration=Duration(sec=2))
        station.all("flying")
        started.process.send_signal(signal.SIGHUP)
        wait_for(lambda: "landing cf1, cf2" in started.text())
        started.process.send_signal(signal.SIGTERM)  # as `ros2 launch` does after five seconds
        assert started.end() == 0, started.text()
        assert "EMERGENCY" not in started.text()
        assert gone(fleet)


def test_with_nohup_a_closed_terminal_lands_nobody(tmp_path: Path) -> None:
    config = swarm_yaml(tmp_path, "udp://192.0.2.1:{}9")
    with (
        hang_ups(signal.SIG_IGN),
        ros_graph(tmp_path) as graph,
        bridge(graph.environment, config, "--backend", "sim") as started,
    ):
        station = Station(graph, started)
        station.all("ready")
        started.process.send_signal(signal.SIGHUP)
        station.call(Arm, "/all/arm", arm=True)
        station.all("armed")
        started.process.send_signal(signal.SIGINT)
        assert started.end() == 0, started.text()


NESTED = """
import os, signal, sys
from dtsa_agent.crazyflie.node import bridge_node

interrupts, left, first = bridge_node._Interrupts(), int(sys.argv[1]), signal.getsignal(signal.SIGTERM)


def traced(frame, event, argument):
    global left
    if event == "line":
        left -= 1
        if left == 0:
            os.kill(os.getpid(), signal.SIGINT)
    return traced


def handle(number, frame):
    sys.settrace(traced)
    first(number, frame)
    sys.settrace(None)


signal.signal(signal.SIGTERM, handle)
os.kill(os.getpid(), signal.SIGTERM)
interrupts.wait()
print(interrupts.count, left)
"""


def test_two_signals_at_once_are_seen() -> None:
    """The second one comes at each line of the first one's handler in turn; nobody lands if it waits for the first."""
    for line in range(1, 40):
        command = [sys.executable, "-c", NESTED, str(line)]
        count, left = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout.split()
        if int(left) > 0:  # the handler has fewer lines
            assert line > 3
            return
        assert int(count) in (1, 2)  # one if Ctrl-C came before the other one counted
    raise AssertionError("the handler has too many lines")


def test_killed_it_takes_the_simulated_ones_along(tmp_path: Path) -> None:
    config = swarm_yaml(tmp_path, "usb://{}")
    with ros_graph(tmp_path) as graph, bridge(graph.environment, config, "--backend", "sim") as started:
        wait_for(lambda: "simulated Crazyflies" in started.text())
        (fleet,) = started.children()
        started.process.kill()
        wait_for(lambda: gone(fleet))


def test_simulated_ones_take_other_ports_where_others_have_just_taken_theirs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = free_base_port(3)
    found = iter((taken, taken + 1, taken + 1))  # free, not free any more, others
    monkeypatch.setattr(simulated_process, "free_base_port", lambda count, first=None: next(found))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other, ExitStack() as stack:
        other.bind(("127.0.0.1", taken - 1))
        path = simulated(swarm_yaml(tmp_path, "usb://{}"), stack)
        assert load_swarm(path).robots[0].uri == f"udp://127.0.0.1:{taken + 1}"


def test_ctrl_c_while_nobody_answers(tmp_path: Path) -> None:
    config = swarm_yaml(tmp_path, "udp://127.0.0.1:{}9")
    content = yaml.safe_load(config.read_text()) | {"all": {"connect_timeout_s": 300, "connect_attempts": 100}}
    config.write_text(json.dumps(content))
    with ros_graph(tmp_path) as graph, bridge(graph.environment, config) as started:
        wait_for(lambda: "cf2: disconnected -> connecting" in started.text())
        started.process.send_signal(signal.SIGINT)
        assert started.end() == 1
        assert "interrupted while connecting" in started.text()
