"""Agents over UDP, part by part: settings, datagrams, clocks, what is counted and printed."""

from __future__ import annotations

import dataclasses
import errno
import os
import socket
import subprocess
import sys
import time
from itertools import chain, repeat
from types import SimpleNamespace
from typing import Any
from unittest.mock import DEFAULT, MagicMock

import pytest

from dtsa_agent.air.driver import LiveAgent
from dtsa_agent.air.port import ReceivedDatagram, link_of
from dtsa_agent.air.record import SlotRecord
from dtsa_agent.air.settings import AgentSettings, UdpSettings
from dtsa_agent.air.udp_port import UdpPort
from dtsa_agent.core import ConfigError, Frame, Swarm, SwarmConfig, encode_frame
from dtsa_agent.core.authentication import Authenticator
from dtsa_agent.core.kernel import ffi, lib
from dtsa_agent.core.station import BETWEEN, ClockMap, Station, StationSettings
from dtsa_agent.priority import realtime_thread
from dtsa_agent.stop import Stop

SLOT_NS = 10_000_000
KEY = bytes.fromhex("8f3c1d5e7a9b2460c1e3f5a7b9d8c6e4")
CONFIG = SwarmConfig(agents=3, policy="lease")


@pytest.mark.parametrize(("field", "values"), [
    ("interface", {"interface": "none0"}), ("interface", {}), ("group", {"interface": "lo", "group": "10.0.0.1:7000"}),
    ("group", {"interface": "lo", "group": "239.1.1.1"}), ("group", {"interface": "lo", "group": "239.1.1.1:0"}),
    ("group", {"interface": "lo", "group": "239.1.1.1:70000"}), ("group", {"interface": "lo", "group": "239.1.1:7000"}),
    ("ttl", {"interface": "lo", "ttl": 0}),
])  # fmt: skip
def test_networks_that_cannot_be_used_are_refused_by_name(field: str, values: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as error:
        UdpSettings.from_dict(values)
    assert error.value.field == field


@pytest.mark.parametrize(("field", "own", "config", "key"), [
    ("id", 4, CONFIG, ""), ("policy", 1, dataclasses.replace(CONFIG, policy="dtsa"), ""),
    ("DTSA_AUTH_KEY", 1, dataclasses.replace(CONFIG, auth=True, auth_session=1), ""),
    ("auth_key", 1, dataclasses.replace(CONFIG, auth=True, auth_session=1), "00" * 16),
    ("auth_session", 1, dataclasses.replace(CONFIG, auth=True), KEY.hex()),
])  # fmt: skip
def test_agents_that_cannot_fly_are_refused_by_name(
    monkeypatch: pytest.MonkeyPatch, field: str, own: int, config: SwarmConfig, key: str
) -> None:
    monkeypatch.setenv("DTSA_AUTH_KEY", key)
    with UdpPort(UdpSettings(interface="lo")) as port, pytest.raises(ConfigError) as error:
        LiveAgent(AgentSettings(id=own), config, port)
    assert error.value.field == field


def framed(sender: int, slot: int) -> bytes:
    return encode_frame(Frame(sender, slot, 1, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0)))


def datagrams(config: SwarmConfig, authenticator: Authenticator | None = None) -> StationSettings:
    return StationSettings(config, link_of(config), authenticator)


def test_datagrams_of_other_settings_or_with_another_key_are_none_of_ours() -> None:
    config = SwarmConfig(agents=3, policy="tdma")
    here, frame = datagrams(config), framed(2, 7)
    assert here.read(here.write(frame, 7, 50_000)) == ("", 2, 7, 50_000, (), frame)
    for changed in ({"slot_ms": 20.0}, {"agents": 4}, {"seed": 2}, {"auth_session": 1}):
        there = datagrams(dataclasses.replace(config, moving=None, **changed))
        assert here.read(there.write(frame, 7)).fault == "other settings"
    sealed = dataclasses.replace(config, auth=True, auth_session=1)
    good = datagrams(sealed, Authenticator(KEY, 1)).write(frame, 7)
    for other in (Authenticator(KEY[::-1], 1), Authenticator(KEY, 2)):
        assert datagrams(sealed, other).read(good).fault == "rejected"


@pytest.mark.parametrize("drift", [0, 50_000, -1_000_000])
def test_a_bent_clock_is_read_both_ways(drift: int) -> None:
    clock = ClockMap(-5_000_000_000, drift)
    now = time.monotonic_ns()
    for later in (0, 1, 10**9, 86_400 * 10**9):
        assert abs(clock.monotonic_ns(clock.local_ns(now + later)) - now - later) <= 2
    hour = 3600 * 10**9
    assert clock.local_ns(now + hour) - clock.local_ns(now) == pytest.approx(hour + hour * drift / 1e9, abs=2)


def test_stamps_of_a_clock_that_has_been_set_are_not_believed() -> None:
    reader, ahead, second = ffi.new("socket_reader *"), 10**18, 10**9
    lib.socket_look(reader, ahead, 5 * second)
    lib.socket_look(reader, ahead + 1_000, 6 * second)
    arrived = 6 * second - 2_000_000
    assert lib.socket_arrival(reader, arrived + ahead + 1_000) == arrived
    steps = reader.clock_steps
    ahead += 3600 * second  # somebody sets the clock
    lib.socket_look(reader, ahead, 7 * second)
    assert reader.clock_steps == steps + 1
    for stamp in (arrived + ahead, arrived + 10**18):
        assert lib.socket_arrival(reader, stamp) == 7 * second
    lib.socket_look(reader, ahead, 8 * second)  # from now on stamps are of the new time
    assert lib.socket_arrival(reader, 8 * second - 5 + ahead) == 8 * second - 5
    for stamp in (0, -1, 8 * second + 1 + ahead, 2**62):
        assert lib.socket_arrival(reader, stamp) == 8 * second


def test_arrivals_are_exact_however_long_a_process_was_kept_waiting() -> None:
    """It stands still between two datagrams of one pass: the second one has arrived long after the first."""
    settings = UdpSettings(interface="lo", group=f"239.255.77.77:{20_000 + os.getpid() % 10_000}")
    with UdpPort(settings) as end, UdpPort(settings) as other:
        began, found = time.monotonic_ns(), list[ReceivedDatagram]()
        while not (found and found[-1].arrival_ns < time.monotonic_ns() - 40_000_000):
            assert time.monotonic_ns() - began < 10 * 10**9
            other.send(b"w")  # the kernel notes times from a moment after the first socket has asked for them
            time.sleep(0.05)
            found = end.receive(16)
        sent = []
        for _ in range(2):
            sent.append(time.monotonic_ns())
            other.send(b"x")
            time.sleep(0.05)
        found = []
        while len(found) < 2:
            assert time.monotonic_ns() - sent[0] < 10 * 10**9
            found += end.receive(16)
    first, second = (datagram.arrival_ns for datagram in found)
    assert sent[0] <= first < sent[1] - 40_000_000  # before it stood still
    assert sent[1] <= second < time.monotonic_ns() - 40_000_000


@pytest.mark.parametrize("flight_ns", [30_000, 600_000, 5_000_000])
def test_who_wakes_late_sends_as_long_as_the_next_turn_is_not_disturbed(flight_ns: int) -> None:
    config = SwarmConfig(agents=2, policy="tdma")
    link = dataclasses.replace(link_of(config), flight_ns=flight_ns)
    latest = SLOT_NS - flight_ns - round(BETWEEN * SLOT_NS)
    assert latest > 0
    station = Station(Swarm(config, local=[1]), StationSettings(config, link, origin_ns=0), 0)
    for slot, late, sends in ((0, latest, 1), (1, 0, 0), (2, latest + 1, 0), (3, 0, 0), (4, 1_000, 1)):
        station.step(slot * SLOT_NS - SLOT_NS // 10)
        assert bool(station.step(slot * SLOT_NS + late)[1]) == bool(sends)
    assert (station.status.sent, station.status.unsent) == (2, 1)


@pytest.mark.parametrize("number", [errno.ENOBUFS, errno.EPERM, errno.ENETUNREACH])
def test_what_the_network_refuses_does_not_count_as_sent(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    udp = UdpSettings(interface="lo", group=f"239.255.79.79:{20_000 + os.getpid() % 10_000}")
    config = SwarmConfig(agents=2, policy="tdma")
    slots: list[SlotRecord] = []
    watcher = SimpleNamespace(slot=slots.append, refused=lambda *unused: None)
    with UdpPort(udp) as port, Stop() as stop:
        agent = LiveAgent(AgentSettings(id=1, duration_s=0.8), config, port, watcher)
        refusing = MagicMock(wraps=port._out)
        refusing.sendto.side_effect = chain([OSError(number, os.strerror(number))] * 3, repeat(DEFAULT))
        monkeypatch.setattr(port, "_out", refusing)
        agent.run(stop)
        found = agent.summary()
    assert found["unsent_because"][os.strerror(number)] == 3
    own_turns = [record for record in slots if record.chosen == 1]
    assert all((record.sent_ns, record.datagram) == (-1, b"") for record in own_turns[:3])
    sent = [record for record in slots if record.datagram]
    assert len(sent) == found["sent"] > 0
    assert all(record.sent_ns > 0 for record in sent)


def test_what_came_before_an_agent_listens_does_not_have_it_begin_in_the_past() -> None:
    udp = UdpSettings(interface="lo", group=f"239.255.78.78:{20_000 + os.getpid() % 10_000}")
    config = SwarmConfig(agents=2, policy="tdma")
    slots: list[SlotRecord] = []
    watcher = SimpleNamespace(slot=slots.append, refused=lambda *unused: None)
    with UdpPort(udp) as port, UdpPort(udp) as other, UdpPort(udp) as witness, Stop() as stop:
        there = StationSettings(config, link_of(config, port.properties))
        for slot in range(1001, 1101, 2):
            assert not other.send(there.write(framed(2, slot), slot))
        waited = sum(len(witness.receive(100)) or time.sleep(0.01) or 0 for _ in range(50))
        LiveAgent(AgentSettings(id=1, duration_s=0.5), config, port, watcher).run(stop)
    if not waited:
        pytest.skip("the loopback interface carries no multicast")
    assert waited == 50
    assert 0 < max(record.slot for record in slots) < 1001


def test_a_queue_that_is_full_is_told() -> None:
    """Linux drops a datagram at a full queue, and says so only to those that have asked for it."""
    with UdpPort(UdpSettings(interface="lo")) as end:
        assert end._out.getsockopt(socket.IPPROTO_IP, 11) == 1  # IP_RECVERR


def test_an_agent_goes_first_and_what_it_starts_does_not() -> None:
    before = os.sched_getscheduler(0)
    with realtime_thread(3) as problem:
        if problem:
            pytest.skip(problem)
        assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_RR
        assert os.sched_getparam(0).sched_priority == 3
        says = [sys.executable, "-c", "import os; print(os.sched_getscheduler(0))"]
        assert int(subprocess.check_output(says)) == os.SCHED_OTHER
    assert os.sched_getscheduler(0) == before
    with realtime_thread(0) as problem:
        assert (problem, os.sched_getscheduler(0)) == ("", before)


def test_the_longest_wait_for_a_frame_is_that_of_an_agent_that_was_heard_and_has_not_left() -> None:
    config = SwarmConfig(agents=3, policy="lease")
    settings, others = datagrams(config), {agent: Swarm(config, local=[agent]) for agent in (2, 3)}
    station = Station(Swarm(config, local=[1]), StationSettings(config, link_of(config), origin_ns=0), 0)

    def step_to(slot: int) -> None:
        while (due := station.step(slot * SLOT_NS)[0]) <= slot * SLOT_NS or station.slot < slot:
            assert due <= slot * SLOT_NS

    def hear(sender: int, slot: int) -> None:
        step_to(slot)
        swarm = others[sender]
        swarm.sends[:] = 1
        swarm.emit(slot)
        assert station.receive(settings.write(swarm.frame(0), slot), slot * SLOT_NS) == 0

    for slot in (100, 103):
        hear(2, slot)
    assert station.longest_gap() == (3, 2)
    for slot in (104, 160):
        hear(3, slot)
    assert station.longest_gap() == (57, 2)
    hear(2, 162)
    assert station.longest_gap() == (59, 2)
    others[2].leave(0)
    hear(2, 163)
    step_to(230)
    assert station.longest_gap() == (70, 3)  # not heard any more; the other one has left
