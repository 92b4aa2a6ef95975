"""Integration: observers of the channel: who is told what, in which order, and what happens when one of them fails."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
from fly_helpers import readable
from node_helpers import ServedNode, end_of, ros_graph

pytest.importorskip("dtsa_msgs.msg")

from dtsa_msgs.msg import Frame, Process, Report, Slot
from rclpy.node import Node

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import DtsaError, LocalProtocolError
from dtsa_agent.core.frame import Frame as RadioFrame
from dtsa_agent.core.frame import encode_frame, named_in
from dtsa_agent.core.settings.config import settings_hash
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.loop import Feed
from dtsa_agent.ros.common.messages import header_of
from dtsa_bench.flights import measurement
from dtsa_bench.flights.measurement import FlightPath
from dtsa_bench.flights.recorded_channel import RecordedFlight
from dtsa_bench.runs.config import RunConfig, RunLimits
from dtsa_channel_sim import Channel, ChannelConfig
from dtsa_channel_sim.model.verdict import Verdict
from dtsa_channel_sim.ros.answers import Answers
from dtsa_channel_sim.ros.channel_node import declare_channel
from dtsa_channel_sim.ros.lockstep import LockstepChannel
from dtsa_channel_sim.ros.observer import ChannelObserver, ObserverError, Observers
from dtsa_channel_sim.ros.realtime_channel import RealtimeChannel

Sender = TypeVar("Sender", bound="LateSender")


class Diary(ChannelObserver):
    def __init__(self, pages: list[str], name: str = "") -> None:
        self.pages, self.name = pages, name

    def all_answered(self, slot: int, answers: Answers) -> None:
        self.pages.append(f"{self.name}answered {slot}")

    def arbitrated(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        assert sorted(answers.frames) == list(verdict.senders)
        self.pages.append(f"{self.name}judged {slot}")

    def slot_over(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        self.pages.append(f"{self.name}over {slot}")

    def close(self) -> None:
        self.pages.append(f"{self.name}closed")


class Failing(ChannelObserver):
    def __init__(self, slot: int | None) -> None:
        self.slot = slot

    def slot_over(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        if slot == self.slot:
            raise ValueError("no room")

    def close(self) -> None:
        if self.slot is None:
            raise OSError("disk full")


def test_observers_are_told_in_order_and_closed_once_and_errors_are_named() -> None:
    pages: list[str] = []
    observers = Observers()
    for observer in (Diary(pages, "a"), Failing(None), Diary(pages, "b")):
        observers.add(observer)
    observers.all_answered(3, Answers(1, 1))
    with pytest.raises(ObserverError, match="Failing failed: OSError"):
        observers.close()
    observers.close()
    assert pages == ["aanswered 3", "banswered 3", "aclosed", "bclosed"]

    class Broken(ChannelObserver):
        def agent_silent(self, agent: int) -> None:
            raise LocalProtocolError(f"cf{agent} is gone")

    observers = Observers()
    observers.add(Broken())
    with pytest.raises(DtsaError, match=r"^cf4 is gone$"):
        observers.agent_silent(4)


@pytest.mark.ros
def test_a_channel_needs_no_observer_and_a_slot_is_told_in_order(tmp_path: Path) -> None:
    pages: list[str] = []
    with ros_graph(tmp_path) as graph:
        host = graph.start("dtsa_agent.ros.swarm_host", "-p", "agents:=3")
        for observers in ((), (Diary(pages),)):
            node = Node("channel", context=graph.node.context, enable_rosout=False)
            channel = LockstepChannel(node, Channel(ChannelConfig(agents=3)), 1, slots=2)
            channel.observe(*observers)
            try:
                channel.run(stop=False)
            finally:
                channel.close()
                node.destroy_node()
            assert channel.slot == 2
            assert end_of(host) == (0, "")
            if not observers:
                host = graph.start("dtsa_agent.ros.swarm_host", "-p", "agents:=3")
    assert pages == [
        "answered 0", "judged 0", "over 0", "answered 1", "judged 1", "over 1", "answered 2", "closed",
    ]  # fmt: skip


@pytest.mark.ros
def test_an_observer_that_fails_ends_the_flight_by_name_and_the_bag_is_readable(tmp_path: Path) -> None:
    swarm = SwarmConfig(agents=3)
    run = RunConfig(swarm, ChannelConfig(agents=3), RunLimits(tail_s=60.0))
    out = tmp_path / "out"
    out.mkdir()
    with ros_graph(tmp_path) as graph:
        host = graph.start("dtsa_agent.ros.swarm_host", "-p", "agents:=3")
        node = Node("channel", namespace="/swarm", context=graph.node.context, enable_rosout=False)
        declare_channel(node, run.air)
        flight = RecordedFlight(node, run, out, startup_s=60.0, answer_s=10.0)
        flight.channel.observe(Failing(25))
        try:
            with pytest.raises(ObserverError, match=r"^Failing failed: ValueError: no room$"):
                flight.channel.run(stop=False)
        finally:
            flight.channel.close()
            node.destroy_node()
        assert end_of(host) == (0, "")
    assert readable(out) == 25
    assert flight.write_results(pictures=False)["end"] == "stopped"
    assert json.loads((out / "summary.json").read_text())["slots"]["total"] == 25
    assert flight.measurement.positions.array().shape == (26, 3, 3)


class LateSender(ChannelObserver):
    """Answers for two agents; in one slot both send, agent 1 so long ago that it cannot be on the air any more."""

    def __init__(self, node: Node, channel: RealtimeChannel) -> None:
        qos, make = names.lockstep_qos(16), node.create_publisher
        self._air = make(Frame, f"{names.SWARM}/{names.AIR_FRAME}", qos)
        self._reports = make(Report, f"{names.SWARM}/{names.REPORT}", qos)
        self._processes = make(Process, f"{names.SWARM}/{names.PROCESS}", qos)
        self._channel = channel
        self._sent = False
        self._begin_s = 0.0
        self.frames: list[tuple[int, list[bool], int]] = []  # sender, received, collided

    def start_known(self, at_s: float) -> None:
        self._begin_s = at_s

    def idle(self, slot: int, awaited: list[int]) -> None:
        run_id, slot_ns = self._channel.run_id, self._channel.slot_ns
        slot = max(0, round((time.monotonic() - self._begin_s) * 1e9) // slot_ns + 5) if self._begin_s else 0
        settings = {"agents": 2, "slot_ms": slot_ns / 1e6, "steps": 1, "mode": "realtime"}
        shown = {"settings": json.dumps(settings), "settings_hash": settings_hash(settings)}
        self._processes.publish(Process(run=run_id, process=1, node="/test", agent=[1, 2], **shown))
        self._report(slot if self._begin_s else names.FIRST_CALL)
        if slot > 120 and not self._sent:
            self._sent = True
            for agent, number, start in self._sent_in(slot):
                header = header_of(round(names.slot_time_ns(0, slot_ns) + start * slot_ns))
                data = encode_frame(RadioFrame(agent, number, 1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
                self._air.publish(Frame(header=header, run=run_id, slot=number, agent=agent, data=data))

    def _sent_in(self, slot: int) -> list[tuple[int, int, float]]:
        """Sender, number of the slot that it counts, and start in slots of the frames that are sent in one."""
        return [(1, slot, slot - 40), (2, slot, slot)]

    def _report(self, slot: int, place: float = 0.0) -> None:
        places, nothing = [place] * 6, [0.0] * 6
        self._reports.publish(
            Report(
                run=self._channel.run_id, agent=[1, 2], slot=[slot], offset_ns=[0, 0], length=[0, 0],
                chosen=[0, 0], reason=[0, 0], digest=[0, 0], score=[0.0, 0.0],
                steps=1, track=places, velocity=nothing, command=nothing, goal=nothing,
            )
        )  # fmt: skip

    def arbitrated(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        for row, sender in enumerate(verdict.senders):
            self.frames.append((sender, verdict.received[row].tolist(), verdict.collided[row]))


def flown_with(kind: type[Sender], folder: Path, slots: int) -> tuple[RealtimeChannel, Sender]:
    """The channel of a flight in real time of two agents for whom an observer answers, and that observer."""
    with ros_graph(folder) as graph:
        node = Node("channel", context=graph.node.context, enable_rosout=False)
        channel = RealtimeChannel(node, Channel(ChannelConfig(agents=2)), 1, slots=slots)
        observer = kind(graph.node, channel)
        channel.observe(observer)
        try:
            channel.run(stop=False)
        finally:
            channel.close()
            node.destroy_node()
    return channel, observer


class LateAnswers(LateSender):
    """Answers all calls but the first one when the run has begun, and says then that everybody is somewhere else."""

    def __init__(self, node: Node, channel: RealtimeChannel) -> None:
        super().__init__(node, channel)
        self.slots = Feed(node, Slot, f"{names.SWARM}/{names.SLOT}", names.lockstep_qos(64))
        self.late: list[int] = []
        self.places: set[float] = set()

    def start_known(self, at_s: float) -> None:
        super().start_known(at_s)
        while (message := self.slots.take()) is not None:
            if message.phase == Slot.PREPARE and message.slot != names.FIRST_CALL:
                self.late.append(message.slot)
        for number in self.late:
            self._report(number, 9.0)

    def slot_over(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        self.places.update(answers.position.ravel().tolist())

    def close(self) -> None:
        self.slots.close()


@pytest.mark.ros
def test_an_answer_to_a_call_that_comes_late_is_not_taken_for_what_was_done_in_a_slot(tmp_path: Path) -> None:
    _, late = flown_with(LateAnswers, tmp_path, slots=40)
    assert late.late
    assert late.places == {0.0}


class SilentAtFirst(LateSender):
    """Answers calls, and reports nothing of the first slots. A stranger answers before it, from somewhere else."""

    def __init__(self, node: Node, channel: RealtimeChannel) -> None:
        super().__init__(node, channel)
        self.places: list[list[float]] = []
        self._stranger, self._forged = ServedNode(node.context.get_domain_id(), "stranger"), 0
        make, topic = self._stranger.node.create_publisher, f"{names.SWARM}/{names.REPORT}"
        self._own, self._foreign = self._reports, make(Report, topic, names.lockstep_qos(16))

    def _report(self, slot: int, place: float = 3.0) -> None:
        is_forged = self._forged < 3
        if is_forged and not self._foreign.get_subscription_count():
            return
        self._forged += is_forged
        self._reports = self._foreign if is_forged else self._own
        if slot >= names.FIRST_CALL or slot > 100:
            super()._report(slot, 9.0 if is_forged else place)

    def slot_over(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        self.places.append(answers.position.ravel().tolist())

    def close(self) -> None:
        self._stranger.close()


@pytest.mark.ros
def test_who_is_late_with_its_first_report_is_where_it_was_when_it_was_called(tmp_path: Path) -> None:
    """Taken for the field's origin, two who were late were taken for crashed."""
    _, silent = flown_with(SilentAtFirst, tmp_path, slots=20)
    assert silent.places == [[3.0] * 6] * 20


@pytest.mark.ros
@pytest.mark.realtime
def test_in_real_time_a_frame_that_comes_too_late_is_dropped_and_counted(tmp_path: Path) -> None:
    channel, sender = flown_with(LateSender, tmp_path, slots=150)
    assert channel.air.late == 1
    # That of agent 1 disturbed nobody; agent 2 was heard by the one other agent.
    assert sender.frames == [(2, [True, False], 0)]


class BehindSender(LateSender):
    """Agent 1 counts slots that are long over, and sends twice in one."""

    def _sent_in(self, slot: int) -> list[tuple[int, int, float]]:
        return [(1, 0, slot), (1, 1, slot + 0.1)]

    def arbitrated(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        self.frames += [(named_in(answers.frames[sender]) or (0, 0))[1] for sender in verdict.senders]


@pytest.mark.ros
@pytest.mark.realtime
def test_two_frames_of_one_sender_in_one_slot_are_both_there(tmp_path: Path) -> None:
    _, sender = flown_with(BehindSender, tmp_path, slots=150)
    assert sender.frames == [0, 1]


def test_a_path_that_grows_too_long_keeps_every_second_slot(monkeypatch: pytest.MonkeyPatch) -> None:
    positions = np.random.default_rng(1).normal(size=(50, 3, 7))
    for most, step in ((1 << 20, 1), (3 * 7 * 8 * 20, 4)):
        monkeypatch.setattr(measurement, "_MAX_PATH_BYTES", most)
        path = FlightPath(7)
        assert path.array().shape == (0, 3, 7)
        for position in positions:
            path.append(position)
        assert np.array_equal(path.array(), positions[::step])
