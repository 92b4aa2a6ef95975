"""Integration: flights in real time that a machine cannot keep up with, or whose channel stops: they end and say so."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fly_helpers import children, command, end_all
from node_helpers import ros_graph
from process_helpers import addresses, may_be_real_time, real_time, segments_of
from waiting import wait_for

from dtsa_agent.core.agents.delays import Delays
from dtsa_agent.stop import Stop, StopToken
from dtsa_bench.commands.fly import describe
from dtsa_bench.flights.options import FlightOptions
from dtsa_bench.recordings.verify import verify_bag
from dtsa_channel_sim.ros.pace import Pace

MS = 1_000_000
PATIENCE_S = 60.0  # far more than any flight here takes


@contextmanager
def flight(out: Path, *words: str) -> Iterator[subprocess.Popen[str]]:
    """A flight whose slots have begun."""
    whole = command("--out", str(out), "--no-picture", "--mode", "realtime", *words)
    process = subprocess.Popen(whole, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    bag = out / "bag" / "bag_0.mcap"
    try:
        wait_for(lambda: process.poll() is not None or (bag.exists() and bag.stat().st_size > 10_000))
        yield process
    finally:
        end_all(process)


def summary_of(out: Path) -> dict[str, Any]:
    return dict(json.loads((out / "summary.json").read_text()))


# Slots of 1 ms are far too short for twelve Python processes' worth of agents.
TOO_FAST = ("--policy", "tdma", "--agents", "12", "--processes", "2", "--slot-ms", "1", "--timeout-s", "5")


@pytest.mark.ros
def test_a_flight_that_no_machine_keeps_up_with_ends_by_itself_and_says_why(tmp_path: Path) -> None:
    with flight(tmp_path / "flight", *TOO_FAST) as process:
        said = process.communicate(timeout=PATIENCE_S)[1]
    summary = summary_of(tmp_path / "flight")
    assert summary["slots"]["total"] > 0
    assert summary["warning"] in said
    if process.returncode:
        assert summary["cut_short"] in said
        assert "longer slots or fewer processes would help" in summary["cut_short"]
    else:
        assert summary["end"] in ("timed out", "completed", "crashed")
    result = verify_bag(tmp_path / "flight")
    assert result.ok, result.difference


@pytest.mark.ros
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_obeyed_at_any_load(tmp_path: Path, number: int) -> None:
    with flight(tmp_path / "flight", *TOO_FAST) as process:
        started = children(process.pid)
        begin = time.monotonic()
        process.send_signal(number)
        process.communicate(timeout=PATIENCE_S)
        # The machine that tests run on may be busy; it took minutes where the signal was not looked at.
        assert time.monotonic() - begin < 10.0
        assert process.returncode == 130
        assert started
        assert not children(process.pid)
    assert summary_of(tmp_path / "flight")["end"] == "stopped"


@pytest.mark.ros
@pytest.mark.alone
@pytest.mark.realtime
def test_a_channel_that_stood_still_shows_in_what_the_agents_knew_and_makes_nobody_lost(tmp_path: Path) -> None:
    out = tmp_path / "flight"
    words = ("--policy", "tdma", "--agents", "12", "--processes", "4", "--slot-ms", "20", "--scenario", "waypoints")
    with flight(out, *words, "--stops", "50", "--axis-x-m", "8", "--timeout-s", "600", "--no-stop-on-crash") as process:
        time.sleep(1.5)
        for pause_s, then_s in ((1.5, 1.5), (3.0, 5.0)):  # what the middleware lost meanwhile, it repeats after 3 s
            os.kill(process.pid, signal.SIGSTOP)
            time.sleep(pause_s)
            os.kill(process.pid, signal.SIGCONT)
            time.sleep(then_s)
            assert process.poll() is None
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE_S)
    summary = summary_of(out)
    assert summary["lost_agents"] == summary["returned_agents"] == []
    # Nobody heard anything for three seconds: 150 slots.
    assert summary["age_max_slots"] >= 145
    pauses = sorted(end - begin for begin, end in summary["stalls"])[-2:]
    assert pauses == pytest.approx([1.5, 3.0], abs=0.4)
    assert "the channel stood still" in summary["warning"]
    assert summary["late_frames"] > 50
    result = verify_bag(out)
    assert result.ok, result.difference
    assert result.checked["frames taken in as they were delivered"] > 100
    assert result.safety["stalls"] == summary["stalls"]


@pytest.mark.ros
@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_the_clock_on_the_wall_ends_a_flight(tmp_path: Path, mode: str) -> None:
    words = ("--agents", "3", "--moving", "2", "--policy", "tdma", "--tail-s", "3600", "--timeout-s", "3600")
    limit = ("--processes", "1", "--wall-timeout-s", "3", "--mode", mode, "--no-picture")
    with flight(tmp_path / "out", *words, *limit) as process:
        nodes = [process.pid, *children(process.pid)]
        assert len(nodes) == 2
        # What is limited to this machine cannot be reached from outside, and real time has no port in shared memory.
        assert [addresses(pid) for pid in nodes] == [{"127.0.0.1"}] * 2
        assert all(bool(segments_of(pid)) == (mode == "lockstep") for pid in nodes)
        assert all(real_time(pid) == (mode == "realtime" and may_be_real_time()) for pid in nodes)
        said = process.communicate(timeout=PATIENCE_S)[1]
    assert process.returncode == 1
    assert "the flight took longer than 3 s by the clock on the wall" in said
    assert "longer than 3 s" in summary_of(tmp_path / "out")["cut_short"]
    assert verify_bag(tmp_path / "out").ok


@pytest.mark.ros
def test_a_flight_whose_agents_all_died_has_results(tmp_path: Path) -> None:
    words = ("--agents", "2", "--moving", "2", "--policy", "lease", "--processes", "1", "--tail-s", "3600")
    with flight(tmp_path / "out", *words) as process:
        (agents,) = children(process.pid)
        os.kill(agents, signal.SIGKILL)
        said = process.communicate(timeout=PATIENCE_S)[1]
        assert process.returncode == 1
    summary = summary_of(tmp_path / "out")
    assert "nobody is left" in summary["cut_short"]
    assert "nobody is left" in said
    assert summary["lost_agents"] == [1, 2]


# Without nodes.


def test_completed_and_crashed_are_never_one_line() -> None:
    summary: dict[str, Any] = {
        "agents": 2, "moving": 2, "policy": "dtsa", "estimator": "linear", "avoider": "orca", "end": "completed",
        "completion_time_s": 2.5, "collided": True, "collided_pair": [1, 2], "min_distance_m": 0.1,
        "efficiency_mean": None, "age_mean_slots": None, "realtime_factor": None,
        "slots": {"total": 9, "success": 9, "collision": 0, "idle": 0},
    }  # fmt: skip
    for end in ("completed", "crashed"):
        lines = describe({**summary, "end": end}).splitlines()
        assert lines[0].endswith(": crashed (cf1 and cf2)")
        assert not any("completed" in line for line in lines)
        assert lines[1] == "all were at their targets after 2.50 s"


def test_a_pace_knows_stalls_and_who_will_not_catch_up() -> None:
    pace = Pace(10 * MS)
    assert pace.passed(5 * MS) == 0
    assert pace.passed(54 * MS) == 0
    assert pace.passed(154 * MS) == 100 * MS
    assert pace.stalls == [(54 * MS, 154 * MS)]
    assert pace.last_stall == (54 * MS, 154 * MS)
    second = 1000 * MS
    assert not pace.falls_behind(2 * second, 0)
    assert not pace.falls_behind(6 * second, 4 * second)
    assert not pace.falls_behind(7 * second, 7 * second)  # it has caught up
    assert not pace.falls_behind(10 * second, 8 * second)
    assert pace.falls_behind(19 * second, 8 * second)
    assert pace.behind_since_s == 10.0


def test_delays_in_constant_memory_are_right_to_five_percent() -> None:
    delays, random = Delays(3), np.random.default_rng(1)
    values = np.exp(random.normal(14.0, 1.5, (2, 5000)))
    for a, b in values.T:
        delays.add_many(np.array([a, b], dtype=np.int64), np.array([0, 2]))
    for series, own in ((0, values[0]), (2, values[1]), (None, values.ravel())):
        for share in (0.1, 0.5, 0.99):
            assert delays.quantile_ms(share, series) == pytest.approx(np.quantile(own, share) / 1e6, rel=0.06)
        assert delays.largest_ms(series) == pytest.approx(own.max() / 1e6, rel=1e-6)
    assert delays.quantile_ms(0.5, 1) is None
    assert delays.largest_ms(1) is None
    delays.add(10.0**12)
    assert delays.quantile_ms(1.0) == delays.largest_ms() == 1e6


def test_an_end_has_one_reason() -> None:
    assert FlightOptions().wall_limit_s(60.0) == 600.0
    assert FlightOptions().wall_limit_s(1.0) == 120.0
    assert FlightOptions(wall_timeout_s=7.0).wall_limit_s(60.0) == 7.0
    stop = Stop()
    assert not StopToken(stop, lambda: "")
    ended = StopToken(stop, lambda: "no more time")
    assert ended
    assert ended.reason == "no more time"
    stop.signal = signal.SIGINT
    by_hand = StopToken(stop, lambda: "no more time")
    assert by_hand
    assert by_hand.reason == ""  # the user knows why


@pytest.mark.skipif(not may_be_real_time(), reason="this user may not have real-time priority")
def test_agents_go_first_once_all_have_found_each_other(tmp_path: Path) -> None:
    """Many that look for each other by turns of real-time priority need minutes for it."""
    words = ("-p", "agents:=2", "-p", "mode:=realtime")
    with ros_graph(tmp_path) as graph:
        host = graph.start("dtsa_agent.ros.swarm_host", *words, "-p", "policy:=lease", "-p", "priority:=10")
        graph.until(lambda: graph.node.count_publishers("/swarm/process"))
        assert not real_time(host.pid)
        graph.start("dtsa_channel_sim.ros.channel_node", *words)
        graph.until(lambda: real_time(host.pid))
