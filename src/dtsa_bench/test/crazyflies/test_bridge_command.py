"""Integration: `dtsa bridge --backend sim`: simulated Crazyflies, the bridge, a flight, and nothing left behind."""

from __future__ import annotations

import re
import runpy
import signal
import socket
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
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
from dtsa_msgs.srv import Land
from ground_helpers import Bridge, running
from node_helpers import ros_graph
from waiting import wait_for

from dtsa_agent.crazyflie.settings import load_swarm
from dtsa_bench.commands.cli import main
from dtsa_bench.commands.crazyflies import simulated
from dtsa_bench.crazyflies.simulated import process as simulated_process
from dtsa_bench.crazyflies.simulated.process import free_base_port

pytestmark = [pytest.mark.slow, pytest.mark.ros]
NAMES = ("cf1", "cf2")
PATIENT = {"link_age_s": 3.0, "command_age_s": 0.45}  # not what is tested here


@contextmanager
def bridge(folder: Path, config: Path, *options: str) -> Iterator[Bridge]:
    command = [sys.executable, "-m", "dtsa_bench", "bridge", "--config", str(config), *options]
    with ros_graph(folder) as graph, running(graph, command, NAMES) as started:
        yield started


def swarm_yaml(folder: Path, uri: str = "usb://{}", first: int = 0, **common: object) -> Path:
    robots = {
        name: {"uri": uri.format(first + k), "initial_position": [0.5 * k, 0.3, 0.0]} for k, name in enumerate(NAMES)
    }
    station = {"toc_cache": str(folder / "cache"), "safety": PATIENT, "min_connected": 2}
    path = folder / "swarm.yaml"
    path.write_text(yaml.safe_dump({"robots": robots, "all": common, "station": station}))
    return path


def gone(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


@contextmanager
def hang_ups(handler: Any) -> Iterator[None]:
    """What this process does about a closed terminal; what it starts inherits that it is ignored, but no function."""
    before = signal.signal(signal.SIGHUP, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, before)


def test_take_off_landing_and_ctrl_c_with_nohup(tmp_path: Path) -> None:
    """A closed terminal lands nobody then."""
    config = swarm_yaml(tmp_path, "radio://0/80/2M/E7E7E7E70{}")
    with hang_ups(signal.SIG_IGN), bridge(tmp_path, config, "--backend", "sim") as started:
        operator = started.operator
        operator.until("ready")
        assert re.search(r"2 simulated Crazyflies, protocol \d+; faults: UDP port \d+\n", started.text())
        fleet = started.child()
        started.process.send_signal(signal.SIGHUP)
        operator.take_off()
        started.process.send_signal(signal.SIGHUP)
        operator.call(Land, "/all/land", duration=Duration(sec=2))
        operator.until("ready")
        assert started.end(signal.SIGINT) == 0, started.text()
        assert gone(fleet)
        assert "landing cf1" not in started.text()
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


def test_ctrl_c_in_a_launch_lands_simulated_ones_before_they_end(tmp_path, monkeypatch):
    config = swarm_yaml(tmp_path, "udp://127.0.0.1:{}", free_base_port(2))
    words = {"config": str(config), "simulated": "true", "mission": "false"}
    simulated, node = launched(monkeypatch, **words)
    with (
        ros_graph(tmp_path) as graph,
        running(graph, simulated.cmd) as fleet,
        running(graph, node.cmd, NAMES) as started,
    ):
        started.operator.take_off()
        fleet.process.send_signal(signal.SIGINT)  # a terminal's Ctrl-C is for all
        assert started.end(signal.SIGINT) == 0, started.text()
        assert "landing cf1, cf2" in started.text()
        assert fleet.process.poll() is None
        (last,) = (over.event for over in node.on_exit if hasattr(over, "event"))
        assert last.process_matcher is simulated
        assert fleet.end(last.signal_number) == 0


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
        with bridge(tmp_path, config, "--check") as started:
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


def test_places_and_rates_for_a_mission_are_printed_and_all_that_are_wrong_are_named(tmp_path, capsys) -> None:
    assert main(["bridge", "--places", "10"]) == 0
    config = tmp_path / "swarm.yaml"
    config.write_text(capsys.readouterr().out)
    assert main(["bridge", "--config", str(config), "--check", "file"]) == 0
    (_, budget) = capsys.readouterr().out.splitlines()
    assert budget.startswith("radio 0: 10 Crazyflies")
    assert budget.endswith(": fits")
    robots = load_swarm(config).robots
    assert (len(robots), robots[0].log_rate_hz) == (10, 15)
    assert main(["bridge", "--places", "14"]) == 2  # one dongle carries them at 6 Hz, which none can fly with
    fly = ["fly", "--backend", "cflib", "--config", str(config), "--out", str(tmp_path / "out")]
    data = yaml.safe_load(config.read_text())
    config.write_text(yaml.safe_dump(data | {"all": {"command_rate_hz": 6}}))
    capsys.readouterr()
    assert main(fly) == 2
    assert "robots.cf1.command_rate_hz: got 6" in capsys.readouterr().err
    for robot in data["robots"].values():
        del robot["initial_position"]
    data["robots"]["cf10"]["role"] = "leader"
    config.write_text(yaml.safe_dump(data))
    assert main(["bridge", "--config", str(config), "--check", "file"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len([line for line in lines if line.startswith("for a mission: initial_position: cf")]) == 10
    assert "not used: robots.cf10.role" in lines
    assert main(fly) == 2
    (error,) = capsys.readouterr().err.strip().splitlines()
    assert all(f"cf{k} within 0.25 m of (" in error for k in range(1, 11))


def test_a_closed_terminal_lands_all_and_sigterm_is_no_second_ctrl_c(tmp_path: Path) -> None:
    # With nohup, as a long run of tests may have been started, they are ignored.
    with hang_ups(lambda *_: None), bridge(tmp_path, swarm_yaml(tmp_path), "--backend", "sim") as started:
        started.operator.take_off()
        fleet = started.child()
        started.process.send_signal(signal.SIGHUP)
        wait_for(lambda: "landing cf1, cf2" in started.text())
        assert started.end(signal.SIGTERM) == 0, started.text()  # as `ros2 launch` does after five seconds
        assert "EMERGENCY" not in started.text()
        assert gone(fleet)


def test_killed_it_takes_the_simulated_ones_along(tmp_path: Path) -> None:
    with bridge(tmp_path, swarm_yaml(tmp_path), "--backend", "sim") as started:
        wait_for(lambda: "simulated Crazyflies" in started.text())
        fleet = started.child()
        started.process.kill()
        wait_for(lambda: gone(fleet))


def test_simulated_ones_take_other_ports_where_others_have_just_taken_theirs(tmp_path, monkeypatch):
    taken = free_base_port(3)
    found = iter((taken, taken + 1, taken + 1))  # free, not free any more, others
    monkeypatch.setattr(simulated_process, "free_base_port", lambda count, first=None: next(found))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other, ExitStack() as stack:
        other.bind(("127.0.0.1", taken - 1))
        path = simulated(swarm_yaml(tmp_path), stack)
        assert load_swarm(path).robots[0].uri == f"udp://127.0.0.1:{taken + 1}"


def test_ctrl_c_while_nobody_answers(tmp_path: Path) -> None:
    config = swarm_yaml(tmp_path, "udp://127.0.0.1:{}9", connect_timeout_s=300, connect_attempts=100)
    with bridge(tmp_path, config) as started:
        wait_for(lambda: "cf2: disconnected -> connecting" in started.text())
        assert started.end(signal.SIGINT) == 1
        assert "interrupted while connecting" in started.text()
