"""Whether an agent may fly, what it prints, and what its summary counts."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_agent.air.port import link_of
from dtsa_agent.air.record import AgentReports
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.core import ConfigError, Swarm, SwarmConfig
from dtsa_agent.core.station import (
    ALL_BUT_ONE,
    LENGTH,
    OTHER_SETTINGS,
    REJECTED,
    HoverReason,
    Station,
    StationSettings,
)

SECOND = 10**9


def needed(text: str, others: int) -> int:
    """Others that an agent has to hear, and to be heard by, in a swarm with so many others."""
    config = SwarmConfig(agents=others + 1, moving=0, policy="tdma")
    station = Station(Swarm(config, local=[1]), StationSettings(config, link_of(config), None, 1, text, 0), 0)
    station.step(0)
    return int(station.status.needed)


@pytest.mark.parametrize(("text", "by_others"), [
    (ALL_BUT_ONE, {1: 1, 2: 1, 3: 2, 11: 10}), ("100%", {1: 1, 11: 11}), ("80%", {1: 1, 5: 4, 10: 8, 11: 9}),
    ("33.4%", {3: 2}), ("0%", {11: 0}), ("0", {11: 0}), ("3", {3: 3, 11: 3}),
])  # fmt: skip
def test_how_many_others_are_needed(text: str, by_others: dict[int, int]) -> None:
    assert {others: needed(text, others) for others in by_others} == by_others


def test_a_number_may_be_one() -> None:
    assert AgentSettings.from_dict({"id": 1, "quorum": 3}) == AgentSettings(id=1, quorum="3")


@pytest.mark.parametrize("text", ["", "all", "101%", "-1", "0.8", "1.5", "%", "8 %", "\u0663", "all-but-two", True])
def test_other_words_are_refused(text: Any) -> None:
    with pytest.raises(ConfigError) as error:
        AgentSettings(id=1, quorum=text)
    assert error.value.field == "quorum"
    assert error.value.value == text


@given(percent=st.integers(0, 100), others=st.integers(1, 200))
@settings(max_examples=50, deadline=None)
def test_a_share_is_never_less_than_said(percent: int, others: int) -> None:
    found = needed(f"{percent}%", others)
    assert found - 1 < percent * others / 100 + 1e-6 <= found + 2e-6
    assert 0 <= found <= others


def status(hovers: int, hears: int, heard_by: int) -> SimpleNamespace:
    return SimpleNamespace(hovers=hovers, others=5, hears=hears, heard_by=heard_by, needed=4, state=2, timed=0, off=0)


def test_a_state_that_lasts_is_printed_once() -> None:
    lines: list[str] = []
    reports = AgentReports(1, 10.0, lines.append, 0)
    reports.status(status(HoverReason.IS_NEW, 2, 1), SECOND // 2)
    reports.status(status(HoverReason.NONE, 5, 5), SECOND)
    assert lines == []  # a start takes a moment
    for tenth in range(20, 100):
        reports.status(status(HoverReason.NONE, 5, 5), tenth * SECOND // 10)
    assert lines == ["flies: hears 5 of 5, is heard by 5 (quorum 4)"]
    reports.status(status(HoverReason.NO_QUORUM, 2, 1), 50 * SECOND)
    assert len(lines) == 1  # it may be over at once
    reports.status(status(HoverReason.NO_QUORUM, 2, 1), 51 * SECOND)
    reports.status(status(HoverReason.NO_QUORUM, 3, 1), 60 * SECOND)
    assert lines[1:] == ["hovers: hears 2 of 5, is heard by 1 (quorum 4)"]
    reports.status(status(HoverReason.NONE, 5, 5), 61 * SECOND)
    reports.status(status(HoverReason.NONE, 4, 5), 63 * SECOND)
    assert lines[2:] == ["flies: hears 4 of 5, is heard by 5 (quorum 4)"]
    reports.status(status(HoverReason.NONE, 5, 5), 99 * SECOND)
    assert len(lines) == 3


#: Of a station that has done nothing yet.
NOTHING = SimpleNamespace(
    slots=0, sent=0, unsent=0, heard=0, state=0, restarts=0, shifts=0, alignments=0, flight_error_ns=0
)


def test_summaries_tell_how_late_frames_left() -> None:
    reports = AgentReports(1, 10.0, None, 0)
    assert reports.summary(NOTHING, (0, 0))["sends_on_time_share"] is None
    for late in (0, 50_000, 60_000, 3_000_000):
        reports.count_transmission(late, 0)
    found = reports.summary(SimpleNamespace(**vars(NOTHING) | {"sent": 4}), (0, 0))
    assert found["sends_on_time_share"] == 0.75
    assert found["send_late_ms"] == {"p50": pytest.approx(0.05, rel=0.05), "p99": 3.0, "max": 3.0}


def test_the_share_of_agents_heard_counts_from_when_it_could_fly() -> None:
    reports = AgentReports(1, 10.0, None, 0)
    reports.status(status(HoverReason.IS_NEW, 0, 0), 0)
    found = reports.summary(NOTHING, (0, 0))
    assert (found["heard_share"], found["oldest_heard_slots"], found["oldest_heard_of"]) == (None, None, None)
    for hears in (5, 2):
        reports.status(status(HoverReason.NONE, hears, 5), 0)
    found = reports.summary(NOTHING, (63, 3))
    assert (found["heard_share"], found["oldest_heard_slots"], found["oldest_heard_of"]) == (0.7, 63, 3)


def test_other_settings_and_another_key_are_said_in_flight() -> None:
    """A second after the first such datagram, with counts; then not again for a while."""
    lines: list[str] = []
    now = [0]
    reports = AgentReports(1, 10.0, lines.append, 0)

    def arrives(*faults: str) -> list[str]:
        for fault in faults:
            reports.count_refused(fault, now[0])
        reports.status(status(HoverReason.NONE, 5, 5), now[0])
        return [line for line in lines if "datagrams" in line]

    assert arrives(OTHER_SETTINGS, REJECTED, OTHER_SETTINGS, LENGTH) == []
    now[0] += SECOND - 1
    assert arrives() == []
    now[0] += 1
    (line,) = arrives()
    assert re.fullmatch("datagrams not taken in so far: 2 of other settings: slot length.*; 1 of another key.*", line)
    now[0] += 20 * SECOND
    assert len(arrives(REJECTED)) == 1
    now[0] += 10 * SECOND
    assert "; 2 of another key" in arrives()[1]
    now[0] += 1000 * SECOND
    assert len(arrives()) == 2
