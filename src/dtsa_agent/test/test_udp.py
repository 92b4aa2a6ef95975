"""Agents over UDP, part by part: settings, datagrams, clocks, which slot it is."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import pytest

from dtsa_agent.air.udp import AgentSettings, UdpAgent, UdpSettings
from dtsa_agent.air.udp.clock import OwnClock
from dtsa_agent.air.udp.datagram import LENGTH, NOT_OURS, OTHER_SETTINGS, Wrapping
from dtsa_agent.air.udp.slots import SlotTime
from dtsa_agent.air.udp.sockets import StampClock
from dtsa_agent.air.udp.tally import Tally
from dtsa_agent.core import ConfigError, SwarmConfig
from dtsa_agent.core.reference.timebase import ALIGNED, FOREIGN, LISTENING, RESTARTED

SLOT_NS = 10_000_000
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
        ("DTSA_AUTH_KEY", 1, dataclasses.replace(CONFIG, auth=True), ""),
        ("auth_key", 1, dataclasses.replace(CONFIG, auth=True), "00" * 16),
    ],
)
def test_agents_that_cannot_fly_are_refused_by_name(
    monkeypatch: pytest.MonkeyPatch, field: str, own: int, config: SwarmConfig, key: str
) -> None:
    monkeypatch.setenv("DTSA_AUTH_KEY", key)
    with pytest.raises(ConfigError) as error:
        UdpAgent(AgentSettings(id=own), config, UdpSettings(interface="lo"))
    assert error.value.field == field


def test_a_datagram_says_why_it_is_none_of_ours() -> None:
    here = Wrapping(CONFIG)
    frame = bytes(CONFIG.frame_length)
    assert here.fault(here.wrap(frame)) == ""
    assert here.fault(b"") == here.fault(b"DX" + here.wrap(frame)[2:]) == NOT_OURS
    assert here.fault(here.wrap(frame)[:6]) == here.fault(here.wrap(frame + b"\0")) == LENGTH
    for changed in ({"slot_ms": 20.0}, {"agents": 4}, {"seed": 2}, {"auth_session": 1}):
        there = Wrapping(dataclasses.replace(CONFIG, **changed))
        assert here.fault(there.wrap(frame)) == OTHER_SETTINGS


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
    stamps.look()
    assert stamps.steps == 1
    assert abs(stamps.arrival_ns(arrived + 10**18) - time.monotonic_ns()) < 50_000_000
    stamps.look()  # from now on stamps are of the new time
    assert abs(stamps.arrival_ns(arrived + ahead[0]) - arrived) < 500_000
    assert abs(stamps.arrival_ns(0) - time.monotonic_ns()) < 50_000_000
    assert abs(stamps.arrival_ns(None) - time.monotonic_ns()) < 50_000_000


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


def test_the_tally_knows_how_late_frames_left() -> None:
    tally = Tally(SLOT_NS)
    assert tally.summary()["sends_on_time_share"] is None
    for late in (0, 50_000, 60_000, 3_000_000):
        tally.sent(late)
    found = tally.summary()
    assert (found["sent"], found["sends_on_time_share"]) == (4, 0.75)
    assert found["send_late_ms"] == {"p50": 0.06, "p99": 3.01, "max": 3.0}
