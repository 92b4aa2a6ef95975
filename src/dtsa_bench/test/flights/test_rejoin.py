"""Integration: agent processes that die, hang, leave and come back while a flight in real time is under way."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from fly_helpers import children, end_all, process_with

from dtsa_agent.core import REASONS, SwarmConfig, make_scenario
from dtsa_agent.core.frame import decode_extended
from dtsa_agent.core.reference.lease.memory import Memory
from dtsa_agent.core.reference.rules import Rules
from dtsa_bench.recordings.bag.reader import Bag
from dtsa_bench.recordings.verify import verify_bag
from dtsa_bench.runs.config import RunConfig, RunLimits
from dtsa_bench.runs.metrics import COMPLETED, CRASHED, FlightMetrics
from dtsa_channel_sim.model.verdict import SUCCESS

PATIENCE_S = 100.0
# Room enough that nobody is where another one appears again; without OPEN turns and adoption no frames may ever meet.
ROOMY = (
    "--agents", "4", "--moving", "4", "--scenario", "waypoints", "--axis-x-m", "6", "--stops", "50",
    "--mode", "realtime", "--clock-offset-ns", "200000", "--clock-drift-ppm", "50", "--loss", "0.1",
    "--timeout-s", "3600", "--no-picture",
)  # fmt: skip
LEASE = ("--policy", "lease", "--open-every", "0", "--no-adoption")


class Flight:
    """A flight under way that the test ends."""

    def __init__(self, out: Path, words: tuple[str, ...]) -> None:
        self.out, self._log = out, out.with_suffix(".log")
        command = [sys.executable, "-m", "dtsa_bench", "fly", "--out", str(out), *words]
        with self._log.open("wb") as log:
            self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=log)

    @property
    def said(self) -> str:
        return self._log.read_text()

    @property
    def under_way(self) -> bool:
        """Whether slots are being flown."""
        bag = self.out / "bag" / "bag_0.mcap"
        return bag.exists() and bag.stat().st_size > 20_000

    def until(self, condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert self.process.poll() is None, self.said
            assert time.monotonic() < deadline, f"nothing happened: {self.said}"
            time.sleep(0.05)

    def fly_on(self, slots: int) -> None:
        """Waits for so many slots, each of 10 ms by the clock."""
        time.sleep(slots * 0.01)
        assert self.process.poll() is None, self.said

    def pid(self, argument: str) -> int:
        """The process that was started with an argument."""
        return process_with(self.process.pid, argument)

    def land(self) -> dict[str, object]:
        """Ends the flight; its summary."""
        self.process.send_signal(signal.SIGINT)
        self.process.wait(PATIENCE_S)
        assert self.process.returncode == 130, self.said
        assert children(self.process.pid) == []
        result = verify_bag(self.out)
        assert result.ok, result.difference
        self.safety = result.safety
        return dict(json.loads((self.out / "summary.json").read_text()))


@contextmanager
def flying(out: Path, *words: str) -> Iterator[Flight]:
    flight = Flight(out, words)
    try:
        flight.until(lambda: flight.under_way)
        yield flight
    finally:
        end_all(flight.process)


@dataclass
class Report:
    """What an agent said in one slot."""

    slot: int
    speaker: int  # whom it took for the slot's sender
    reason: str
    place: np.ndarray  # (3,) m
    frame: bytes
    heard: int = 0  # by how many


def reports(out: Path, agent: int) -> list[Report]:
    found: list[Report] = []
    heard = {}
    with Bag(out / "bag") as bag:
        for _, message in bag.typed(["/swarm/transmission", "/swarm/slot"]):
            if hasattr(message, "heard_slot"):
                if agent in message.sender.tolist():
                    heard[int(message.heard_slot)] = int(np.unpackbits(message.received).sum())
            elif agent in message.agent.tolist():
                k, count = message.agent.tolist().index(agent), len(message.agent)
                before, length = int(message.length[:k].sum()), int(message.length[k])
                place = message.track.reshape(message.steps, 3, count)[-1, :, k]
                data = message.data[before : before + length].tobytes()
                found.append(Report(int(message.slot), int(message.chosen[k]), REASONS[message.reason[k]], place, data))
    for report in found:
        report.heard = heard.get(report.slot, 0) if report.frame else 0
    return found


def before_and_after(out: Path, agent: int) -> tuple[list[Report], list[Report]]:
    """An agent's reports before and after it was away, which was longer than any report can have been late."""
    found = reports(out, agent)
    back = max(range(1, len(found)), key=lambda k: found[k].slot - found[k - 1].slot)
    return found[:back], found[back:]


def first_turn(found: list[Report], agent: int) -> Report:
    """When an agent first takes a turn for its own, even if it is not ready to speak in time."""
    return next(report for report in found if report.speaker == agent)


def begins_at_an_anchor(found: list[Report], agent: int) -> bool:
    """Whether an agent that is back, on probation, takes no turn of its own before an anchor.

    Its reports of the first slots may come too late: the anchor may be its turn right before the first that is known.
    """
    first, rules = first_turn(found, agent), Memory(Rules(agents=4, slot_s=0.01))
    before = first.slot - 4
    return first.reason == "anchor" or (before < found[0].slot and rules.is_anchor(before))


@pytest.mark.ros
@pytest.mark.parametrize(
    ("argument", "agents", "words"),
    [
        ("__ns:=/cf2", [2], LEASE),
        ("__node:=swarm_host_2", [3, 4], ("--processes", "2", *LEASE)),
        ("__ns:=/cf2", [2], ("--policy", "tdma", "--frame", "extended")),
    ],
)
@pytest.mark.alone
@pytest.mark.realtime
def test_a_killed_process_comes_back_and_its_agents_are_heard_again(
    tmp_path: Path, argument: str, agents: list[int], words: tuple[str, ...]
) -> None:
    with flying(tmp_path / "flight", *ROOMY, *words, "--respawn", "0") as flight:
        os.kill(flight.pid(argument), signal.SIGKILL)
        flight.until(lambda: "again" in flight.said.replace("started again", ""))
        flight.fly_on(300)
        summary = flight.land()
    assert "was killed by SIGKILL; the others fly on" in flight.said
    assert "has not been heard of" not in flight.said
    assert summary["lost_agents"] == []
    assert summary["returned_agents"] == agents
    assert summary["collided"] is False
    assert flight.safety["frames_collided"] == 0
    for agent in agents:
        before, after = before_and_after(flight.out, agent)
        # Its program started again, its vehicle went on hovering where it was.
        assert after[0].place == pytest.approx(before[-1].place, abs=0.1)  # the last report may not have come in yet
        assert sum(report.heard > 0 for report in after) > 5
        assert np.linalg.norm(after[-1].place - after[0].place) > 0.1
        first = next(k for k, report in enumerate(after) if report.frame)
        assert after[first].place == pytest.approx(after[0].place)  # nobody flies before it has been heard
        if "lease" in words:
            assert begins_at_an_anchor(after, agent)


@pytest.mark.ros
@pytest.mark.alone
@pytest.mark.realtime
def test_a_process_that_stood_still_for_long_begins_anew(tmp_path: Path) -> None:
    with flying(tmp_path / "flight", *ROOMY, *LEASE) as flight:
        asleep = flight.pid("__ns:=/cf2")
        os.kill(asleep, signal.SIGSTOP)
        flight.fly_on(700)
        os.kill(asleep, signal.SIGCONT)
        flight.until(lambda: "cf2 takes part again" in flight.said)
        flight.fly_on(300)
        summary = flight.land()
    assert "cf2 has not been heard of for 2 s; the others fly on" in flight.said
    assert summary["lost_agents"] == []
    assert summary["returned_agents"] == [2]
    assert flight.safety["frames_collided"] == 0
    _, after = before_and_after(flight.out, 2)
    assert begins_at_an_anchor(after, 2)
    assert sum(report.heard > 0 for report in after) > 5


@pytest.mark.ros
@pytest.mark.alone
@pytest.mark.realtime
def test_sigterm_lets_an_agent_say_farewell_and_a_second_one_does_not_wait(tmp_path: Path) -> None:
    with flying(tmp_path / "flight", *ROOMY, "--policy", "lease", "--respawn", "0") as flight:
        os.kill(flight.pid("__ns:=/cf2"), signal.SIGTERM)
        flight.until(lambda: "cf2 has left; the others fly on" in flight.said)
        impatient = flight.pid("__ns:=/cf3")
        os.kill(impatient, signal.SIGTERM)
        os.kill(impatient, signal.SIGINT)
        flight.until(lambda: "cf3 has left; the others fly on" in flight.said)
        flight.fly_on(50)
        summary = flight.land()
    assert "started again" not in flight.said
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

    from dtsa_agent.ros.common.graph import names
    from dtsa_agent.ros.common.process.runs import Run

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
@pytest.mark.alone
@pytest.mark.realtime
def test_an_agent_may_come_late(tmp_path: Path) -> None:
    with flying(tmp_path / "flight", *ROOMY, *LEASE, "--late", "cf3=0.5") as flight:
        flight.until(lambda: "cf3 takes part\n" in flight.said)
        flight.fly_on(300)
        summary = flight.land()
    assert "has not been heard of" not in flight.said
    assert (summary["lost_agents"], summary["returned_agents"]) == ([], [3])
    assert flight.safety["frames_collided"] == 0
    found = reports(flight.out, 3)
    assert found[0].slot > 50
    scenario = make_scenario(SwarmConfig(agents=4, moving=4, scenario="waypoints", axis_x_m=6.0, stops=50))
    assert found[0].place == pytest.approx(scenario.start[:, 2])
    assert begins_at_an_anchor(found, 3)
    assert sum(report.heard > 0 for report in found) > 5


@pytest.mark.ros
@pytest.mark.alone
@pytest.mark.realtime
def test_a_flight_without_anybody_is_over_unless_they_come_back(tmp_path: Path) -> None:
    few = (
        "--agents",
        "2",
        "--moving",
        "2",
        "--mode",
        "realtime",
        "--policy",
        "lease",
        "--processes",
        "1",
        "--no-picture",
    )
    with flying(tmp_path / "over", *few) as flight:
        os.kill(flight.pid("__node:=swarm_host_1"), signal.SIGKILL)
        assert flight.process.wait(PATIENCE_S) == 1
        assert "nobody is left: swarm_host_1 with cf1 .. cf2" in flight.said
    with flying(tmp_path / "again", *few, "--respawn", "0") as flight:
        os.kill(flight.pid("__node:=swarm_host_1"), signal.SIGKILL)
        assert flight.process.wait(PATIENCE_S) == 0, flight.said
    assert "cf1 .. cf2 take part again" in flight.said
    summary = json.loads((flight.out / "summary.json").read_text())
    assert (summary["end"], summary["returned_agents"]) == ("completed", [1, 2])
    result = verify_bag(flight.out)
    assert result.ok, result.difference


# Without nodes.


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--respawn", "1"], "respawn: got 1.0; allowed: only with --mode realtime"),
        (["--respawn", "-1", "--mode", "realtime", "--policy", "tdma"], "respawn: got -1.0; allowed: 0 to 3600 s"),
        (
            ["--respawn", "1", "--mode", "realtime", "--policy", "dtsa"],
            "policy: got 'dtsa'; allowed: tdma, aloha, lease",
        ),
        (["--late", "cf2"], "late: got 'cf2'; allowed: cfK=S,..."),
        (["--late", "cf2=1"], "late: got {2: 1.0}; allowed: only with --mode realtime"),
        (["--late", "cf13=1", "--mode", "realtime", "--policy", "tdma"], "late: got {13: 1.0}; allowed: some, not all"),
        (
            ["--late", "cf2=1", "--mode", "realtime", "--policy", "lease", "--processes", "2"],
            "late: got {2: 1.0}; allowed: only with --processes per-agent",
        ),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    from dtsa_bench.commands.cli import main

    assert main(["fly", "--out", str(tmp_path / "out"), *words]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"dtsa: error: {said}")
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_who_is_back_counts_again() -> None:
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


def test_who_flies_into_a_dead_agents_vehicle_has_crashed() -> None:
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
