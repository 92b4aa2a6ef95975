"""Schemes that know no slots, on the port of an agent: ALOHA, hidden senders, carrier sense."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dtsa_agent.air import AirPort, SlotHearing
from dtsa_agent.core.errors import LocalProtocolError
from dtsa_agent.core.swarms.outcome import SlotOutcome
from dtsa_channel_sim import Channel, ChannelConfig, SimulatedAir

MS = 1_000_000
LENGTH = 200
ON_AIR_NS = ChannelConfig(agents=2).airtime.on_air_ns(LENGTH)


class Receiver:
    """Counts what arrives, and how its own frames fare."""

    def __init__(self) -> None:
        self.heard: list[tuple[int, bytes]] = []
        self.starts: list[int] = []
        self.dropped = 0

    def sent(self, frame: bytes, at_ns: int | None) -> None:
        if at_ns is None:
            self.dropped += 1
        else:
            self.starts.append(at_ns)

    def received(self, frame: bytes, when_ns: int, rssi_dbm: float | None) -> None:
        self.heard.append((when_ns, frame))


class Sender(Receiver):
    """Sends whenever its Poisson process says so; with carrier sense only if the air is free then."""

    def __init__(self, air: SimulatedAir, agent: int, rate_per_ns: float, senses: bool = False) -> None:
        super().__init__()
        self._air, self._senses, self._mean_ns = air, senses, 1.0 / rate_per_ns
        self._random = np.random.default_rng(agent)
        self._frame = bytes([agent]) * LENGTH
        self.port: AirPort = air.join(agent, self)
        self._wait()

    def _wait(self) -> None:
        self._air.call(self._air.now_ns + 1 + int(self._random.exponential(self._mean_ns)), self._act)

    def _act(self) -> None:
        now = self._air.now_ns
        if not (self._senses and self.port.busy(now)):
            self.port.send(self._frame, now)
        self._wait()


def load(senders: int, g: float, *, senses: bool = False, end_ns: int, positions=None, **settings):
    """Offers a load of G frames in the time of one to a receiver, agent 1; how many were sent, how many it heard."""
    air = SimulatedAir(Channel(ChannelConfig(agents=senders + 1, **settings)), positions)
    receiver = Receiver()
    air.join(1, receiver)
    rate = g / senders / ON_AIR_NS
    all_senders = [Sender(air, agent, rate, senses) for agent in range(2, senders + 2)]
    air.run(end_ns)
    return sum(len(sender.starts) for sender in all_senders), len(receiver.heard)


@pytest.mark.parametrize("g", [0.2, 0.5, 1.0])
def test_throughput_of_pure_aloha(g):
    senders, times = 40, 8000
    sent, heard = load(senders, g, end_ns=times * ON_AIR_NS)
    # G exp(-2 G), but a sender does not collide with itself, and waits while it turns to sending.
    offered = sent / times
    expected = math.exp(-2.0 * offered * (senders - 1) / senders)
    assert offered == pytest.approx(g, rel=0.1)
    # Fates of neighbours are not independent: twice the error of independent ones, four standard deviations.
    assert heard / sent == pytest.approx(expected, abs=4.0 * 2.0 * math.sqrt(expected * (1 - expected) / sent))


def test_two_senders_disturb_each_other_less_when_they_listen_first_unless_they_are_hidden():
    in_line = np.array([[0.0, -4.0, 4.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])  # the receiver is in the middle
    lost = {}
    for name, senses, settings in (
        ("aloha", False, {"range_m": 100.0}),
        ("listening", True, {"range_m": 100.0}),
        ("hidden aloha", False, {"range_m": 5.0}),
        ("hidden listening", True, {"range_m": 5.0}),
    ):
        sent, heard = load(2, 0.5, senses=senses, end_ns=4000 * ON_AIR_NS, positions=in_line, **settings)
        lost[name] = 1.0 - heard / sent
    assert lost["hidden listening"] == lost["hidden aloha"] == lost["aloha"]
    # Those that begin while the other is turning to sending still collide.
    assert 0.0 < lost["listening"] < 0.3 * lost["aloha"]


def test_what_a_radio_is_told_in_order():
    air = SimulatedAir(Channel(ChannelConfig(agents=3, link_delay_ns=300_000)))
    one, two = Receiver(), Receiver()
    port = air.join(1, one)
    air.join(2, two)
    port.send(b"a" * LENGTH, 1 * MS)
    port.send(b"b" * LENGTH, 1 * MS + ON_AIR_NS)  # still sending: the ramp-up takes its time, too
    port.send(b"c" * LENGTH, 2 * MS)
    air.run(10 * MS)
    total = ChannelConfig(agents=3).airtime.total_ns(LENGTH)
    assert one.starts == [1 * MS, 2 * MS]
    assert one.dropped == 1
    assert one.heard == []
    assert two.heard == [
        (1 * MS + total + 300_000, b"a" * LENGTH),
        (2 * MS + total + 300_000, b"c" * LENGTH),
    ]
    for call in (lambda: port.send(b"late", 1 * MS), lambda: port.busy(11 * MS), lambda: air.join(1, one)):
        with pytest.raises(LocalProtocolError):
            call()


@pytest.mark.parametrize(
    ("senders", "outcome"),
    [((), SlotOutcome.SILENCE), ((1,), SlotOutcome.FRAME), ((1, 2), SlotOutcome.COLLISION)],
)
def test_a_receiver_derives_the_outcome_of_a_slot(senders, outcome):
    air = SimulatedAir(Channel(ChannelConfig(agents=3)))
    hearing = SlotHearing()

    class Listener(Receiver):
        def received(self, frame: bytes, when_ns: int, rssi_dbm: float | None) -> None:
            hearing.frame()

    ports = {agent: air.join(agent, Receiver()) for agent in (1, 2)}
    own = air.join(3, Listener())
    for sender in senders:
        ports[sender].send(bytes(LENGTH), 0)
    air.call(200_000, lambda: hearing.sense(own, 200_000))
    air.run(10 * MS)
    assert hearing.close() == outcome
    assert hearing.close() == SlotOutcome.SILENCE  # the next slot begins anew


def test_a_radio_that_cannot_sense_takes_a_collision_for_silence():
    class Deaf:
        def send(self, frame: bytes, at_ns: int) -> None: ...

        def busy(self, when_ns: int) -> bool | None:
            return None

    hearing = SlotHearing()
    hearing.sense(Deaf(), 0)
    assert hearing.close() == SlotOutcome.SILENCE
