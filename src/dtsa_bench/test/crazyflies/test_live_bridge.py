"""Integration: agents on board and the bridge on one air: take-off, enabling, emergency and landing by CRTP."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip("cflib")
pytest.importorskip("rclpy")
pytest.importorskip("dtsa_msgs.srv")

from ground_helpers import Bridge, Operator, running
from live_helpers import live_laboratory
from node_helpers import ros_graph
from std_srvs.srv import Empty, SetBool
from waiting import wait_for

from dtsa_agent.core import SwarmConfig, make_scenario
from dtsa_agent.crazyflie.link import SIMULATED_RADIO
from dtsa_agent.keys import VARIABLE
from dtsa_bench.crazyflies.peer_lab.compiling import compiler
from dtsa_bench.log.agent_bag import read
from dtsa_bench.log.merge.merge import Merge, is_verified

pytestmark = [
    pytest.mark.slow, pytest.mark.ros, pytest.mark.skipif(shutil.which(compiler()[0]) is None, reason="no C compiler"),
]  # fmt: skip

NAMES = ("cf1", "cf2", "cf3")
SWARM = {"policy": "lease", "slot_ms": 20.0, "axis_x_m": 0.8, "axis_y_m": 0.8, "jitter_m": 0.0, "permute": False}
SEALED = {**SWARM, "auth": True, "auth_session": 41}
KEY = {VARIABLE: "9f86d081884c7d659a2feaa0c55ad015"}
CONFIG = SwarmConfig.from_dict({**SEALED, "agents": len(NAMES)})
FLOOR_M = 0.6  # below the frame map
TAKEOFF_S = 5.0  # long enough to ask meanwhile, on a busy machine
URI = "radio://{}/80/2M"
DTSA = [sys.executable, "-m", "dtsa_bench"]


def swarm_yaml(folder: Path) -> Path:
    start = make_scenario(CONFIG).start
    robots = {
        name: {"uri": f"{URI.format(0)}/E7E7E7E70{k + 1}", "initial_position": [*start[:2, k].tolist(), 0.0]}
        for k, name in enumerate(NAMES)
    }
    patient = {"link_age_s": 3.0, "emergency_watchdog": False, "min_distance_m": 0}  # on a busy machine
    station = {
        "on_board": {"swarm": SEALED, "polls_hz": 10}, "room_origin_in_world": [0.0, 0.0, FLOOR_M],
        "toc_cache": str(folder / "cache"), "land_speed_mps": 1.0, "safety": patient,
    }  # fmt: skip
    path = folder / "swarm.yaml"
    path.write_text(yaml.safe_dump({"robots": robots, "all": {"log_rate_hz": 4}, "station": station}))
    return path


def steer(operator: Operator) -> None:
    """All take off, and their agents steer as soon as the take-off is over; before that the bridge refuses."""
    client = operator.graph.node.create_client(SetBool, "/all/enable")
    operator.graph.until(client.service_is_ready)
    operator.take_off(FLOOR_M, TAKEOFF_S)
    assert "still flies its take-off" in operator.graph.ask(client, SetBool.Request(data=True)).message
    operator.graph.until(lambda: operator.graph.ask(client, SetBool.Request(data=True)).success)


def arrived(folder: Path) -> bool:
    lines = (folder / "truth.jsonl").read_text().splitlines()[:-1]
    places = next((json.loads(line)["p"] for line in reversed(lines) if '"p"' in line), None)
    goal = np.array(make_scenario(CONFIG).target) + np.array([[0.0], [0.0], [FLOOR_M]])
    return places is not None and bool((np.abs(np.array(places) - goal) < 0.15).all())


@contextmanager
def bridged(folder: Path) -> Iterator[tuple[Operator, Bridge, subprocess.Popen[str], dict[str, str]]]:
    """An operator, the bridge, the laboratory, and the environment of other programs on its air."""
    config, swarm = swarm_yaml(folder), folder / "swarm.json"
    swarm.write_text(json.dumps(CONFIG.to_dict()))
    with live_laboratory(folder, str(swarm), **KEY) as lab, ros_graph(folder) as graph:
        environment = {**graph.environment, SIMULATED_RADIO: str(folder / "radio"), **KEY}
        with running(graph, [*DTSA, "bridge", "--config", str(config)], NAMES, **environment) as bridge:
            yield bridge.operator, bridge, lab, environment


def test_agents_on_board_fly_while_the_bridge_is_the_ground_and_sniff_listens_to_sealed_frames(tmp_path: Path) -> None:
    options = [f"--{key.replace('_', '-')}={value}" for key, value in SWARM.items() if not isinstance(value, bool)]
    radio = ["--air", "crazyradio", "--uri", URI.format(2), "--simulated-radio", str(tmp_path / "radio"), "--json"]
    sealed = ["--auth-session", str(CONFIG.auth_session)]
    sniff = [*DTSA, "sniff", *radio, *sealed, "--agents", str(len(NAMES)), "--no-permute", *options]
    with bridged(tmp_path) as (operator, bridge, lab, environment):
        listener = subprocess.Popen(sniff, stdout=subprocess.PIPE, text=True, env=os.environ | environment)
        try:
            operator.until("ready")
            topics = operator.graph.node.get_topic_names_and_types()
            assert not [name for name, _ in topics if "/cmd_" in name]
            steer(operator)
            wait_for(lambda: arrived(tmp_path))
            operator.call(Empty, "/cf3/emergency")
            operator.until("flying", "flying", "emergency")
            assert bridge.end(signal.SIGINT) == 0, bridge.text()
            listener.send_signal(signal.SIGINT)
            heard = json.loads(listener.communicate(timeout=60)[0])
            lab.send_signal(signal.SIGINT)
            summary = json.loads(lab.communicate(timeout=60)[0])
        finally:
            listener.kill()
            listener.wait()
    assert summary["crashed"] == [3]
    events = map(json.loads, (tmp_path / "truth.jsonl").read_text().splitlines())
    assert sorted(e["cf"] for e in events if "event" in e and e.get("state") == "landed") == [1, 2]
    assert summary["min_distance_m"] > 0.2
    assert listener.returncode == 0
    assert all(heard["heard"][name] > 50 for name in NAMES)
    assert heard["rules_broken"] == 0
    found = Merge([read(tmp_path / f"{name}.mcap") for name in NAMES]).summary()
    assert is_verified(found)
    assert found["decisions_again"]["differences"] == []
