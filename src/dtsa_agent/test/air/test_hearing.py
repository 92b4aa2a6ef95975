"""What an agent hears, compiled, against the plain statement of the same: whatever arrives."""

from __future__ import annotations

import dataclasses
import os
import platform
import random
import shutil
import subprocess
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from plain_hearing import PlainHearing
from waiting import wait_for

import dtsa_agent
from dtsa_agent.air.clock import OwnClock
from dtsa_agent.air.datagram import HEADER, NOT_OURS, Wrapping, flight_ns, trust_ns
from dtsa_agent.air.hearing import REASONS, STATES, Hearing, make_hearing
from dtsa_agent.air.port import PortProperties
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.air.udp import MulticastSocket, UdpPort, UdpSettings, _socket, sockets
from dtsa_agent.air.udp.sockets import StampClock
from dtsa_agent.core import Frame, SwarmConfig, encode_frame
from dtsa_agent.core.authentication import Authenticator
from dtsa_agent.core.frame import ExtendedFrame, encode_extended

KEY = bytes.fromhex("8f3c1d5e7a9b2460c1e3f5a7b9d8c6e4")
OPEN = SwarmConfig(agents=5, policy="tdma", slot_ms=10.0)
RESTS = dataclasses.replace(OPEN, policy="lease", anchor_every=2, anchor_rest=1)
SEALED = dataclasses.replace(OPEN, auth=True, auth_session=3, seed=2**63 - 1)
SLOT_NS, OWN, UDP = OPEN.slot_ns, 2, UdpSettings(interface="lo", group="239.255.80.80:20080")

PORTS = (
    UDP.properties,
    PortProperties("serial", 900_000, 17_361, agreed_bytes=2, peers=1, varies=True),
    PortProperties("radio", 500_000, 14_000, agreed_bytes=2, peers=0, bare_sealed=True),
    PortProperties("radio", 500_000, 14_000, agreed_bytes=4, peers=3),
)


class NoPort:
    """A port through which nothing comes."""

    say = None

    def __init__(self, properties: PortProperties = UDP.properties) -> None:
        self.properties = properties
        self.compiled = _socket.open_port(-1, bytes(4), 9)

    def send(self, data: bytes) -> bool:
        """See DatagramPort."""
        return False

    def counts(self) -> dict[str, int]:
        """See DatagramPort."""
        return {}


class Both:
    """The same agent twice."""

    def __init__(
        self,
        config: SwarmConfig,
        offset_ns: int,
        drift_ppb: int,
        monkeypatch: pytest.MonkeyPatch,
        port: PortProperties = UDP.properties,
    ) -> None:
        key = Authenticator(KEY, config.auth_session) if config.auth else None
        self.wrapping = Wrapping(config, key, port=port)
        self.now = 5_000_000_000_000
        with monkeypatch.context() as patched:
            patched.setattr(time, "monotonic_ns", lambda: self.now)
            own = AgentSettings(id=OWN, clock_offset_ns=offset_ns, clock_drift_ppb=drift_ppb)
            self.compiled = make_hearing(config, own, self.wrapping, NoPort(port))
            clock = OwnClock(offset_ns, drift_ppb)
        flight = flight_ns(config, port)
        self.plain = PlainHearing(config, OWN, self.wrapping, flight, clock, trust_ns(config, port))
        self.clock = clock

    def take(self, data: bytes) -> str:
        """Both hear a datagram; why it is not taken in."""
        taken = self.plain.take(data, self.now)
        number, restarted, heard = self.compiled.take_one(data, self.now)
        assert (REASONS[number], restarted) == (taken.fault, taken.restarted)
        if taken.said is not None:
            said = taken.said
            assert heard == (said.sender, said.slot, said.frame, data, self.clock.local_ns(self.now))
        state, restarts, corrected, corrections, error_ns, *_ = self.compiled.status()
        slots = self.plain.time
        assert (STATES[state], restarts, corrected) == (slots.state, slots.restarts, slots.corrected)
        assert (corrections, error_ns) == (slots.corrections, self.plain.delay.error_ns)
        assert self.compiled.timing() == (self.plain.timed, self.plain.off)
        now = slots.slot(self.clock.local_ns(self.now)) or 0
        for slot, strict in ((now, True), (now, False), (now + 60, False)):
            assert self.compiled.contact(slot, strict) == self.plain.contacts.count(slot, strict)
        for slot in (0, 7, 2**32 - 1):
            assert self.compiled.slot_start_ns(slot) == slots.slot_start_ns(slot)
        return taken.fault


def framed(sender: int, slot: int, config: SwarmConfig = OPEN, condition: int = 1) -> bytes:
    """A frame of an agent; with policy lease it may rest (0), leave (2) or be on probation (3)."""
    own = Frame(sender, slot, int(condition != 0), (1.0, 2.0, 3.0), (0.0, 0.0, 0.0))
    if config.policy != "lease":
        return encode_frame(own)
    own = dataclasses.replace(own, sender=min(sender, 254), intent=(0.0, 0.0, 0.0))
    return encode_extended(ExtendedFrame(own, leaving=condition == 2, probation=condition == 3))


_PEERS = st.lists(st.tuples(st.integers(0, 7), st.integers(-(10**9), 10**9)), max_size=4)
_LATE = st.integers(-400_000, 400_000) | st.integers(-8_000_000, 8_000_000)
_SAID = st.tuples(
    st.sampled_from((1, 1, 3, 4, 5, OWN, 6, 500)),  # sender
    st.sampled_from((1, 1, 1, 1, 0, 2, 5, -30, 300)),  # slots on
    _LATE,  # arrival after its slot
    st.integers(0, 10**6) | st.sampled_from((400_000_000, 10**9)),  # how late it left
    st.sampled_from((1, 1, 1, 0, 2, 3)),  # rests, leaves, is on probation
    _PEERS,
    st.none() | st.tuples(st.integers(0, 300), st.integers(1, 255)),  # a changed byte
)


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    config=st.sampled_from((OPEN, SEALED, RESTS)),
    port=st.sampled_from(PORTS),
    offset=st.integers(-(10**15), 10**15),
    drift=st.sampled_from((0, 50_000, -1_000_000)),
    said=st.lists(_SAID, min_size=20, max_size=60),
)
def test_frames_right_and_wrong_are_heard_as_the_plain_statement_says(
    monkeypatch: pytest.MonkeyPatch, config: SwarmConfig, port: PortProperties, offset: int, drift: int, said: list[Any]
) -> None:
    both, slot = Both(config, offset, drift, monkeypatch, port), 100
    for sender, on, late, left_late, condition, peers, change in said:
        slot = max(0, slot + on)
        both.now += SLOT_NS
        data = both.wrapping.wrap(framed(sender, slot, config, condition), slot, left_late, peers[: port.peers])
        if change is not None:
            at, by = change[0] % len(data), change[1]
            data = data[:at] + bytes([data[at] ^ by]) + data[at + 1 :]
        both.now += late
        both.take(data)
        both.now -= late
        if slot % 3 == 0:
            told = both.plain.tell(slot)
            frame = framed(OWN, slot, config)
            assert both.compiled.wrap(frame, slot, left_late) == both.wrapping.wrap(frame, slot, left_late, told)
        instant = both.now + late * 1_000_000
        assert both.compiled.local_ns(instant) == both.clock.local_ns(instant)


@pytest.mark.parametrize("config", [OPEN, SEALED, RESTS])
def test_slots_and_delays_of_a_long_flight_are_those_of_the_plain_statement(
    monkeypatch: pytest.MonkeyPatch, config: SwarmConfig
) -> None:
    """Offsets for every correction, a clock that is off by more than is believed, another group; all pairs known."""
    both, draw = Both(config, -(10**15), 50_000, monkeypatch), random.Random(5)
    begin, ahead, refused = both.now, 0, Counter[str]()
    for slot in range(100, 2100):
        sender = draw.choice((1, 3, 4, 5))
        if slot in (700, 1300):
            ahead += 3_000_000 if slot == 700 else -3_000_000  # all others, by less than half a slot
        if slot == 1800:
            ahead -= 50 * SLOT_NS  # they have met a group of a later time
        peers = [(draw.choice((OWN, 1, 4)), draw.randrange(-(10**6), 10**6)) for _ in range(draw.randrange(4))]
        left_late, held_up = draw.randrange(200_000), 2_000_000 * (draw.random() < 0.05)
        both.now = begin + slot * SLOT_NS + ahead + left_late + held_up + draw.randrange(-100_000, 300_000)
        frame = framed(sender, slot, config, draw.choice((0, 1, 1, 1, 3)))
        refused[both.take(both.wrapping.wrap(frame, slot, left_late, peers))] += 1
        told = both.plain.tell(slot)
        own = framed(OWN, slot, config)
        assert both.compiled.wrap(own, slot, 0) == both.wrapping.wrap(own, slot, 0, told)
    _, restarts, corrected, corrections, error_ns, *_ = both.compiled.status()
    assert restarts == 1
    assert corrected >= 2
    assert refused[""] > 1900
    assert corrections > 100
    assert error_ns != 0
    assert len(both.plain.tell(2100)) == 4


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    config=st.sampled_from((OPEN, SEALED)),
    port=st.sampled_from(PORTS),
    begins=st.integers(0, HEADER + 8),
    noise=st.binary(max_size=80) | st.binary(min_size=500, max_size=512),
)
@example(config=OPEN, port=PORTS[0], begins=0, noise=b"")
@example(config=OPEN, port=PORTS[0], begins=2, noise=b"\x01")
@example(config=OPEN, port=PORTS[2], begins=1, noise=b"")
def test_noise_is_refused_for_the_same_reason(
    monkeypatch: pytest.MonkeyPatch, config: SwarmConfig, port: PortProperties, begins: int, noise: bytes
) -> None:
    both = Both(config, 0, 0, monkeypatch, port)
    both.take(both.wrapping.wrap(framed(1, 7), 7)[:begins] + noise)


@given(
    looks=st.lists(
        st.tuples(
            st.integers(-2_000_000, 2_000_000) | st.just(3600 * 10**9),
            st.integers(0, 10**9),
            st.none() | st.integers(-70 * 10**9, 10**9),
        ),
        min_size=1,
        max_size=8,
    )
)
@example(looks=[(-1_500_000, 10, -5), (1_500_000, 10, -5)])
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_stamps_are_believed_as_the_plain_statement_says(monkeypatch: pytest.MonkeyPatch, looks: list[Any]) -> None:
    ahead, now = 10**18, 10**12
    monkeypatch.setattr(sockets, "_look", lambda: (ahead, now))
    port, plain = NoPort().compiled, StampClock()
    _socket.stamped(port, ahead, now, -1)
    before = _socket.counts(port)[1]
    for moved, later, age in looks:
        ahead, now = ahead + moved, now + later
        stamp = None if age is None else now + age + ahead
        plain.look()
        assert _socket.stamped(port, ahead, now, -1 if stamp is None else stamp) == plain.arrival_ns(stamp)
        assert _socket.counts(port)[1] - before == plain.steps


@pytest.mark.parametrize("drift", [0, 50_000, -1_000_000])
def test_slots_start_by_the_own_clock(monkeypatch: pytest.MonkeyPatch, drift: int) -> None:
    both = Both(OPEN, 10**12, drift, monkeypatch)
    both.take(both.wrapping.wrap(framed(1, 7), 7))
    first, later = (both.clock.monotonic_ns(both.plain.time.slot_start_ns(slot)) for slot in (0, 10**6))
    before, late, after = (both.compiled.late_ns(slot) for slot in (0, 10**6, 0))
    assert before <= late + later - first <= after


def hearing_of(config: SwarmConfig, port: UdpPort) -> Hearing:
    """What an agent hears by a socket."""
    return make_hearing(config, AgentSettings(id=OWN), Wrapping(config, None), port)


def arrived_at(watcher: MulticastSocket, count: int) -> int:
    """When so many datagrams had come, ns, monotonic; a while later they are old for whoever did not look yet."""
    found = 0

    def all_there() -> bool:
        nonlocal found
        found += len(watcher.receive(count))
        return found >= count

    wait_for(all_there)
    when = time.monotonic_ns()
    time.sleep(0.02)
    return when


def test_it_reads_its_socket_and_leaves_out_what_it_has_said_itself() -> None:
    group = UdpSettings(interface="lo", group=f"239.255.79.79:{20_000 + os.getpid() % 10_000}")
    with UdpPort(group) as end, MulticastSocket(group) as other, MulticastSocket(group) as watcher:
        hearing = hearing_of(OPEN, end)
        assert hearing.take() == (None, None, False, False)

        def stamped() -> bool:
            """Linux begins with its stamps some time after they were asked for, on a busy machine a long time."""
            other.send(b"first")
            before = arrived_at(watcher, 1)
            return all(one[3] <= hearing.local_ns(before) for one in hearing.take()[1] or ())

        wait_for(stamped)
        wrapping = Wrapping(OPEN, None)
        sent = time.monotonic_ns()
        end.send(b"own")
        said = [b"x", b"", b"y" * 2000, *(wrapping.wrap(framed(1, slot), slot) for slot in (7, 400))]
        for data in said:
            other.send(data)
        arrived = arrived_at(watcher, 1 + len(said))  # the kernel knows better when they came than who looks so late
        heard, refused, restarted, more = hearing.take()
        assert heard is not None
        assert refused is not None
        assert [one[:3] for one in heard] == [(1, 7, framed(1, 7))]  # up to the frame that says which slot it is
        assert (restarted, more, hearing.listening) == (True, True, False)
        assert [(REASONS[one[0]], one[2]) for one in refused] == [(NOT_OURS, data[:512]) for data in said[:3]]
        for arrival in (heard[0][4], *(one[3] for one in refused)):
            assert hearing.local_ns(sent) <= arrival <= hearing.local_ns(arrived)
        assert [one[1] for one in hearing.take()[0] or ()] == [400]
        for data in [wrapping.wrap(framed(3, slot), slot) for slot in range(20)]:
            other.send(data)
        arrived_at(watcher, 20)
        counts = [(len(found[1] or ()), found[3]) for found in (hearing.take() for _ in range(3))]
        assert counts == [(16, True), (4, False), (0, False)]  # so many at a time: own slots go on


def test_an_own_frame_of_another_length_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for config in (OPEN, SEALED):
        hearing = Both(config, 0, 0, monkeypatch).compiled
        for length in (0, len(framed(OWN, 1)) - 1, len(framed(OWN, 1)) + 4, 600):
            with pytest.raises(ValueError, match=f"{length} bytes"):
                hearing.wrap(bytes(length), 1, 0)


def test_it_sleeps_until_a_slot_and_a_while_at_most() -> None:
    with UdpPort(UDP) as end:
        hearing = hearing_of(OPEN, end)
        now = time.monotonic_ns()
        hearing.hear_slot(100, hearing.local_ns(now))
        assert hearing.listen(102, SLOT_NS // 2) is not None
        assert time.monotonic_ns() - now >= 3 * SLOT_NS // 2
        assert hearing.late_ns(102) >= -SLOT_NS // 2
        assert hearing.listen(10_000, 0) is None  # so that a signal is noticed
        assert not hearing.sleep_until(10_000, 0)
        assert hearing.sleep_until(100, 0)


def given_values() -> dict[str, Any]:
    """What a hearing is made of."""
    return {
        "agents": 5, "id": 2, "anchor_every": 3, "slot_ns": SLOT_NS, "seed": 1, "header": bytes(8), "late_bytes": 2,
        "peers": 4, "key": b"", "session": 0, "flight_ns": 0, "position_step": 0.002, "length": 45,
        "own_bytes": 0, "limit_ns": 1, "trust_ns": 1, "clock_began_ns": 0, "clock_offset_ns": 0, "clock_drift_ppb": 0,
        "moving": 9, "resting": 9, "named": 9, "port": NoPort().compiled,
    }  # fmt: skip


@pytest.mark.parametrize("drift", [1, -1, 40_000, -1_000_000, 500_000_000, -500_000_000])
def test_the_own_clock_is_exact_however_long_it_runs(drift: int) -> None:
    hearing = Hearing(*(given_values() | {"clock_drift_ppb": drift}).values())  # type: ignore[arg-type]
    draw = random.Random(drift)
    for bits in range(1, 62):
        for elapsed in (draw.randrange(1 << bits), -draw.randrange(1 << bits), 1 << bits, -(1 << bits)):
            assert hearing.local_ns(elapsed) == elapsed + elapsed * drift // 10**9


@pytest.mark.skipif(platform.machine() != "x86_64" or not shutil.which("gcc"), reason="needs gcc for x86_64")
def test_the_hearing_compiles_for_32_bits(tmp_path: Path) -> None:
    """No 128-bit integers there, and `long` is short. The headers of 64 bits do for a look at the syntax."""
    (tmp_path / "gnu").mkdir()
    (tmp_path / "gnu" / "stubs-32.h").touch()
    package = Path(dtsa_agent.__file__).parent
    rooms = [package / "air" / "_hearing", package / "libdtsa", package / "libdtsa" / "include", tmp_path]
    words = ["gcc", "-m32", "-std=c11", "-Wall", "-Wextra", "-Werror", "-D_GNU_SOURCE", "-fsyntax-only"]
    words += [f"-I{room}" for room in rooms]
    words += ["-idirafter", "/usr/include/x86_64-linux-gnu"]
    subprocess.run([*words, package / "air" / "_hearing" / "hearing.c"], check=True, timeout=60)


@pytest.mark.parametrize(
    "wrong",
    [
        {"agents": 0},
        {"id": 6},
        {"header": bytes(9)},
        {"late_bytes": 1},
        {"peers": -1},
        {"peers": 5},
        {"length": 18},
        {"key": bytes(33)},
        {"slot_ns": 0},
        {"trust_ns": 0},
        {"clock_drift_ppb": 500_000_001},
        {"clock_drift_ppb": -500_000_001},
    ],
)
def test_values_that_cannot_be_are_refused(wrong: dict[str, Any]) -> None:
    values = given_values()
    Hearing(*values.values())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="out of range"):
        Hearing(*(values | wrong).values())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="Capsule"):
        Hearing(*(values | {"port": None}).values())  # type: ignore[arg-type]
