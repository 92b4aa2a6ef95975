"""Integration: agent processes that die, hang, leave and come back while a flight in real time is under way."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fly_helpers import PATIENCE_S, FlightProcess, process_with, start_flight, summary_of, verified

from dtsa_agent.core import REASONS, SwarmConfig, make_scenario
from dtsa_agent.core.frame import decode_extended
from dtsa_agent.core.reference.lease import Memory
from dtsa_agent.core.reference.table import Rules
from dtsa_bench.log.record import load_log
from dtsa_bench.runs.config import RunConfig, RunLimits
from dtsa_bench.runs.metrics import COMPLETED, CRASHED, FlightMetrics
from dtsa_channel_sim.model.verdict import SUCCESS

# Room enough that nobody is where another one appears again; without OPEN turns and adoption no frames may ever meet.
ROOMY = (
    "--agents", "4", "--moving", "4", "--scenario", "waypoints", "--axis-x-m", "6", "--stops", "50",
    "--mode", "realtime", "--clock-offset-ns", "200000", "--clock-drift-ppm", "50", "--loss", "0.1",
    "--timeout-s", "3600", "--no-picture",
)  # fmt: skip
LEASE = ("--policy", "lease", "--open-every", "0", "--no-adoption")


def fly_on(flight: FlightProcess, slots: int) -> None:
    time.sleep(slots * 0.01)
    assert flight.process.poll() is None, flight.stderr()


def land(flight: FlightProcess, slots: int) -> dict[str, Any]:
    """Ends a flight after so many slots; its summary. No frames have met."""
    fly_on(flight, slots)
    summary = flight.interrupt()
    assert flight.safety["frames_collided"] == 0
    return summary


@dataclass
class Report:
    slot: int
    speaker: int  # whom it took for the slot's sender
    reason: str
    place: np.ndarray  # (3,) m
    frame: bytes
    heard: int = 0  # by how many


def assert_told_alike(summary: dict[str, Any], out: Path) -> None:
    """What a bag says of a flight is what the flight has said of itself, whoever came, went and came back."""
    log = load_log(out)
    told, heard = log.summary, log.receptions
    assert log.absent is None or not log.absent[heard.slot, heard.receiver - 1].any()
    assert heard.groupby(["slot", "sender"]).received.sum().tolist() == log.frames.received.tolist()
    for name in ("end", "completed", "collided", "lost_agents", "min_distance_pair", "wakings"):
        assert told[name] == summary[name], name
    for name in ("min_distance_m", "age_mean_slots", "agreement_share", "waking_age_mean_slots"):
        assert told[name] == pytest.approx(summary[name], rel=0.1), name
    receptions = summary["receptions"]  # the last ones may not have been reported
    assert receptions["taken_in"] <= receptions["delivered"] < receptions["taken_in"] + 30


def reports(out: Path, agent: int) -> list[Report]:
    log, column = load_log(out), agent - 1
    heard = {
        int(row): int(mask.sum()) for row, sender, _, mask, *_ in zip(*log.sent_frames, strict=True) if sender == agent
    }
    return [
        Report(
            row, int(log.chosen[row, column]), REASONS[log.reason[row, column]], log.track[row, -1, :, column],
            log.frame(row, agent), heard.get(row, 0),
        )
        for row in np.flatnonzero(log.known[:, column]).tolist()
    ]  # fmt: skip


def before_and_after(out: Path, agent: int) -> tuple[list[Report], list[Report]]:
    """An agent's reports before and after it was away, which was longer than any report can have been late."""
    found = reports(out, agent)
    back = max(range(1, len(found)), key=lambda k: found[k].slot - found[k - 1].slot)
    return found[:back], found[back:]


def begins_at_an_anchor(found: list[Report], agent: int) -> bool:
    """Whether an agent that is back, on probation, takes no turn of its own before an anchor.

    Its reports of the first slots may come too late: the anchor may be its turn right before the first that is known.
    """
    first, rules = next(report for report in found if report.speaker == agent), Memory(Rules(agents=4, slot_s=0.01))
    before = first.slot - 4
    return first.reason == "anchor" or (before < found[0].slot and rules.is_anchor(before))


@pytest.mark.ros
@pytest.mark.parametrize(("argument", "agents", "words"), [
    ("__ns:=/cf2", [2], LEASE), ("__node:=swarm_host_2", [3, 4], ("--processes", "2", *LEASE)),
    ("__ns:=/cf2", [2], ("--policy", "tdma", "--frame", "extended")),
])  # fmt: skip
@pytest.mark.realtime
def test_a_killed_process_comes_back_and_its_agents_are_heard_again(tmp_path, argument, agents, words):
    with start_flight(tmp_path, *ROOMY, *words, "--respawn", "0") as flight:
        os.kill(process_with(flight.process.pid, argument), signal.SIGKILL)
        flight.until_says("takes part again", "take part again")
        summary = land(flight, 300)
    assert "was killed by SIGKILL; the others fly on" in flight.stderr()
    assert "has not been heard of" not in flight.stderr()
    assert (summary["lost_agents"], summary["returned_agents"], summary["collided"]) == ([], agents, False)
    assert_told_alike(summary, flight.out)
    for agent in agents:
        before, after = before_and_after(flight.out, agent)
        assert summary["age_max_slots"] < after[0].slot - before[-1].slot  # nobody's knowledge grew old meanwhile
        # Its program started again, its vehicle went on hovering where it was.
        assert after[0].place == pytest.approx(before[-1].place, abs=0.1)  # the last report may not have come in yet
        assert sum(report.heard > 0 for report in after) > 5
        assert np.linalg.norm(after[-1].place - after[0].place) > 0.1
        first = next(k for k, report in enumerate(after) if report.frame)
        assert after[first].place == pytest.approx(after[0].place)  # nobody flies before it has been heard
        if "lease" in words:
            assert begins_at_an_anchor(after, agent)


@pytest.mark.ros
@pytest.mark.realtime
def test_a_process_that_stood_still_for_long_begins_anew(tmp_path: Path) -> None:
    with start_flight(tmp_path, *ROOMY, *LEASE) as flight:
        asleep = flight.pid_of(2)
        os.kill(asleep, signal.SIGSTOP)
        fly_on(flight, 700)
        os.kill(asleep, signal.SIGCONT)
        flight.until_says("cf2 takes part again")
        summary = land(flight, 300)
    assert "cf2 has not been heard of for 2 s; the others fly on" in flight.stderr()
    assert (summary["lost_agents"], summary["returned_agents"]) == ([], [2])
    _, after = before_and_after(flight.out, 2)
    assert begins_at_an_anchor(after, 2)
    assert sum(report.heard > 0 for report in after) > 5


@pytest.mark.ros
@pytest.mark.realtime
def test_sigterm_lets_an_agent_say_farewell_and_a_second_one_does_not_wait(tmp_path: Path) -> None:
    with start_flight(tmp_path, *ROOMY, "--policy", "lease", "--respawn", "0") as flight:
        os.kill(flight.pid_of(2), signal.SIGTERM)
        flight.until_says("cf2 has left; the others fly on")
        impatient = flight.pid_of(3)
        os.kill(impatient, signal.SIGTERM)
        os.kill(impatient, signal.SIGINT)
        flight.until_says("cf3 has left; the others fly on")
        fly_on(flight, 50)
        summary = flight.interrupt()
    assert "started again" not in flight.stderr()
    assert summary["lost_agents"] == [2, 3]
    sent = [report for report in reports(flight.out, 2) if report.frame]
    last = sent[-1]
    assert decode_extended(last.frame).leaving
    assert last.heard > 0
    assert not any(decode_extended(report.frame).leaving for report in sent[:-1])


@pytest.mark.ros
def test_who_comes_late_with_a_policy_of_equal_tables_is_told_so(tmp_path: Path) -> None:
    pytest.importorskip("dtsa_msgs.msg")
    from dtsa_msgs.msg import Slot
    from node_helpers import end_of, ros_graph

    from dtsa_agent.ros.common import names
    from dtsa_agent.ros.common.runs import Run

    with ros_graph(tmp_path) as graph:
        channel = graph.node.create_publisher(Slot, "/swarm/slot", names.lockstep_qos(4))
        options = ("agents:=3", "policy:=dtsa", "mode:=realtime")
        late = graph.start("dtsa_agent.ros.agent_node", *(word for option in options for word in ("-p", option)))
        run = Run.draw()
        start = Slot(run=run.number, phase=Slot.START, data=run.call("/test"))
        start.header.stamp.sec = 1
        deadline = time.monotonic() + PATIENCE_S
        while late.poll() is None and time.monotonic() < deadline:
            channel.publish(start)
            graph.executor.spin_once(timeout_sec=0.1)
        code, said = end_of(late)
    assert code == 2
    assert "policy: got 'dtsa'; allowed: tdma, aloha, lease, to come into a flight that is under way" in said


@pytest.mark.ros
@pytest.mark.realtime
def test_an_agent_may_come_late(tmp_path: Path) -> None:
    with start_flight(tmp_path, *ROOMY, *LEASE, "--late", "cf3=0.5") as flight:
        flight.until_says("cf3 takes part\n")
        summary = land(flight, 300)
    assert "has not been heard of" not in flight.stderr()
    assert (summary["lost_agents"], summary["returned_agents"]) == ([], [3])
    assert_told_alike(summary, flight.out)
    assert "other run" not in summary["not_taken_in"]  # what it has heard before it was called
    assert verified(flight.out).checked["decisions made again"] > 3 * 50  # of those that were there from the start
    found = reports(flight.out, 3)
    assert found[0].slot > 50
    scenario = make_scenario(SwarmConfig(agents=4, moving=4, scenario="waypoints", axis_x_m=6.0, stops=50))
    assert found[0].place == pytest.approx(scenario.start[:, 2])
    assert begins_at_an_anchor(found, 3)
    assert sum(report.heard > 0 for report in found) > 5


@pytest.mark.ros
@pytest.mark.realtime
def test_a_flight_without_anybody_is_over_unless_they_come_back(tmp_path: Path) -> None:
    few = ("--agents", "2", "--moving", "2", "--processes", "1", "--mode", "realtime", "--policy", "lease")
    with start_flight(tmp_path / "over", *few, "--no-picture") as flight:
        os.kill(flight.nodes[0], signal.SIGKILL)
        flight.assert_ends(1, "no agent is left: swarm_host_1 with cf1 .. cf2")
        flight.assert_verifies()
    summary = summary_of(flight.out)
    assert "no agent is left" in summary["cut_short"]
    assert summary["lost_agents"] == [1, 2]
    with start_flight(tmp_path / "again", *few, "--no-picture", "--respawn", "0") as flight:
        os.kill(flight.nodes[0], signal.SIGKILL)
        flight.assert_ends(0, "cf1 .. cf2 take part again")
        flight.assert_verifies()
    summary = summary_of(flight.out)
    assert (summary["end"], summary["returned_agents"]) == ("completed", [1, 2])


def test_who_is_back_counts_again_and_who_flies_into_a_dead_agents_vehicle_has_crashed() -> None:
    config = SwarmConfig(agents=4, moving=4, slot_ms=100.0)
    scenario = make_scenario(config)
    metrics = FlightMetrics(RunConfig(config, limits=RunLimits(tail_s=0.0, timeout_s=30.0)), scenario)
    there, slot = scenario.target, 0

    def fly(places: np.ndarray) -> str:
        nonlocal slot
        slot += 1
        return metrics.update(slot - 1, places[None], None, SUCCESS)

    metrics.lose(2)
    elsewhere = there.copy()
    elsewhere[:, 1] = there[:, 0]  # where another one is: but what is said about a lost one does not count
    metrics.regain(2)
    metrics.lose(2)
    aside = scenario.start.copy()
    aside[:, 2] += 5.0  # in nobody's way: its vehicle hovers there while its program is away
    assert fly(aside) == ""
    metrics.regain(2)
    away = there.copy()
    away[:, 1] += 5.0
    metrics.lose(3)
    metrics.awaited.add(3)
    assert fly(there) == ""  # one is still to come
    metrics.regain(3)
    assert fly(away) == ""  # all others have arrived
    assert fly(there) == COMPLETED
    assert metrics.summary()["lost_agents"] == []
    assert set(metrics.efficiencies()) == {1, 4}  # of its way a part is not known
    metrics.lose(2)
    assert fly(elsewhere) == COMPLETED
    assert metrics.crash_slot < 0
    metrics.regain(2)
    fly(elsewhere)
    assert metrics.crash_slot > 0
    assert metrics.collided_pair == (1, 2)
    config = SwarmConfig(agents=4, moving=4, slot_ms=100.0)
    scenario = make_scenario(config)
    metrics = FlightMetrics(RunConfig(config), scenario)
    metrics.lose(2)
    assert metrics.update(0, scenario.start[None], None, SUCCESS) == ""
    into = scenario.start.copy()
    into[:, 0] = scenario.start[:, 1]
    into[:, 1] += 10.0  # it is not where somebody says that it is
    assert metrics.update(1, into[None], None, SUCCESS) == CRASHED
    assert metrics.collided_pair == (1, 2)
