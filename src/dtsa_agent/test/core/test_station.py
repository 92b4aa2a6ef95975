"""A station: its datagrams, any bytes, slot numbers at the end of their cycle, and its use without I/O."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dtsa_agent.core import ConfigError, Swarm, SwarmConfig
from dtsa_agent.core.authentication import Authenticator
from dtsa_agent.core.kernel import ffi, lib
from dtsa_agent.core.reference import datagram
from dtsa_agent.core.reference.frame import PROFILE_EXTENDED, PROFILE_PAPER
from dtsa_agent.core.reference.table import Rules
from dtsa_agent.core.station import STATES, VERDICTS, HoverReason, Link, Named, Station, StationSettings

MS = 1_000_000
NETWORK = Link(b"DT\x01\x00abcd", True, 4, 100_000, MS)  # UDP, a modem, a Crazyradio, nothing but frames
LINKS = (NETWORK, Link(b"ab", True, 1, 5 * MS, MS), Link(b"abcd", False, 1, MS, MS), Link(b"", False, 0, 0, MS))
KEY = bytes(range(16))
PAPER = bytes.fromhex("10 0200 01 e8030000 f401 18fc fa00 96f0ff 0000")  # of agent 2, slot 1000
links, policies, signed = st.sampled_from(LINKS), st.sampled_from(["tdma", "lease"]), st.booleans()
lates = st.integers(0, 0xFFFF).map(lambda units: units * 10_000)
offsets = st.integers(-0x8000, 0x7FFF).map(lambda units: units * 10_000)


def config_of(policy: str, agents: int = 5) -> SwarmConfig:
    return SwarmConfig(agents=agents, policy=policy, slot_ms=10.0, seed=3, moving=0)


def settings_of(policy: str, link: Link = NETWORK, is_signed: bool = False, **more: Any) -> StationSettings:
    return StationSettings(config_of(policy), link, Authenticator(KEY, 77) if is_signed else None, **more)


def frame_of(policy: str, slot: int, sender: int = 2) -> bytes:
    """A frame of an agent, as it would send it in a slot on the air."""
    swarm = Swarm(config_of(policy), local=[sender])
    swarm.begin(0)
    swarm.sends[:] = 1
    swarm.emit(slot)
    return bytes(swarm.frame(0))


def read_plainly(data: bytes, policy: str, link: Link, is_signed: bool) -> Any:
    """What the other statement reads in a datagram."""
    c, key = config_of(policy), KEY if is_signed else b""
    rules = Rules(
        agents=5, slot_s=0.01, policy=policy, profile=PROFILE_EXTENDED if policy == "lease" else PROFILE_PAPER,
        anchor_every=c.anchor_every, main_every=c.main_every, open_every=c.open_period,
    )  # fmt: skip
    fields = datagram.Link(link.header, link.says_late, link.names, link.flight_ns, link.trust_ns)
    return datagram.parse_datagram(data, datagram.Settings(1, 10 * MS, 3, fields, 0, 0.0, key, 77), rules)


NAMED = "0100 1900 0300 fdff 00000000 00000000"


@pytest.mark.parametrize(("link", "names", "head", "tag"), [
    *(
        (NETWORK, (Named(1, 250_000), Named(3, -30_000)), f"4454 0100 61626364 0c00 {NAMED}", tag)
        for tag in ("", "d0479231")
    ),
    (LINKS[1], (Named(5, 0),), "6162 0c00 0500 0000", ""), (LINKS[2], (), "61626364 0000 0000", "fc31df13"),
    (LINKS[3], (), "", ""),
])  # fmt: skip
def test_golden_datagrams(link: Link, names: tuple[Named, ...], head: str, tag: str) -> None:
    """Written by hand from the layout in docs/reference/network.md, but for the tags."""
    station = settings_of("tdma", link, bool(tag))
    data = station.write(PAPER, 1000, 120_000, names)
    assert data == bytes.fromhex(head) + PAPER + bytes.fromhex(tag)
    parsed = station.read(data)
    assert (parsed.fault, parsed.sender, parsed.slot, parsed.frame) == ("", 2, 1000, PAPER)
    assert parsed.late_ns == 120_000 * link.says_late
    assert parsed.names == names


@given(links, policies, signed, lates, st.lists(st.tuples(st.integers(1, 0xFFFF), offsets), max_size=4), st.data())
def test_what_is_written_is_read(
    link: Link, policy: str, is_signed: bool, late_ns: int, names: list[tuple[int, int]], data: st.DataObject
) -> None:
    station, slot = settings_of(policy, link, is_signed), data.draw(st.integers(0, 2**31))
    frame, names = frame_of(policy, slot), names[: link.names]
    written = station.write(frame, slot, late_ns, tuple(names))
    assert len(written) == station.length
    parsed = station.read(written)
    assert parsed == ("", 2, slot, late_ns * link.says_late, tuple(map(Named._make, names)), frame)
    changed = bytearray(written)
    changed[data.draw(st.integers(0, len(written) - 1))] ^= data.draw(st.integers(1, 255))
    if is_signed:
        assert station.read(bytes(changed)).fault
    plain = read_plainly(bytes(changed), policy, link, is_signed)
    compiled = station.read(bytes(changed))
    assert VERDICTS.index(compiled.fault) == (plain if isinstance(plain, int) else 0)


def test_values_beyond_the_fields_are_cut_off() -> None:
    station = settings_of("tdma")
    for late_ns, read_ns in ((-1, 0), (10**12, 0xFFFF * 10_000), (9_999, 0), (10_000, 10_000)):
        assert station.read(station.write(PAPER, 1000, late_ns)).late_ns == read_ns
    for offset_ns, read_ns in ((-(10**12), -0x8000 * 10_000), (10**12, 0x7FFF * 10_000), (-1, -10_000)):
        assert station.read(station.write(PAPER, 1000, 0, ((1, offset_ns),))).names == ((1, read_ns),)


def test_a_frame_of_another_length_is_not_written() -> None:
    with pytest.raises(ValueError, match="frame: got 18 bytes; allowed: 19"):
        settings_of("tdma").write(PAPER[:-1], 1000)


FAULTS = (
    ("", 0, b"", ""), ("not ours", 0, b"XX", ""), ("other settings", 4, b"x", ""), ("length", 0, b"", "short"),
    ("length", 0, b"", "long"), ("no frame", 26, b"\x20", ""), ("no frame", 26, b"\x13", ""),
    ("unknown agent", 27, b"\x06", ""), ("unknown agent", 27, b"\x00", ""), ("no frame", 30, b"\xff\xff\xff\xff", ""),
)  # fmt: skip


@pytest.mark.parametrize(("fault", "at", "bytes_", "cut"), FAULTS)
def test_each_fault_has_its_verdict(fault: str, at: int, bytes_: bytes, cut: str) -> None:
    data = bytearray(settings_of("tdma").write(PAPER, 1000))
    data[at : at + len(bytes_)] = bytes_
    data = {"short": data[:-1], "long": data + b"x"}.get(cut, data)
    assert settings_of("tdma").read(bytes(data)).fault == fault


@settings(max_examples=300)
@given(links, policies, signed, st.sampled_from(["", "header", "head"]), st.binary(max_size=120), st.booleans())
@example(NETWORK, "tdma", False, "", b"", False)
@example(LINKS[3], "tdma", False, "", b"", False)
@example(NETWORK, "tdma", False, "", b"DT", False)
def test_any_bytes_are_refused_or_accepted_alike(
    link: Link, policy: str, is_signed: bool, begin: str, body: bytes, is_fitted: bool
) -> None:
    """By both statements, by what only reads, and by a station that listens or has slots."""
    reader = settings_of(policy, link, is_signed)
    data = {"": b"", "header": link.header, "head": link.header + bytes(2 * link.says_late + 4 * link.names)}[begin]
    data += (frame_of(policy, 7)[:4] if begin == "head" else b"") + body
    data = data.ljust(reader.length, b"\0")[: reader.length] if is_fitted else data
    read, parsed = reader.read(data), read_plainly(data, policy, link, is_signed)
    assert read.fault in VERDICTS
    assert VERDICTS.index(read.fault) == (parsed if isinstance(parsed, int) else 0)
    for origin_ns in (None, 0):
        own = settings_of(policy, link, is_signed, origin_ns=origin_ns)
        station = Station(Swarm(config_of(policy), local=[1]), own, 0)
        verdict = station.receive(data, 5 * MS)
        assert 0 <= verdict < len(VERDICTS)
        if read.fault:
            assert VERDICTS[verdict] == read.fault
            assert station.status.refused[verdict] == 1


@dataclass
class Recorder:
    slots: list[int] = field(default_factory=list)

    def opened(self, *unused: Any) -> None: ...
    def restarted(self, *unused: Any) -> None: ...
    def sent(self, *unused: Any) -> None: ...
    def refused(self, *unused: Any) -> None: ...
    def heard(self, sender: int, slot: int, datagram: bytes, arrival_ns: int, accepted: bool) -> None:
        self.slots.append(slot)


def step_until_due_later(station: Station, now_ns: int) -> None:
    while station.step(now_ns)[0] <= now_ns:
        pass


@given(policies, st.integers(0, 3), st.integers(-3, 3), signed, st.integers(1, 3))
def test_slot_numbers_are_unwrapped(policy: str, cycles: int, beyond: int, is_signed: bool, ahead: int) -> None:
    """The number on the air has a cycle, the slot has none."""
    sender = settings_of(policy, is_signed=is_signed, id=2)
    cycle = sender.c.slot_cycle
    assert cycle <= 2**32
    assert cycle % 5 == 0  # as many as there are agents: turns go on alike
    slot = max(0, cycles * cycle + beyond)
    origin_ns = 10**15 - slot * 10 * MS
    own, recorder = settings_of(policy, is_signed=is_signed, origin_ns=origin_ns), Recorder()
    station = Station(Swarm(config_of(policy), local=[1]), own, 10**15 - 10 * MS, events=recorder)
    step_until_due_later(station, 10**15 - 10 * MS)
    heard = slot + ahead
    datagram, now_ns = sender.write(frame_of(policy, heard % cycle), heard), 10**15 + ahead * 10 * MS
    assert sender.read(datagram).slot == heard % cycle
    assert station.receive(datagram, now_ns + NETWORK.flight_ns) == 0
    assert station.status.in_step == 2
    assert station.slot_start_ns(heard) == now_ns
    step_until_due_later(station, now_ns)
    assert recorder.slots == [heard]


@pytest.mark.parametrize("policy", ["tdma", "lease"])
def test_a_frame_with_another_number_shows_another_time(policy: str) -> None:
    own = settings_of(policy, origin_ns=0)
    station = Station(Swarm(config_of(policy), local=[1]), own, 0)
    for slot in (2**31, 5000, 3):
        data = own.write(frame_of(policy, slot), slot)
        assert VERDICTS[station.receive(data, 10 * MS)] == "other time"
    assert station.status.restarts == 0


class CompiledAgent:
    """An agent of libdtsa behind a station, in memory of just the size that both ask for."""

    def __init__(self, config: Any, c: Any, now_ns: int) -> None:
        size, agent_size = lib.dtsa_station_bytes(c), lib.dtsa_agent_bytes(config)
        self._agent_memory = ffi.new("double[]", agent_size // 8)
        agent = lib.dtsa_agent_start(self._agent_memory, agent_size, config, c.id)
        self._memory = ffi.new("uint8_t[]", size + 16)
        self._memory[size : size + 16] = b"\xa5" * 16
        self._size = size
        behind = ffi.new("dtsa_station_agent *", lib.dtsa_station_agent_of(agent))
        self.station = lib.dtsa_station_start(self._memory, size, c, behind, now_ns)
        assert self.station
        self.due_ns = now_ns
        self._out, self._length = ffi.new("uint8_t[]", lib.DTSA_DATAGRAM_MAX), ffi.new("int *")

    def step(self, now_ns: int) -> bytes:
        self.due_ns = lib.dtsa_station_step(self.station, now_ns, self._out, self._length)
        if not self._length[0]:
            return b""
        lib.dtsa_station_sent(self.station, now_ns, 1)
        return bytes(ffi.buffer(self._out, self._length[0]))

    @property
    def status(self) -> Any:
        status = ffi.new("dtsa_station_status *")
        lib.dtsa_station_get_status(self.station, status)
        return status

    def is_intact(self) -> bool:
        return bytes(self._memory[self._size : self._size + 16]) == b"\xa5" * 16


@pytest.mark.parametrize("policy", ["tdma", "lease"])
def test_stations_need_a_clock_and_a_port_and_nothing_else(policy: str) -> None:
    """Datagrams and time in, datagrams and the next wake-up out; memory is the caller's and does not grow."""
    swarm, now_ns = Swarm(config_of(policy, 3)), 0
    kept = [StationSettings(config_of(policy, 3), NETWORK, id=k, quorum="all-but-one") for k in (1, 2, 3)]
    agents = [CompiledAgent(ffi.addressof(swarm.kernel, "config"), own.c, 0) for own in kept]
    random, calls = np.random.default_rng(1), 0
    while now_ns < 8_000 * MS:
        now_ns = max(now_ns, min(agent.due_ns for agent in agents))
        for agent in agents:
            while agent.due_ns <= now_ns:
                datagram, calls = agent.step(now_ns), calls + 1
                for other in agents:
                    if datagram and other is not agent:
                        verdict = lib.dtsa_station_receive(other.station, datagram, len(datagram), now_ns + 100_000)
                        assert verdict in (0, VERDICTS.index("other time"))
                        other.due_ns = now_ns  # a frame may make it due
                noise = random.bytes(int(random.integers(0, 100)))
                assert lib.dtsa_station_receive(agent.station, noise, len(noise), now_ns) != 0
    for agent in agents:
        status = agent.status
        assert (STATES[status.state], status.hovers, status.in_step) == ("joined", HoverReason.NONE, 3)
        assert (status.hears, status.heard_by, status.both, status.needed, status.others) == (2, 2, 2, 1, 2)
        assert agent.is_intact()
    assert calls < 3 * 8_000 / 10 * 5  # a few a slot


def test_memory_is_known_before_the_flight() -> None:
    """A fixed part with 64 frames of slots still to come, and 88 bytes an agent."""
    sizes = [lib.dtsa_station_bytes(StationSettings(config_of("lease", n), NETWORK).c) for n in (2, 3, 254)]
    assert sizes[1] - sizes[0] <= 88
    assert sizes[2] <= 10_000 + 88 * 254


@pytest.mark.parametrize(
    "fault",
    [
        {"agents": 0}, {"id": 0}, {"id": 6}, {"anchor_every": 0}, {"main_every": 0}, {"slot_ns": 0}, {"slot_cycle": 0},
        {"frame_length": 7}, {"frame_length": 500}, {"own_bytes": -1}, {"early_count": 0},
        {"key": KEY, "key_length": 9},
    ],
    ids=str,
)  # fmt: skip
def test_settings_that_cannot_be_make_no_station(fault: dict[str, Any]) -> None:
    own, key = settings_of("tdma"), ffi.new("uint8_t[]", KEY)
    memory, needed = ffi.new("double[]", 10_000), lib.dtsa_station_bytes(own.c)
    behind = ffi.new("dtsa_station_agent *")
    assert not lib.dtsa_station_start(memory, needed - 1, own.c, behind, 0)
    assert not lib.dtsa_station_start(ffi.cast("char *", memory) + 1, needed, own.c, behind, 0)
    assert not lib.dtsa_station_start(ffi.NULL, needed, own.c, behind, 0)
    for name, value in fault.items():
        setattr(own.c, name, key if name == "key" else value)
    assert lib.dtsa_station_bytes(own.c) == 0
    assert not lib.dtsa_station_start(memory, 80_000, own.c, behind, 0)


def test_a_quorum_of_more_than_the_others_is_refused() -> None:
    assert settings_of("tdma", quorum="4").c.quorum == 4
    with pytest.raises(ConfigError, match="quorum: got '5'; allowed: at most 4"):
        settings_of("tdma", quorum="5")
