"""Integration: flights in real time that a machine cannot keep up with, or whose channel stops: they end and say so."""

from __future__ import annotations

import os
import signal
import time
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fly_helpers import FlightProcess, children, start_flight, summary_of, verified
from node_helpers import ros_graph
from process_helpers import addresses, may_be_real_time, real_time, segments_of

from dtsa_agent.core.delays import Delays
from dtsa_agent.stop import Stop, StopToken
from dtsa_bench.commands.fly import describe
from dtsa_bench.flights.options import FlightOptions
from dtsa_channel_sim.ros.realtime_channel import Pace

MS = 1_000_000


def started(directory: Path, *words: str, begun: bool = True) -> AbstractContextManager[FlightProcess]:
    return start_flight(directory, "--no-picture", "--mode", "realtime", *words, begun=begun)


# Slots of 1 ms are far too short for twelve Python processes' worth of agents.
TOO_FAST = ("--policy", "tdma", "--agents", "12", "--processes", "2", "--slot-ms", "1", "--timeout-s", "5")


@pytest.mark.ros
def test_a_flight_that_no_machine_keeps_up_with_ends_by_itself_and_says_why(tmp_path: Path) -> None:
    with started(tmp_path, *TOO_FAST, begun=False) as flight:
        code, said = flight.end(), flight.stderr()
    summary = summary_of(flight.out)
    assert summary["slots"]["total"] > 0
    assert summary["warning"] in said
    if code:
        assert summary["cut_short"] in said
        assert "longer slots or fewer processes would help" in summary["cut_short"]
    else:
        assert summary["end"] in ("timed out", "completed", "crashed")
    verified(flight.out)


@pytest.mark.ros
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_obeyed_at_any_load(tmp_path: Path, number: int) -> None:
    with started(tmp_path, *TOO_FAST) as flight:
        begin = time.monotonic()
        flight.process.send_signal(number)
        # The machine that tests run on may be busy; it took minutes where the signal was not looked at.
        assert flight.process.wait(10.0) == 130
        assert time.monotonic() - begin < 10.0
        assert flight.nodes
        assert not children(flight.process.pid)
    assert summary_of(flight.out)["end"] == "stopped"


@pytest.mark.ros
@pytest.mark.alone
@pytest.mark.realtime
def test_a_channel_that_stood_still_shows_in_what_the_agents_knew_and_makes_nobody_lost(tmp_path: Path) -> None:
    words = ("--policy", "tdma", "--agents", "12", "--processes", "4", "--slot-ms", "20", "--scenario", "waypoints")
    more = ("--stops", "50", "--axis-x-m", "8", "--timeout-s", "600", "--no-stop-on-crash")
    with started(tmp_path, *words, *more) as flight:
        time.sleep(1.5)
        for pause_s, then_s in ((1.5, 1.5), (3.0, 5.0)):  # what the middleware lost meanwhile, it repeats after 3 s
            os.kill(flight.process.pid, signal.SIGSTOP)
            time.sleep(pause_s)
            os.kill(flight.process.pid, signal.SIGCONT)
            time.sleep(then_s)
        summary = flight.interrupt()
    assert summary["lost_agents"] == summary["returned_agents"] == []
    # Nobody heard anything for three seconds: 150 slots.
    assert summary["age_max_slots"] >= 145
    pauses = sorted(end - begin for begin, end in summary["stalls"])[-2:]
    assert pauses == pytest.approx([1.5, 3.0], abs=0.4)
    assert "the channel stood still" in summary["warning"]
    assert summary["late_frames"] > 50
    assert verified(flight.out).checked["frames taken in as they were delivered"] > 100
    assert flight.safety["stalls"] == summary["stalls"]


@pytest.mark.ros
@pytest.mark.alone
@pytest.mark.realtime
def test_agents_that_stood_still_together_are_not_lost_and_what_they_report_counts(tmp_path: Path) -> None:
    words = ("--policy", "tdma", "--agents", "12", "--processes", "4", "--slot-ms", "20", "--scenario", "waypoints")
    with started(tmp_path, *words, "--stops", "50", "--axis-x-m", "8", "--timeout-s", "600") as flight:
        time.sleep(1.0)
        for number, then_s in ((signal.SIGSTOP, 3.0), (signal.SIGCONT, 2.0)):
            for pid in flight.nodes:
                os.kill(pid, number)
            time.sleep(then_s)
        summary = flight.interrupt()
    assert summary["lost_agents"] == summary["returned_agents"] == []
    assert summary["missed_reports"] < 180  # of 1800 entries, for 150 slots
    verified(flight.out)


@pytest.mark.ros
@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_the_clock_on_the_wall_ends_a_flight(tmp_path: Path, mode: str) -> None:
    words = ("--agents", "3", "--moving", "2", "--policy", "tdma", "--tail-s", "3600", "--timeout-s", "3600")
    limit = ("--processes", "1", "--wall-timeout-s", "3", "--mode", mode, "--no-picture")
    with started(tmp_path, *words, *limit) as flight:
        nodes = [flight.process.pid, *flight.nodes]
        assert len(nodes) == 2
        # What is limited to this machine cannot be reached from outside, nor through shared memory.
        assert [addresses(pid) for pid in nodes] == [{"127.0.0.1"}] * 2
        assert not any(segments_of(pid) for pid in nodes)
        assert all(real_time(pid) == (mode == "realtime" and may_be_real_time()) for pid in nodes)
        flight.assert_ends(1, "the flight took longer than 3 s by the clock on the wall")
        flight.assert_verifies()
    assert "longer than 3 s" in summary_of(flight.out)["cut_short"]


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
    assert pace.passed(5 * MS) is None
    assert pace.passed(54 * MS) is None
    assert pace.passed(154 * MS) == (54 * MS, 154 * MS)
    assert pace.stalls == [(54 * MS, 154 * MS)]
    second = 1000 * MS
    assert not pace.falls_behind(2 * second, 0)
    assert not pace.falls_behind(6 * second, 4 * second)
    assert not pace.falls_behind(7 * second, 7 * second)  # it has caught up
    assert not pace.falls_behind(10 * second, 8 * second)
    assert pace.falls_behind(19 * second, 8 * second)
    assert pace.behind_since_s == 10.0


def test_delays_in_constant_memory_are_right_to_five_percent() -> None:
    delays, one_by_one, random = Delays(3), Delays(), np.random.default_rng(1)
    values = np.exp(random.normal(14.0, 1.5, (2, 5000)))
    for a, b in values.T:
        delays.add_many(np.array([a, b], dtype=np.int64), np.array([0, 2]))
        one_by_one.add(int(a))
    shares = (0.0, 0.1, 0.5, 0.99, 1.0)
    assert [one_by_one.quantile_ms(share) for share in shares] == [delays.quantile_ms(share, 0) for share in shares]
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
