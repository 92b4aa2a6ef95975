"""Integration: What a station does where it has been told what time it is; all else is proven on virtual time."""

from __future__ import annotations

import pytest

from dtsa_agent.core import Swarm, SwarmConfig
from dtsa_agent.core.station import STATES, KeepsTime, Link, Station, StationSettings

MS = 1_000_000
SLOT = 20 * MS
LINK = Link(b"", says_late=False, names=0, flight_ns=0, trust_ns=MS)


def settings_of(policy: str = "tdma", id: int = 1, **more: object) -> StationSettings:
    return StationSettings(SwarmConfig(agents=4, policy=policy, slot_ms=SLOT / MS), LINK, None, id, **more)


def station_of(policy: str = "tdma", **more: object) -> Station:
    swarm = Swarm(SwarmConfig(agents=4, policy=policy, slot_ms=SLOT / MS), local=[1])
    return Station(swarm, settings_of(policy, **more), 0)


def open_slot(station: Station, slot: int) -> int:
    """Let time pass until a station opens a slot; when it does."""
    now = at = 0
    while station.slot < slot:
        at, (due, _) = now, station.step(now)
        now = max(now, due)
    return at


def hear_late(station: Station, late_ns: int) -> int:
    """By how much a station's slots have moved after frames of all others, each later by the same."""
    swarms = {id: Swarm(SwarmConfig(agents=4, policy="tdma", slot_ms=SLOT / MS), local=[id]) for id in (2, 3, 4)}
    begin = station.slot_start_ns(0)
    for slot in range(60):
        open_slot(station, slot)
        for id, swarm in swarms.items():
            if swarm.begin(slot):
                start = slot * SLOT + late_ns
                assert not station.receive(settings_of(id=id).write(swarm.frame(0), slot), start)
            swarm.end(slot)
    return station.slot_start_ns(0) - begin


@pytest.mark.parametrize(("keeps", "late_ns", "least", "most"), [
    (KeepsTime.NUMBERS, MS // 2, MS // 4, MS // 2), (KeepsTime.NUMBERS, 3 * MS, 0, 0),
    (KeepsTime.STARTS, MS // 2, 0, 0), (KeepsTime.NOTHING, 3 * MS, 3 * MS, 3 * MS),
])  # fmt: skip
def test_one_that_was_told_the_time_moves_little_or_never(keeps: int, late_ns: int, least: int, most: int) -> None:
    assert least <= hear_late(station_of(origin_ns=0, listens=False, keeps_time=keeps), late_ns) <= most


@pytest.mark.parametrize("far_ns", [11 * MS, -9 * SLOT])
def test_one_that_keeps_its_slots_accepts_frames_however_far_they_are_off(far_ns: int) -> None:
    station = station_of(origin_ns=0, listens=False, keeps_time=KeepsTime.NUMBERS)
    assert hear_late(station, far_ns) == 0
    assert station.status.heard > 40
    assert station.status.restarts == 0


def test_one_that_knows_when_slot_0_was_begins_there_if_it_hears_no_frame() -> None:
    station = station_of(origin_ns=-7 * SLOT // 2, listens=True)
    assert open_slot(station, 0) >= 5 * 4 * SLOT  # a round of anchors
    assert STATES[station.status.state] == "alone"
    assert station.slot_start_ns(0) == -7 * SLOT // 2


@pytest.mark.parametrize(("policy", "lead_ns"), [("tdma", SLOT // 5), ("dtsa", -3 * MS), ("age", -3 * MS)])
def test_where_tables_must_be_equal_it_waits_for_a_frame_beyond_the_start(policy: str, lead_ns: int) -> None:
    station = station_of(policy, origin_ns=0, listens=False)
    assert 2 * SLOT - open_slot(station, 2) == lead_ns  # it misses the frame of agent 2 in slot 1
