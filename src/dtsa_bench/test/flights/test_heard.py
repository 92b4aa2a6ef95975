"""Integration: whatever is appended to frames, in whatever mode: everybody hears everybody, and the bag says so."""

from __future__ import annotations

import csv
import math
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

pytest.importorskip("dtsa_msgs.msg")

import air_helpers as helpers
from bridge_helpers import fake_fleet, settings
from fly_helpers import PATIENCE_S, fly, summary_of, verified
from fly_helpers import run_dtsa as bench
from node_helpers import end_of, ros_graph
from waiting import wait_for

from dtsa_agent.core.authentication import TAG_LENGTH
from dtsa_agent.core.reference.frame import LENGTHS
from dtsa_agent.core.registry import POLICIES
from dtsa_agent.keys import VARIABLE
from dtsa_bench.log.bag.reader import Bag
from dtsa_bench.log.record import load_log
from dtsa_bench.log.tables import export
from dtsa_bench.pages.report.data import run_data

pytestmark = pytest.mark.ros

AGENTS = 3
KEY, OTHER_KEY = "8f3c1d5e7a9b2460c1e3f5a7b9d8c6e4", "0f1e9d3c5b7a8694a2c4e6f80b1d3957"
THIRD_KEY = "c7d10f2e58b9436a9be1f00d3a6c5278"
ESTIMATOR = '''
class Initials:
    """The last heard state; says two letters, and checks those of others."""

    own_bytes = 2

    def __init__(self, config, agent):
        pass

    def estimate(self, table, slot, step, position, velocity):
        position[:], velocity[:] = table.sent_position, table.sent_velocity

    def own_data(self, table, slot):
        return bytes([65 + table.agent, 97 + slot % 26])

    def receive_data(self, table, slot, sender, data):
        assert data == bytes([65 + sender, 97 + slot % 26]), (slot, sender, data)
'''
# Options, and the bytes that policy and estimator append to a frame.
KINDS = {
    "plain": (("--policy", "lease"), 0),
    "auth": (("--policy", "lease", "--auth"), 0),
    "bytes of the policy": (("--policy", "sotdma"), 3),
    "bytes of the estimator": (("--policy", "tdma", "--estimator", "initials"), 2),
    "both with auth": (("--policy", "sotdma", "--estimator", "initials", "--auth"), 5),
}
LEAST_AND_MOST = ("plain", "both with auth")  # that a frame carries; nodes fly what lies between


@pytest.fixture(autouse=True)
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An estimator of a user's for this process and those that it starts, and the key of a swarm."""
    place = tmp_path / "installed"
    (place / "initials-1.dist-info").mkdir(parents=True)
    (place / "initials_plug_in.py").write_text(ESTIMATOR)
    (place / "initials-1.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: initials\nVersion: 1\n")
    points = "[dtsa.estimators]\ninitials = initials_plug_in:Initials\n"
    (place / "initials-1.dist-info" / "entry_points.txt").write_text(points)
    monkeypatch.syspath_prepend(str(place))
    monkeypatch.setenv("PYTHONPATH", str(place), prepend=":")
    monkeypatch.setenv(VARIABLE, KEY)


def flown(out: Path, *words: str) -> dict[str, Any]:
    return fly(out, "--agents", str(AGENTS), "--timeout-s", "2", "--no-picture", *words)


def check_heard(out: Path, summary: dict[str, Any], own_bytes: int, sealed: bool) -> None:
    """Everybody has heard everybody, frames have all their bytes, and the bag is what the protocol gives."""
    assert summary["unheard"] is None
    assert not {"frame rejected", "frame malformed", "frame foreign"} & set(summary["not_taken_in"]), summary
    receptions = summary["receptions"]
    assert 0 < receptions["taken_in"] <= receptions["delivered"]
    if summary.get("mode") != "realtime":
        assert receptions["taken_in"] == receptions["delivered"]
    assert summary["age_mean_slots"] is not None
    assert not verified(out).unheard
    with Bag(out) as bag:
        run = load_log(bag)
    heard = np.zeros((AGENTS, AGENTS), dtype=bool)
    for sender, received in zip(run.sent_frames.sender, run.received, strict=True):
        heard[sender - 1] |= received
    assert (heard | np.eye(AGENTS, dtype=bool)).all()
    appended = own_bytes + (TAG_LENGTH if sealed else 0)
    lengths = {len(data) for data in run.sent_frames.data}
    assert lengths <= {length + appended for length in LENGTHS.values()}, lengths
    (frames,) = (one for one in export(run, out / "tables", "csv", ["frames"]) if one.path.stem == "frames")
    said = [row["position_x_m"] for row in csv.DictReader(frames.path.read_text().splitlines())]
    assert said
    assert all(said)  # what was said can be read, whatever stands behind it


@pytest.mark.parametrize("processes", ["1", "per-agent"])
@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
@pytest.mark.parametrize("kind", KINDS)
def test_everybody_hears_everybody(tmp_path: Path, kind: str, mode: str, processes: str) -> None:
    words, own_bytes = KINDS[kind]
    out = tmp_path / "flight"
    summary = flown(out, *words, "--mode", mode, "--slot-ms", "20", "--processes", processes)
    check_heard(out, summary, own_bytes, "--auth" in words)


def live() -> list[str]:
    """The policies that docs/reference/schemes.md lets agents fly in real time, in processes of their own."""
    rows = [POLICIES.row(name) for name in (*POLICIES.names, *POLICIES.plug_ins())]
    return sorted(row.name for row in rows if not (row.needs_everybody or row.reacts or row.unslotted))


@pytest.mark.parametrize("policy", live())
def test_agents_of_every_scheme_that_flies_live_hear_each_other(tmp_path: Path, policy: str) -> None:
    out, own_bytes = tmp_path / "flight", POLICIES.row(policy).own_bytes
    summary = flown(out, "--policy", policy, "--mode", "realtime", "--slot-ms", "20", "--processes", "2")
    check_heard(out, summary, own_bytes, sealed=False)


@pytest.mark.parametrize("kind", LEAST_AND_MOST)
def test_agents_on_a_network_hear_each_other(tmp_path: Path, kind: str) -> None:
    words, own_bytes = KINDS[kind]
    with on_a_network(tmp_path, words, [KEY] * AGENTS) as ended:
        for agent, (code, said, summary) in enumerate(ended(), 1):
            assert (code, said) == (0, ""), said
            assert summary["heard_of"] == [other for other in range(1, AGENTS + 1) if other != agent]
            assert not {"rejected", "malformed", "foreign", "length"} & set(summary["not_taken_in"]), summary
    merged = bench("merge", *map(str, sorted(tmp_path.glob("cf*"))), "--out", str(tmp_path / "whole"), "--json")
    assert merged.returncode == 0, merged.stderr
    verified(tmp_path / "whole")
    with Bag(tmp_path / "whole") as bag:
        lengths = {len(data) for data in load_log(bag).sent_frames.data if data}
    tag = TAG_LENGTH if "--auth" in words else 0
    assert lengths <= {length + own_bytes + tag for length in LENGTHS.values()}, lengths


def test_an_agent_of_another_key_on_a_network_hears_nobody_and_says_so(tmp_path: Path) -> None:
    words, _ = KINDS["both with auth"]
    with on_a_network(tmp_path, words, [KEY, KEY, KEY, OTHER_KEY]) as ended:
        *alike, other = ended()
    in_flight = r"dtsa: cf\d: datagrams not taken in so far: [1-9]\d* of another key, or frames played again\n"
    for code, said, summary in alike:
        assert code == 0
        assert re.fullmatch(f"({in_flight})*", said), said
        assert len(summary["heard_of"]) == 2  # two thirds of what arrives: a good deal more than half
        assert summary["not_taken_in"]["rejected"] > 0
    code, said, summary = other
    assert code == 1
    at_the_end = r"dtsa: cf4: no agent heard another: .* [1-9]\d* rejected \(no tag, or one of another key"
    assert re.match(f"({in_flight})*{at_the_end}", said), said
    assert summary["heard_of"] == []
    merged = bench("merge", str(tmp_path / "cf1"), str(tmp_path / "cf4"))  # two frames in six were taken in
    assert merged.returncode == 1
    assert merged.stderr.startswith("dtsa: most frames were of no use: ")


@pytest.mark.slow
@pytest.mark.parametrize("kind", LEAST_AND_MOST)
def test_agents_that_steer_crazyflies_hear_each_other(tmp_path: Path, kind: str) -> None:
    pytest.importorskip("cflib")
    words, own_bytes = KINDS[kind]
    out, robots = tmp_path / "flight", tmp_path / "swarm.yaml"
    with fake_fleet(tmp_path, AGENTS) as fleet:
        given = settings(fleet, {"safety": {"command_age_s": 0.45, "emergency_watchdog": False}})
        for k, robot in enumerate(given["robots"].values()):
            angle = 2 * math.pi * k / AGENTS
            robot["initial_position"] = [round(1.2 * math.cos(angle), 3), round(2.0 * math.sin(angle), 3), 0.0]
        robots.write_text(yaml.safe_dump(given))
        shape = ("--backend", "cflib", "--config", str(robots), "--slot-ms", "20", "--no-picture", "--out", str(out))
        done = bench("fly", *shape, *words)
        assert done.returncode == 0, done.stderr
    check_heard(out, summary_of(out), own_bytes, "--auth" in words)


@contextmanager
def on_a_network(folder: Path, words: tuple[str, ...], keys: list[str]) -> Iterator[Callable[[], list[Any]]]:
    """Agents, a process each; what is given ends them after a while: exit code, last words, summary of each."""
    helpers.need_multicast()
    shape = ["--agents", str(len(keys)), "--slot-ms", "20", "--interface", "lo", "--group", helpers.own_group()]
    shape += [word for word in words if word != "--auth"]
    shape += ["--auth-session", "7"] if "--auth" in words else ["--no-seal"]
    start = [sys.executable, "-m", "dtsa_bench", "agent", *shape]
    files = [folder / f"cf{agent}" / f"cf{agent}.mcap" for agent in range(1, len(keys) + 1)]
    with ExitStack() as stack:
        processes = []
        for agent, key in enumerate(keys, 1):
            words = [*start, "--id", str(agent), "--out", str(folder / f"cf{agent}")]
            pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "env": {**os.environ, VARIABLE: key}}
            processes.append(stack.enter_context(subprocess.Popen(words, text=True, **pipes)))
            stack.callback(processes[-1].kill)

        def ended() -> list[Any]:
            wait_for(lambda: all(file.exists() and file.stat().st_size > 20_000 for file in files))
            for process in processes:
                process.send_signal(signal.SIGINT)
            found = []
            for file, process in zip(files, processes, strict=True):
                _, said = process.communicate(timeout=PATIENCE_S)
                said = re.sub(
                    r"dtsa: cf\d: (is new|is alone|flies|listens|hovers).*\n", "", said
                )  # whether it has its quorum yet
                found.append((process.returncode, said, summary_of(file.parent)))
            return found

        yield ended


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
@pytest.mark.parametrize(
    ("keys", "says"),
    [([KEY, KEY, OTHER_KEY], "most frames were of no use"), ([KEY, OTHER_KEY, THIRD_KEY], "no agent heard another")],
)
def test_agents_of_other_keys_are_refused_and_the_flight_says_so(tmp_path, mode, keys, says):
    out = tmp_path / "out"
    values = {"agents": AGENTS, "mode": mode, "slot_ms": 20.0, "policy": "lease", "auth": "true", "auth_session": 3}
    given = [word for name, value in values.items() for word in ("-p", f"{name}:={value}")]
    with ros_graph(tmp_path) as graph:
        limits = ("-p", f"out:={out}", "-p", "timeout_s:=2.0")
        channel = graph.start("dtsa_bench.flights.recorded_channel", *given, *limits)
        for agent, key in enumerate(keys, 1):
            graph.environment[VARIABLE] = key
            graph.start("dtsa_agent.ros.agent_node", *given, "-p", f"id:={agent}")
        code, said = end_of(channel)
    assert code == 1
    pattern = rf"recorded_channel: error: {says}: of \d+ frames that arrived \d+ were not taken in; .* \d+ rejected \("
    assert re.match(pattern, said.strip().splitlines()[-1]), said
    summary = summary_of(out)
    assert said.strip().endswith(summary["unheard"])
    receptions = summary["receptions"]
    assert (receptions["taken_in"] == 0) is (len(set(keys)) == AGENTS)
    assert (summary["age_mean_slots"] is None) is (len(set(keys)) == AGENTS)
    checked = bench("verify", str(out))
    assert checked.returncode == 1
    assert "tag" in checked.stdout
    assert any(note.lower().startswith(says) for note in run_data(out)["notes"])


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_a_flight_in_which_nobody_heard_anybody_has_failed(tmp_path: Path, mode: str) -> None:
    out = tmp_path / "flight"
    words = ["--agents", "3", "--mode", mode, "--slot-ms", "20", "--policy", "tdma", "--loss", "1", "--timeout-s", "2"]
    done = bench("fly", *words, "--no-picture", "--out", str(out))
    assert done.returncode == 1
    said = r"no agent heard another: \d+ frames were sent, and none arrived"
    assert re.fullmatch(f"dtsa: {said}", done.stderr.strip().splitlines()[-1])
    checked = bench("verify", str(out))
    assert checked.returncode == 0  # the protocol was kept
    assert re.search(said, checked.stdout)
    assert any(re.fullmatch(f"N{said[1:]}\\.", note) for note in run_data(out)["notes"])
