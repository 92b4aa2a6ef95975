"""Integration: missions: the agents' nodes, the bridge, cflib, simulated Crazyflies, from take-off to landing."""

from __future__ import annotations

import asyncio
import importlib.util
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import yaml

pytest.importorskip("cflib")
pytest.importorskip("rclpy")
pytest.importorskip("dtsa_msgs.srv")

import aiohttp
from bridge_helpers import FakeFleet, fake_fleet, settings
from ground_helpers import children_of, running
from node_helpers import ServedNode, node_environment
from rclpy.context import Context
from rclpy.node import Node
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from std_msgs.msg import Empty as EmptyMessage
from std_srvs.srv import Trigger
from waiting import wait_for

from dtsa_agent.core import SwarmConfig, make_scenario
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.crazyflie.link import require_cflib
from dtsa_agent.crazyflie.node.interfaces import STATE
from dtsa_agent.crazyflie.safety import SafetySettings
from dtsa_agent.crazyflie.settings import parse_swarm
from dtsa_agent.ros.common.node_process import init_ros
from dtsa_agent.stop import Stop, StopToken
from dtsa_bench.commands.fly import mission_problem
from dtsa_bench.crazyflies.missions.ground_station import GroundStation
from dtsa_bench.crazyflies.missions.mission_flight import MissionWatch
from dtsa_bench.crazyflies.missions.places import MissionError, assign_places, check_crossings, check_standing
from dtsa_bench.crazyflies.simulated.truth import read_truth
from dtsa_bench.flights.domain import ros_domain
from dtsa_bench.pages.report.data import run_data
from dtsa_bench.runs.config import RunConfig, RunLimits, from_swarm
from dtsa_bench.runs.metrics import FlightMetrics
from dtsa_channel_sim import ChannelConfig

pytestmark = [pytest.mark.slow, pytest.mark.ros]
COUNT = 4
FLY = [sys.executable, "-m", "dtsa_bench", "fly", "--backend", "cflib", "--no-picture", "--slot-ms", "20"]
MIXED = ("--arming", "mixed")  # stock ones, which arm themselves, beside those that wait to be told


def swarm_yaml(fleet: FakeFleet, folder: Path, **safety: float) -> Path:
    return written(settings(fleet, {"safety": safety}), folder)


def written(data: dict[str, Any], folder: Path) -> Path:
    for k, robot in enumerate(data["robots"].values()):
        angle = 2 * math.pi * k / len(data["robots"])
        robot["initial_position"] = [round(1.2 * math.cos(angle), 3), round(2.0 * math.sin(angle), 3), 0.0]
    path = folder / "swarm.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


@contextmanager
def mission(*words: str) -> Iterator[subprocess.Popen[str]]:
    command = [*FLY, "--tail-s", "60", *words]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def streaming(fleet: FakeFleet) -> bool:
    return len(fleet.events(name="streaming")) == fleet.count


def nearest_m(track: np.ndarray) -> float:
    """Of (T, 3, n) places: the smallest distance of two."""
    gap = np.linalg.norm(track[:, :, :, None] - track[:, :, None, :], axis=1)
    return float((gap + 10 * np.eye(track.shape[2])).min())


def test_everybody_begins_near_where_it_stands_or_nobody_does() -> None:
    config = SwarmConfig(agents=12, permute=False, shape="ellipse", axis_x_m=1.2, axis_y_m=2.0)
    names = [f"cf{k}" for k in range(1, 13)]
    fence = SafetySettings()
    start = make_scenario(config).start
    assert assign_places(config, start) is config
    measured = np.roll(start, 5, axis=1) + np.random.default_rng(1).uniform(-0.15, 0.15, (3, 12))
    found = assign_places(config, measured)
    assert found.place_numbers == np.roll(np.arange(1, 13), 5).tolist()
    check_standing(names, measured, fence)
    check_crossings(make_scenario(found), names, measured)
    with pytest.raises(MissionError, match=r"cf1 and cf7 would come within 0\.0. m.*: put each on its place, or"):
        check_crossings(make_scenario(config), names, np.roll(start, 6, axis=1))  # all through the middle
    assert assign_places(found, start) is found  # roles that the user has given are kept
    measured = start.copy()
    measured[:2, 3] = measured[:2, 4] + (0.1, 0.0)
    measured[0, 0] = 2.5
    with pytest.raises(MissionError, match=r"cf1 stands 1\.00 m outside .*; cf4 and cf5 stand 0\.10 m apart"):
        check_standing(names, measured, fence)


def test_two_as_near_as_in_a_crash_or_somebody_who_may_still_fly_fail_a_mission() -> None:
    assert mission_problem("", []) == ""
    assert mission_problem("", ["cf2"]) == "the exchange is complete; not known to have landed: cf2"
    assert mission_problem("a reason", []) == "the exchange was cut short: a reason; all have landed"
    # A run that ended by itself was taken for complete, and nobody came to rest before they landed.
    swarm = SwarmConfig(agents=3)
    run = RunConfig(swarm, ChannelConfig(**from_swarm(swarm)), RunLimits(stop_on_crash=False))
    metrics, ended = FlightMetrics(run, make_scenario(swarm)), StopToken(Stop())
    mission: Any = SimpleNamespace(ended=ended, check_bridge_process=lambda: None)
    watch = MissionWatch(mission, MagicMock(), metrics)
    watch.idle(0, [])
    assert not ended.reason
    metrics.update(0, np.array([[[0.0, 0.19, 2.0], [0.0] * 3, [0.0] * 3]]), None, 0)
    watch.idle(0, [])
    assert ended.reason == "cf1 and cf2 came within 0.19 m of each other (collision_m is 0.2)"


def check_records(out: Path) -> None:
    """The whole mission is in its own bag, in mission.json, and in the report."""
    mission = json.loads((out / "mission.json").read_text())
    texts = [event["text"] for event in mission["events"]]
    assert mission["cut_short"] == ""
    for words in ("order /all/arm (arm True): done", "order /all/takeoff (", "order /cf1/go_to (", "order /all/land ("):
        assert any(text.startswith(words) for text in texts), texts
    one = mission["vehicles"]["cf1"]
    assert [s["state"] for s in one["states"]][-4:] == ["armed", "flying", "landing", "ready"]
    assert 3.0 < one["battery_least_v"] <= one["battery_first_v"] < 4.3
    assert "commands [Hz]" in one["last"]
    assert (out / "mission_bag" / "metadata.yaml").is_file(), "the recorder got no time to close its bag"
    with AnyReader([out / "mission_bag"], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as bag:
        counts = {name: topic.msgcount for name, topic in bag.topics.items()}
    assert set(counts) >= {"/all/events", "/diagnostics"}
    for cf in range(1, COUNT + 1):
        assert counts[f"/cf{cf}/{STATE}"] > 20
        assert counts[f"/cf{cf}/odom"] > 50
        assert counts[f"/cf{cf}/cmd_velocity_world"] > 20
    assert counts["/all/events"] >= len(texts) > 20
    data = run_data(out)
    assert data["mission"]["vehicles"][0][0] == "cf1"
    assert any("order /all/takeoff" in text for _, _, text in data["mission"]["events"])


def check_priorities(mission: int) -> None:
    """Nothing keeps the bridge waiting: it runs before the agents, and not on their processor."""
    children = {Path(f"/proc/{child}/cmdline").read_bytes(): child for child in children_of(mission)}
    nodes = b"bridge_node", b"agents_node"
    bridge, agents = (next(child for line, child in children.items() if name in line) for name in nodes)
    real_time = os.sched_getscheduler(bridge) == os.SCHED_RR
    if real_time:  # where the machine allows it
        assert os.sched_getparam(bridge).sched_priority > os.sched_getparam(agents).sched_priority > 0
        if len(os.sched_getaffinity(0)) > 1:
            assert not os.sched_getaffinity(bridge) & os.sched_getaffinity(agents)


async def told_in_flight(url: str) -> set[str]:
    """Waits until a mission's page is told of an exchange under way; who it says is flying then."""
    flying: set[str] = set()
    moments = 0
    async with aiohttp.ClientSession() as client, client.ws_connect(url + "stream", max_msg_size=0) as stream:
        while len(flying) < COUNT or moments < 10:
            content = await stream.receive_json(timeout=60)
            moments += len(content.get("moments", ()))
            flying |= {row[0] for row in content.get("rows", ()) if row[1] == "flying"}
    return flying


@pytest.mark.realtime
def test_a_bridge_that_dies_leaves_records_and_a_summary(tmp_path: Path) -> None:
    with fake_fleet(tmp_path, COUNT, *MIXED) as fleet:
        out = tmp_path / "out"
        with mission("--config", str(swarm_yaml(fleet, tmp_path)), "--out", str(out), "--view") as process:
            assert process.stderr is not None
            page = asyncio.run(told_in_flight(process.stderr.readline().split()[1]))
            wait_for(lambda: streaming(fleet), 60)
            for child in children_of(process.pid):
                if b"bridge_node" in Path(f"/proc/{child}/cmdline").read_bytes():
                    os.kill(child, signal.SIGKILL)
            _, errors = process.communicate(timeout=60)
        assert process.returncode == 1
        assert page == {"cf1", "cf2", "cf3", "cf4"}
        assert "bridge" in errors
        assert "not known to have landed: cf1, cf2, cf3, cf4" in errors
        summary = json.loads((out / "summary.json").read_text())
        record = json.loads((out / "mission.json").read_text())
        assert "bridge" in summary["cut_short"] == record["cut_short"]
        assert summary["slots"]["total"] > 10
        assert record["vehicles"]["cf1"]["states"][-1]["state"] == "flying"
        assert (out / "bag" / "metadata.yaml").is_file()
        assert (out / "mission_bag" / "metadata.yaml").is_file()
        assert run_data(out)["mission"]["cut_short"] == record["cut_short"]


@pytest.mark.realtime
def test_take_off_exchange_landing(tmp_path: Path) -> None:
    """Over simulated radios, on which a twentieth of all packets is lost."""
    patient = {"link_age_s": 3.0, "command_age_s": 0.45, "emergency_watchdog": False}  # it would lock them
    robots = {f"cf{k}": {"uri": f"radio://{k % 2}/{40 + 40 * (k % 2)}/2M/E7E7E7E7{k:02X}"} for k in range(1, COUNT + 1)}
    station = {"toc_cache": str(tmp_path / "cache"), "safety": patient}
    config, out = written({"robots": robots, "station": station}, tmp_path), tmp_path / "out"
    radio = ("--simulated-radio", str(tmp_path / "radio"))
    with fake_fleet(tmp_path, COUNT, "--config", str(config), *radio, "--radio-loss", "0.05", *MIXED) as fleet:
        command = [*FLY, "--config", str(config), "--out", str(out), *radio]
        result = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
        assert result.returncode == 0, result.stderr
        summary = json.loads((out / "summary.json").read_text())
        assert (summary["end"], summary["backend"], summary["cut_short"]) == ("completed", "cflib", "")
        assert summary["policy"] == "lease"  # the safe one, unless told otherwise
        assert 1.0 < summary["completion_time_s"] < 30.0
        last_landed = max(e["t"] for e in fleet.events(name="state") if e["state"] == "landed")
        begun = json.loads(fleet.truth.read_text().partition("\n")[0])["fleet"]["unix_time"]
        assert (out / "summary.json").stat().st_mtime > begun + last_landed  # drawn and written once all stood
        assert (out / "bag" / "metadata.yaml").is_file()
        check_records(out)
        times, track, events = read_truth(fleet.truth)
        assert not [e for e in events if e["event"] in ("collision", "crash", "hard landing")]
        # Who stood opposite each other have changed places, and everybody stands on the floor.
        assert track[-1, 2] == pytest.approx([0.0] * COUNT)
        goal = track[0][:2, [2, 3, 0, 1]]
        assert np.linalg.norm(track[-1][:2] - goal, axis=0).max() < 0.5
        for k in range(1, COUNT + 1):
            assert fleet.flown(k)[:3] == ["ready to fly", "flying", "landed"]
        # What the bag's metrics say about the closest approach is what truly happened, within the sensors' noise.
        begin = max(
            next(e["t"] for e in events if e["cf"] == k and e["event"] == "streaming") for k in range(1, COUNT + 1)
        )
        end = min(e["t"] for e in events if e["event"] == "land")
        truly = nearest_m(track[(times >= begin) & (times <= end)])
        assert summary["min_distance_m"] == pytest.approx(truly, abs=0.05)


@pytest.mark.realtime
def test_missions_in_a_row_by_one_bridge_with_its_watchdog(tmp_path: Path) -> None:
    """The first one finds two at each other's places, and all exchange roles; the second one may not: nobody flies."""
    with ros_domain() as domain:
        pass  # free: the bridge's now
    graph: Any = SimpleNamespace(environment=node_environment(domain, tmp_path))
    with fake_fleet(tmp_path, COUNT, *MIXED) as fleet:
        config = swarm_yaml(fleet, tmp_path, link_age_s=3.0, command_age_s=0.45)
        data = yaml.safe_load(config.read_text())
        robots = list(data["robots"].values())  # cf1 is the agent of the third place's vehicle, and the other way round
        robots[0]["uri"], robots[2]["uri"] = robots[2]["uri"], robots[0]["uri"]
        config.write_text(yaml.safe_dump(data))
        with running(graph, [sys.executable, "-m", "dtsa_bench", "bridge", "--config", str(config)]) as bridge:
            for number, (options, code, words) in enumerate((
                ([], 0, "exchange of roles, places 3 2 1 4"),
                ([], 0, "exchange of roles, places 1 4 3 2"),
                (["--places", "1 2 3 4"], 1, "to where they begin cf1 and cf3 would come within 0.0"),
            )):  # fmt: skip
                command = [*FLY, "--config", str(config), "--attach", "--out", str(tmp_path / str(number)), *options]
                result = subprocess.run(
                    command, env=graph.environment, capture_output=True, text=True, timeout=150, check=False
                )
                assert result.returncode == code, result.stderr + bridge.text()
                assert words in result.stderr
            assert bridge.end(signal.SIGINT) == 0
        _, track, events = read_truth(fleet.truth)
        assert not [e for e in events if e["event"] in ("collision", "crash", "hard landing")]
        assert [e["event"] for e in events].count("takeoff") == 2 * COUNT
        assert nearest_m(track[track[:, 2].min(axis=1) > 0.5]) > 0.25


@pytest.mark.realtime
def test_one_that_is_lost_ends_the_mission_and_the_others_land(tmp_path: Path) -> None:
    with fake_fleet(tmp_path, COUNT, *MIXED) as fleet:
        with mission("--config", str(swarm_yaml(fleet, tmp_path)), "--out", str(tmp_path / "out")) as process:
            wait_for(lambda: streaming(fleet), 60)
            check_priorities(process.pid)
            time.sleep(1.0)
            fleet.fault("freeze", 2)
            _, errors = process.communicate(timeout=60)
        assert process.returncode == 1
        assert "cut short: cf2 is lost" in errors
        for k in (1, 3, 4):
            assert fleet.flown(k)[:3] == ["ready to fly", "flying", "landed"]
        assert fleet.state_event(2, "level out")
        assert not [e for e in fleet.events() if e["event"] in ("collision", "crash") and e["cf"] != 2]
        # They come to rest before they land, out of each other's way.
        _, track, _ = read_truth(fleet.truth)
        others = track[:, :, [0, 2, 3]]
        assert nearest_m(others[others[:, 2].min(axis=1) > 0.5]) > 0.25


def test_no_heartbeat_follows_the_last_word_of_a_ground_station(tmp_path: Path) -> None:
    """A bridge that goes on would take the silence after it for a ground station that has died."""
    received: list[str] = []

    def end(request: Any, response: Any) -> Any:
        received.append("end")
        time.sleep(0.3)
        return response

    config, context = SwarmConfig(agents=2), Context()
    with ros_domain() as domain, closing(ServedNode(domain, "bridge")) as bridge:
        bridge.node.create_subscription(EmptyMessage, "/all/heartbeat", lambda message: received.append("beat"), 10)
        bridge.node.create_service(Trigger, "/all/end_heartbeat", end)
        init_ros([], context, domain)
        node = Node("mission", context=context, enable_rosout=False, start_parameter_services=False)
        robots = parse_swarm({"robots": {"cf1": {"uri": "udp://127.0.0.1:9001"}}})
        ground = GroundStation(node, robots, make_scenario(config), StopToken(Stop()), print)
        try:
            ground._beating.set()
            wait_for(lambda: ground._clients["/all/end_heartbeat"].service_is_ready() and "beat" in received)
            ground.land(lambda: False)
            wait_for(lambda: "end" in received)
            time.sleep(0.5)
        finally:
            ground.close()
            node.destroy_node()
            context.try_shutdown()
    assert received[-1] == "end"


def test_bad_input_starts_nothing(tmp_path: Path) -> None:
    out = str(tmp_path / "out")
    robots = {f"cf{k}": {"uri": f"udp://127.0.0.1:{9000 + k}"} for k in range(1, 5)}
    config = tmp_path / "swarm.yaml"
    config.write_text(yaml.safe_dump({"robots": robots}))
    for arguments, words in (
        (["--out", out], "--config FILE"),
        (["--out", out, "--config", str(config)], "within 0.25 m of (1."),
        (["--out", out, "--config", str(config), "--agents", "3", "--moving", "2"], "the ids 1 to 3"),
    ):
        result = subprocess.run([*FLY, *arguments], capture_output=True, text=True, timeout=60, check=False)
        assert result.returncode == 2
        assert words in result.stderr
        assert len(result.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_without_cflib_the_bridge_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="pip install cflib"):
        require_cflib()


@pytest.mark.realtime
@pytest.mark.parametrize("phase", ["takeoff", "streaming"])
def test_ctrl_c_lands_and_a_second_one_stops(phase: str, tmp_path: Path) -> None:
    """The vehicles have names of their own."""
    with fake_fleet(tmp_path, 2, *MIXED) as fleet:
        config = swarm_yaml(fleet, tmp_path, link_age_s=3.0, command_age_s=0.45)
        data = yaml.safe_load(config.read_text())
        data["robots"] = {"north_7": data["robots"]["cf1"], "south": data["robots"]["cf2"]}
        data["station"]["max_speed_mps"] = 0.2  # a landing takes ten seconds: the second signal comes before its end
        config.write_text(yaml.safe_dump(data, sort_keys=False))
        with mission("--config", str(config), "--out", str(tmp_path / "out")) as process:
            wait_for(lambda: len(fleet.events(name=phase)) == 2, 60)
            process.send_signal(signal.SIGINT)
            wait_for(lambda: len(fleet.events(name="land")) == 2, 20)
            assert not any(e["state"] == "locked" for e in fleet.events(name="state"))
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=60)
        assert process.returncode == 130
        if phase == "takeoff":  # the mission did not go on to fly them to their places
            assert not fleet.events(name="go_to")
        for k in (1, 2):
            assert fleet.state_event(k, "locked")["reason"] == "emergency stop"
