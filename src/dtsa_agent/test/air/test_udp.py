"""Agents over UDP, part by part: settings, datagrams, clocks, which slot it is."""

from __future__ import annotations

import dataclasses
import errno
import os
import random
import re
import socket
import subprocess
import sys
import time
from typing import Any

import pytest
from plain_hearing import SlotTime

from dtsa_agent.air.clock import OwnClock
from dtsa_agent.air.datagram import LENGTH, NO_FRAME, NOT_OURS, OTHER_SETTINGS, REJECTED, UNKNOWN, Wrapping
from dtsa_agent.air.delay import Delay
from dtsa_agent.air.driver import LiveAgent
from dtsa_agent.air.precision import going_first
from dtsa_agent.air.record import SlotRecord
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.air.tally import Tally
from dtsa_agent.air.udp import MulticastSocket, UdpPort, UdpSettings
from dtsa_agent.air.udp.sockets import Datagram, StampClock
from dtsa_agent.core import ConfigError, Frame, SwarmConfig, encode_frame
from dtsa_agent.core.agents.pacing import latest_send_ns
from dtsa_agent.core.authentication import Authenticator
from dtsa_agent.core.reference.timebase import ALIGNED, FOREIGN, LISTENING, RESTARTED

SLOT_NS = 10_000_000
KEY = bytes.fromhex("8f3c1d5e7a9b2460c1e3f5a7b9d8c6e4")
CONFIG = SwarmConfig(agents=3, policy="lease")


@pytest.mark.parametrize(
    ("field", "values"),
    [
        ("interface", {"interface": "none0"}),
        ("interface", {}),
        ("group", {"interface": "lo", "group": "10.0.0.1:7000"}),
        ("group", {"interface": "lo", "group": "239.1.1.1"}),
        ("group", {"interface": "lo", "group": "239.1.1.1:0"}),
        ("group", {"interface": "lo", "group": "239.1.1.1:70000"}),
        ("group", {"interface": "lo", "group": "239.1.1:7000"}),
        ("ttl", {"interface": "lo", "ttl": 0}),
    ],
)
def test_networks_that_cannot_be_used_are_refused_by_name(field: str, values: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as error:
        UdpSettings.from_dict(values)
    assert error.value.field == field


@pytest.mark.parametrize(
    ("field", "own", "config", "key"),
    [
        ("id", 4, CONFIG, ""),
        ("policy", 1, dataclasses.replace(CONFIG, policy="dtsa"), ""),
        ("DTSA_AUTH_KEY", 1, dataclasses.replace(CONFIG, auth=True, auth_session=1), ""),
        ("auth_key", 1, dataclasses.replace(CONFIG, auth=True, auth_session=1), "00" * 16),
        ("auth_session", 1, dataclasses.replace(CONFIG, auth=True), KEY.hex()),
    ],
)
def test_agents_that_cannot_fly_are_refused_by_name(
    monkeypatch: pytest.MonkeyPatch, field: str, own: int, config: SwarmConfig, key: str
) -> None:
    monkeypatch.setenv("DTSA_AUTH_KEY", key)
    with UdpPort(UdpSettings(interface="lo")) as port, pytest.raises(ConfigError) as error:
        LiveAgent(AgentSettings(id=own), config, port)
    assert error.value.field == field


def framed(sender: int, slot: int) -> bytes:
    """A frame of an agent with policy tdma."""
    return encode_frame(Frame(sender, slot, 1, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0)))


def test_a_datagram_says_why_it_is_none_of_ours() -> None:
    config = SwarmConfig(agents=3, policy="tdma")
    here, frame = Wrapping(config, None), framed(2, 7)
    good = here.wrap(frame, 7, 1_234_567, ((1, -20_000), (3, 500_000)))
    assert here.read(good) == ("", 2, 7, 1_230_000, ((1, -20_000), (3, 500_000)), frame)
    assert here.read(here.wrap(frame, 7, 0)).peers == ()
    assert here.read(here.wrap(frame, 7, 0, ((1, 10**12), (3, -(10**12))))).peers == (
        (1, 327_670_000),
        (3, -327_680_000),
    )
    assert here.read(here.wrap(frame, 7, -5)).late_ns == 0
    assert here.read(here.wrap(frame, 7, 10**12)).late_ns == 655_350_000
    assert here.read(b"").fault == here.read(b"DX" + good[2:]).fault == NOT_OURS
    assert here.read(good[:6]).fault == here.read(good + b"\0").fault == LENGTH
    assert here.read(here.wrap(bytes(len(frame)), 0)).fault == NO_FRAME
    assert here.read(here.wrap(framed(4, 7), 7)).fault == UNKNOWN
    for changed in ({"slot_ms": 20.0}, {"agents": 4}, {"seed": 2}, {"auth_session": 1}):
        there = Wrapping(dataclasses.replace(config, moving=None, **changed), None)
        assert here.read(there.wrap(frame, 7)).fault == OTHER_SETTINGS


def test_nothing_in_a_sealed_datagram_can_be_changed() -> None:
    config = SwarmConfig(agents=3, policy="tdma", auth=True, auth_session=1)
    here = Wrapping(config, Authenticator(KEY, 1))
    good = here.wrap(framed(2, 7), 7, 50_000, ((3, 30_000),))
    assert here.read(good) == ("", 2, 7, 50_000, ((3, 30_000),), framed(2, 7))
    for at in range(len(good)):
        changed = good[:at] + bytes([good[at] ^ 1]) + good[at + 1 :]
        assert here.read(changed).fault
    assert Wrapping(config, Authenticator(KEY[::-1], 1)).read(good).fault == REJECTED
    assert Wrapping(config, Authenticator(KEY, 2)).read(good).fault == REJECTED


@pytest.mark.parametrize("drift", [0, 50_000, -1_000_000])
def test_a_bent_clock_is_read_both_ways(drift: int) -> None:
    clock = OwnClock(-5_000_000_000, drift)
    now = time.monotonic_ns()
    for later in (0, 1, 10**9, 86_400 * 10**9):
        assert abs(clock.monotonic_ns(clock.local_ns(now + later)) - now - later) <= 2
    hour = 3600 * 10**9
    assert clock.local_ns(now + hour) - clock.local_ns(now) == pytest.approx(hour + hour * drift / 1e9, abs=2)


def test_stamps_of_a_clock_that_has_been_set_are_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    ahead = [10**18]
    monkeypatch.setattr(time, "time_ns", lambda: time.monotonic_ns() + ahead[0])
    stamps = StampClock()
    stamps.look()
    arrived = time.monotonic_ns() - 2_000_000
    assert abs(stamps.arrival_ns(arrived + ahead[0]) - arrived) < 500_000
    ahead[0] += 3600 * 10**9  # somebody sets the clock
    before = time.monotonic_ns()
    stamps.look()
    assert stamps.steps == 1
    assert before <= stamps.arrival_ns(arrived + 10**18) <= time.monotonic_ns()
    before = time.monotonic_ns()
    stamps.look()  # from now on stamps are of the new time
    assert abs(stamps.arrival_ns(arrived + ahead[0]) - arrived) < 500_000
    assert before <= stamps.arrival_ns(0) <= time.monotonic_ns()
    assert before <= stamps.arrival_ns(None) <= time.monotonic_ns()


def test_arrivals_are_exact_however_long_a_process_was_kept_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    """It stands still between two datagrams of one pass: the second one has arrived long after the first was read."""
    with MulticastSocket(UdpSettings(interface="lo", group=f"239.255.77.77:{20_000 + os.getpid() % 10_000}")) as end:
        sent = []
        look = StampClock.look

        def send() -> None:
            sent.append(time.monotonic_ns())
            end.send(b"x")

        def stand_still(stamps: StampClock) -> None:
            look(stamps)
            if len(sent) == 1:
                time.sleep(0.05)
                send()

        monkeypatch.setattr(StampClock, "look", stand_still)
        send()
        found: list[Datagram] = []
        while len(found) < 2:
            assert time.monotonic_ns() - sent[0] < 10 * 10**9
            found += end.receive(16)
    first, second = (datagram.arrival_ns for datagram in found)
    assert sent[0] <= first < sent[1] - 40_000_000  # before it stood still
    assert sent[1] <= second


def test_who_took_its_time_from_a_late_frame_takes_it_anew() -> None:
    slots = SlotTime(CONFIG, 1)
    slots.start(0)
    assert slots.hear(100, 100 * SLOT_NS + 3_000_000) == RESTARTED  # left 3 ms late
    for slot in range(101, 109):
        assert slots.hear(slot, slot * SLOT_NS) == ALIGNED
        assert slots.slot_start_ns(slot) == slot * SLOT_NS + 3_000_000  # too far off to be believed at once
    assert slots.hear(109, 109 * SLOT_NS) == ALIGNED
    assert (slots.slot_start_ns(110), slots.corrected, slots.restarts) == (110 * SLOT_NS, 1, 0)
    assert slots.state != LISTENING
    assert slots.hear(50, 110 * SLOT_NS) == FOREIGN
    assert slots.hear(500, 110 * SLOT_NS) == RESTARTED


@dataclasses.dataclass
class Ticking:
    """The slots of one agent on a clock of its own; common time is ns of the test."""

    slots: SlotTime
    delay: Delay
    offset_ns: int
    drift: float

    def shown(self, at_ns: float) -> int:
        """What its clock shows."""
        return round(self.offset_ns + at_ns * (1.0 + self.drift))

    def starts(self, slot: int) -> float:
        """When its slot starts."""
        return (self.slots.slot_start_ns(slot) - self.offset_ns) / (1.0 + self.drift)

    def hear(self, sender: int, slot: int, began_ns: int, peers: Any) -> None:
        """A frame, as an agent takes it."""
        before = self.slots.slot_start_ns(slot)
        if self.slots.hear(slot, began_ns - self.delay.error_ns) == RESTARTED:
            self.delay.reset()
        else:
            self.delay.hear(sender, began_ns - before, peers)
            self.delay.moved(self.slots.slot_start_ns(slot) - before)


@pytest.mark.parametrize(
    ("under_way", "loss", "later"),
    [(0, 0.3, 0), (2_000_000, 0.3, 0), (-300_000, 0.0, 0), (0, 0.3, 2_000_000), (0, 0.3, 4_000_000)],
)
def test_slots_stay_together_whatever_frames_are_under_way_longer_than_supposed(
    under_way: int, loss: float, later: int
) -> None:
    """Twelve clocks off by up to 50 ppm; frames are lost, and one of twenty is held up for milliseconds.

    Where one agent hears all frames ``later``, and is heard as the others are, its slots are late by half of that: it
    cannot tell it from a clock.
    """
    config, draw = SwarmConfig(agents=12, policy="lease"), random.Random(7)
    agents = {}
    for agent in range(1, 13):
        clock = draw.randrange(10**12), draw.uniform(-5e-5, 5e-5)
        agents[agent] = Ticking(SlotTime(config, agent), Delay(agent, SLOT_NS // 4), *clock)
    for one in agents.values():
        one.slots.start(one.shown(0))
    agents[1].slots.hear(120, agents[1].shown(120 * SLOT_NS))
    apart, restarts = [], []
    for slot in range(120, 2620):
        sender = agents[slot % 12 + 1]
        if sender.slots.state == LISTENING:
            continue
        peers, sent = sender.delay.tell(lambda peer: True), sender.starts(slot)
        for one in agents.values():
            if one is not sender and draw.random() >= loss:
                held_up = draw.random() * 5e6 if draw.random() < 0.05 else 0.0
                arrives = sent + under_way + held_up + (later if one is agents[1] else 0)
                one.hear(slot % 12 + 1, slot, one.shown(arrives), peers)
        starts = [one.starts(slot) for one in agents.values() if one.slots.state != LISTENING]
        starts[0] -= later / 2
        apart.append(max(starts) - min(starts))
        restarts.append(sum(one.slots.restarts for one in agents.values()))
    assert max(apart[-1000:]) < 300_000
    assert restarts[-1000] == restarts[-1]
    for agent, one in agents.items():
        assert one.delay.error_ns == pytest.approx(under_way + (later / 2 if agent == 1 else 0), abs=150_000)


def test_the_tally_knows_how_late_frames_left() -> None:
    tally = Tally()
    assert tally.summary()["sends_on_time_share"] is None
    for late in (0, 50_000, 60_000, 3_000_000):
        tally.sent(late)
    found = tally.summary()
    assert (found["sent"], found["sends_on_time_share"]) == (4, 0.75)
    assert found["send_late_ms"] == {"p50": pytest.approx(0.05, rel=0.05), "p99": 3.0, "max": 3.0}


@pytest.mark.parametrize("flight_ns", [30_000, 600_000, 5_000_000])
def test_who_wakes_late_sends_as_long_as_the_next_turn_is_not_disturbed(
    monkeypatch: pytest.MonkeyPatch, flight_ns: int
) -> None:
    latest = latest_send_ns(SLOT_NS, flight_ns)
    assert latest + flight_ns < SLOT_NS
    config = SwarmConfig(agents=2, policy="tdma", auth=False)
    udp = UdpSettings(interface="lo", group=f"239.255.78.78:{20_000 + os.getpid() % 10_000}", flight_time_ns=flight_ns)
    with UdpPort(udp) as port:
        agent = LiveAgent(AgentSettings(id=1), config, port)
        now = [time.monotonic_ns()]
        monkeypatch.setattr(time, "monotonic_ns", lambda: now[0])
        monkeypatch.setattr(agent, "_late_ns", lambda slot: now[0] - agent.hearing.slot_start_ns(slot))
        agent.hearing.hear_slot(101, now[0])
        agent._begin_anew()
        own = agent.slot + 2 - agent.slot % 2  # a turn of agent 1
        counts = []
        for slot, late in ((own, latest), (own + 2, latest + 1), (own + 4, 1_000)):
            now[0] = agent.hearing.slot_start_ns(slot) + late
            agent._open(slot)
            counts.append((agent.tally.summary()["sent"], agent.tally.unsent["too late"]))
        assert counts == [(1, 0), (1, 1), (2, 1)]


@pytest.mark.parametrize("number", [errno.ENOBUFS, errno.EPERM, errno.ENETUNREACH])
def test_what_the_network_refuses_does_not_count_as_sent(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    udp = UdpSettings(interface="lo", group=f"239.255.79.79:{20_000 + os.getpid() % 10_000}")
    config = SwarmConfig(agents=2, policy="tdma")
    with UdpPort(udp) as port:
        agent = LiveAgent(AgentSettings(id=1), config, port, watcher := Records())
        agent.hearing.hear_slot(101, time.monotonic_ns())
        agent._begin_anew()
        own = agent.slot + 2 - agent.slot % 2  # a turn of agent 1
        monkeypatch.setattr(agent, "_late_ns", lambda slot: 1_000)
        with monkeypatch.context() as patch:
            patch.setattr(port, "_out", Refusing(number))
            agent._open(own)
        agent._open(own + 2)
        agent._tell(agent._close_slot())
        found = agent.summary()
    assert (found["sent"], found["unsent"]) == (1, 1)
    assert found["unsent_because"] == {os.strerror(number): 1}
    refused, sent = (record for record in watcher.slots if record.frame)
    assert (refused.sent_ns, refused.datagram) == (-1, b"")
    assert sent.sent_ns > 0


def test_a_queue_that_is_full_is_told() -> None:
    """Linux drops a datagram at a full queue, and says so only to those that have asked for it."""
    with MulticastSocket(UdpSettings(interface="lo")) as end:
        assert end._out.getsockopt(socket.IPPROTO_IP, 11) == 1  # IP_RECVERR


def test_other_settings_and_another_key_are_said_in_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    """A second after the first such datagram, with counts; then not again for a while."""
    monkeypatch.setenv("DTSA_AUTH_KEY", KEY.hex())
    config = SwarmConfig(agents=3, policy="tdma", auth=True, auth_session=1)
    others = dataclasses.replace(config, slot_ms=20.0)
    udp = UdpSettings(interface="lo", group=f"239.255.81.81:{20_000 + os.getpid() % 10_000}")
    said: list[str] = []
    second, now = 1_000_000_000, [time.monotonic_ns()]
    with UdpPort(udp) as port:
        agent = LiveAgent(AgentSettings(id=1), config, port, say=said.append)
        frame = framed(2, 7)
        slow = Wrapping(others, Authenticator(KEY, 1)).wrap(frame, 7)
        strange = Wrapping(config, Authenticator(KEY[::-1], 1)).wrap(frame, 7)
        monkeypatch.setattr(time, "monotonic_ns", lambda: now[0])

        def arrives(*data: bytes) -> int:
            verdicts = [agent.hearing.take_one(one, now[0])[0] for one in data]
            agent._take_in((None, [(v, 0, d, now[0]) for v, d in zip(verdicts, data, strict=True)], False, False))
            return len(said)

        assert arrives(slow, strange, slow, b"noise" * 20) == 0
        now[0] += second - 1
        assert arrives() == 0
        now[0] += 1
        assert arrives() == 1
        assert re.fullmatch(
            "datagrams not taken in so far: 2 of other settings: slot length.*; 1 of another key.*", said[0]
        )
        now[0] += 20 * second
        assert arrives(strange) == 1
        now[0] += 10 * second
        assert arrives() == 2
        assert "; 2 of another key" in said[1]
        now[0] += 1000 * second
        assert arrives() == 2


class Refusing:
    """A socket that takes nothing."""

    def __init__(self, number: int) -> None:
        self._number = number

    def sendto(self, data: bytes, address: object) -> int:
        """See socket."""
        raise OSError(self._number, os.strerror(self._number))


class Records:
    """A watcher that keeps what it is told."""

    def __init__(self) -> None:
        self.slots: list[SlotRecord] = []

    def slot(self, record: SlotRecord) -> None:
        """See Watcher."""
        self.slots.append(record)

    def other(self, reason: str, data: bytes, arrival_ns: int) -> None:
        """See Watcher."""


def test_an_agent_goes_first_and_what_it_starts_does_not() -> None:
    before = os.sched_getscheduler(0)
    with going_first(3) as problem:
        if problem:
            pytest.skip(problem)
        assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_RR
        assert os.sched_getparam(0).sched_priority == 3
        says = [sys.executable, "-c", "import os; print(os.sched_getscheduler(0))"]
        assert int(subprocess.check_output(says)) == os.SCHED_OTHER
    assert os.sched_getscheduler(0) == before
    with going_first(0) as problem:
        assert (problem, os.sched_getscheduler(0)) == ("", before)


def test_the_tally_shows_an_outage() -> None:
    tally = Tally()
    tally.begun(100, 1)
    for slot in (101, 140):  # it is new
        tally.hear(2, slot, leaves=False)
    assert (tally.summary(150)["heard_share"], tally.summary(150)["oldest_heard_slots"]) == (None, None)
    tally.look(2, 2)
    for slot in range(141, 200, 4):
        tally.hear(2, slot, leaves=False)
        tally.hear(3, slot, leaves=False)
    tally.look(2, 1)
    tally.hear(3, 260, leaves=True)
    found = tally.summary(250)
    assert found["heard"] == 33
    assert (found["heard_share"], found["oldest_heard_slots"], found["oldest_heard_of"]) == (0.75, 63, 3)
    assert tally.summary(400)["oldest_heard_of"] == 2  # not heard any more; the other one has left
    assert tally.summary(400)["oldest_heard_slots"] == 203
