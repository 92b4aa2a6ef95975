"""Integration: what a flight tells a page, and when: sent while nobody waits for the channel, gathered as rarely."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from view_helpers import numbers

pytest.importorskip("dtsa_msgs.msg")

from dtsa_agent.core import Swarm, SwarmConfig
from dtsa_bench.flights.measurement import FlightMeasurement
from dtsa_bench.pages.view import flight_observer as view_observer
from dtsa_bench.pages.view.flight_observer import ViewObserver
from dtsa_bench.pages.view.moments import MOST_FRAMES, UNKNOWN, Gathered, Moment, Moments, told
from dtsa_bench.runs.config import RunConfig
from dtsa_channel_sim import Channel, ChannelConfig
from dtsa_channel_sim.model.verdict import SUCCESS
from dtsa_channel_sim.ros.answers import Answers

AGENTS = 6


class Link:
    """A server that keeps what it is told."""

    control = False

    def __init__(self) -> None:
        self.able = True
        self.moments: list[Moment] = []
        self.moving = [True] * AGENTS

    def ready(self) -> bool:
        return self.able

    def offer(self, data: bytes) -> bool:
        return True

    def moment(self, gathered: Gathered) -> bool:
        self.moments.append(told(gathered, self.moving))
        return True

    last = offer


class Flown:
    """A lossy flight in lockstep, by the core alone, that a page is told.

    :param monkeypatch: gives the observer a clock of its own.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        config = SwarmConfig(agents=AGENTS, moving=5, seed=2)
        air = ChannelConfig(agents=AGENTS, slot_ns=config.slot_ns, loss=0.2, seed=2)
        run = RunConfig(config, air)
        self.swarm, self.link, self.channel, self.now_s = Swarm(config), Link(), Channel(air), 100.0
        self.answers, self.measurement = Answers(AGENTS, config.steps), FlightMeasurement(run, self.swarm.scenario)
        monkeypatch.setattr(view_observer, "time", SimpleNamespace(monotonic=lambda: self.now_s))
        link: Any = self.link
        self.observer = ViewObserver(link, "flown", run, self.measurement, None, lambda _: "")
        self.observers = self.measurement, self.observer
        self.agreed = 0  # slots in which all took the same agent for the sender
        self.link.moving = self.swarm.scenario.moving.tolist()
        self.slot = 0
        self.told: list[tuple[int, int, int, int]] = []  # slot, sender, reason, receivers: of each frame
        self.heard: dict[int, bytes] = {}  # ages in all tables at the start of a slot, as moments tell them

    def fly(self, slots: int, slot_s: float) -> None:
        """Flies on.

        :param slots: so many.
        :param slot_s: s of wall time that each takes.
        """
        for slot in range(self.slot, self.slot + slots):
            self._fly_slot(slot)
            self.now_s += slot_s
        self.slot += slots

    def _fly_slot(self, slot: int) -> None:
        swarm, answers, observers = self.swarm, self.answers, self.observers
        swarm.scenario.advance(slot, swarm)
        senders = swarm.begin(slot)
        known = self.measurement.tables.sent_slot
        ages = np.clip(slot - 1 - known, 0, UNKNOWN - 1).astype("<u2")
        ages[known < 0] = UNKNOWN
        self.heard[slot] = ages.tobytes()
        answers.track[:] = swarm.track if slot else swarm.position
        answers.chosen[:], answers.reason[:], answers.digest[:] = swarm.chosen, swarm.reason, swarm.digest
        self.agreed += len(set(swarm.chosen.tolist())) == 1
        before = len(self.link.moments)
        for observer in observers:
            observer.all_answered(slot, answers)
        frames = {k + 1: bytes(swarm.frame(k)) for k in senders}
        lengths = [len(frame) for frame in frames.values()]
        verdict = self.channel.arbitrate(slot, sorted(frames), lengths, answers.position)
        for observer in observers:
            observer.judged(slot, answers, frames, verdict)
        assert len(self.link.moments) == before  # until here all agents wait
        for observer in observers:
            observer.slot_over(slot, answers, verdict)
        swarm.fly(slot)
        for row, mask in enumerate(verdict.mask(AGENTS)):
            sender = verdict.senders[row]
            swarm.hear(slot, frames[sender], mask.astype(np.uint8))
            self.told.append((slot, sender, int(answers.reason[sender - 1]), int(mask.sum())))
        swarm.end(slot)


@pytest.fixture
def flown(monkeypatch: pytest.MonkeyPatch) -> Flown:
    return Flown(monkeypatch)


def frames_of(moments: list[Moment]) -> list[tuple[int, int, int, int]]:
    found = []
    for moment in moments:
        frames = json.loads(moment.text)["frames"]
        columns = (("slot", "<u4"), ("sender", "<u2"), ("reason", "u1"), ("received", "u1"))
        slot, sender, reason, share = (numbers(frames[name], kind).tolist() for name, kind in columns)
        found += list(zip(slot, sender, reason, (round(x * (AGENTS - 1) / 255) for x in share), strict=True))
    return found


def test_a_moment_is_what_was_known_when_its_slot_began_and_tells_every_slot_once(flown: Flown) -> None:
    flown.fly(1000, 0.0005)
    flown.now_s += 1.0
    for observer in flown.observers:  # and with that the flight is over
        observer.all_answered(1000, flown.answers)
    flown.observer.close()
    moments = flown.link.moments
    assert frames_of(moments) == flown.told
    assert len(flown.told) > 400
    assert len(moments) > 5
    assert {moment.heard == flown.heard[moment.slot] for moment in moments[:-2]} == {True}
    places = [slot for moment in moments for slot in numbers(json.loads(moment.text)["at"], "<u4").tolist()]
    assert places == list(range(0, 1001, 5))  # twenty in a simulated second
    counts = [json.loads(moment.text)["agree"] for moment in moments]
    assert [sum(column) for column in zip(*counts, strict=True)] == [1000, flown.agreed]
    assert flown.agreed < 1000


@pytest.mark.parametrize(("slot_s", "most"), [(0.0, 1), (0.0001, 2), (0.001, 13), (0.05, 120)])
def test_nothing_is_gathered_but_what_is_sent_at_the_rate_of_a_page(
    flown: Flown, monkeypatch: pytest.MonkeyPatch, slot_s: float, most: int
) -> None:
    gathered = []
    gather = flown.observer._moments.gather
    monkeypatch.setattr(
        flown.observer._moments, "gather", lambda *of, **more: gathered.append(1) or gather(*of, **more)
    )
    flown.fly(600, slot_s)
    assert len(gathered) == len(flown.link.moments)
    assert 1 <= len(gathered) <= most


def test_a_server_that_is_behind_has_nothing_gathered_for_it_and_gets_the_last_frames(flown: Flown) -> None:
    flown.link.able = False
    flown.fly(300, 0.05)
    assert not flown.link.moments
    flown.link.able = True
    flown.fly(1, 0.05)
    assert frames_of(flown.link.moments) == [one for one in flown.told if one[0] < 300]


def test_what_waits_for_a_server_is_limited() -> None:
    swarm = Swarm(SwarmConfig(agents=AGENTS))
    moments, reason = Moments(swarm.scenario, swarm.config.slot_ns), np.zeros(AGENTS, np.uint8)
    for slot in range(5 * MOST_FRAMES // 2):
        moments.frames(slot, SUCCESS, (slot % AGENTS + 1,), reason, None)
    kept = frames_of([moments.moment(moments.gather(slot, None, swarm.chosen, None))])
    assert [one[0] for one in kept] == list(range(slot - MOST_FRAMES + 1, slot + 1))
    assert len(moments._frames) == 0
