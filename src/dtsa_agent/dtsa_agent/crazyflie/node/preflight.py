"""Before motors turn: a list of what a flight needs, and what of it is not so. Without ROS and without links."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from dtsa_agent.crazyflie.safety import outside_fence
from dtsa_agent.crazyflie.settings import RobotSettings, SwarmSettings
from dtsa_agent.crazyflie.state import State, place_text
from dtsa_agent.crazyflie.vehicle import OFF, Snapshot

if TYPE_CHECKING:
    from dtsa_agent.crazyflie.drivers import Radios  # importing it wants cflib

OK, WARN, FAIL = "ok", "warn", "FAIL"
FAR_M = 0.25  # from its initial_position
POOR_LINK = 0.8  # share of the log packets that arrive
LATE_S = 0.1  # a pose from motion capture that takes longer comes late, or its clock is another one
AHEAD_S = -0.002
LAST_PROTOCOL = 10  # older firmware knows no arming requests


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the list."""

    item: str
    level: str  # OK, WARN or FAIL
    text: str

    def __str__(self) -> str:
        return f"{self.level:4}  {self.item:9}  {self.text}"


def preflight(
    settings: SwarmSettings,
    snapshots: Sequence[Snapshot],
    firmware: Mapping[str, tuple[int, str]],
    radios: Radios,
    priority_problem: str,
) -> list[Finding]:
    """The whole list.

    :param snapshots: of all robots, a second or so after they have connected.
    :param firmware: protocol version and revision of those that are connected.
    :param priority_problem: why there is no real-time priority; empty: there is.
    """
    robots = {robot.name: robot for robot in settings.robots}
    now = time.monotonic()
    there = [s for s in snapshots if s.state not in OFF and s.vehicle is not None]
    return [
        *_links(snapshots),
        *_firmware(firmware),
        *_batteries(there, robots),
        *_positions(there, robots, now),
        *_clocks(settings, there, now),
        *_geofence(settings, there),
        *_radios(settings, radios),
        _priority(settings, priority_problem),
    ]


def _all_well(item: str, found: list[Finding], text: str) -> list[Finding]:
    return found or [Finding(item, OK, text)]


def _links(snapshots: Sequence[Snapshot]) -> list[Finding]:
    found = []
    for s in snapshots:
        if s.state == State.EMERGENCY:
            found.append(Finding("links", FAIL, f"{s.name}: emergency ({s.reason}): switch it off and on"))
        elif s.state != State.READY:
            found.append(Finding("links", FAIL, f"{s.name}: {s.state.name.lower()} ({s.reason})"))
        elif s.link_quality < POOR_LINK:
            found.append(Finding("links", WARN, f"{s.name}: {s.link_quality:.0%} of the packets arrive"))
    return _all_well("links", found, f"{len(snapshots)} of {len(snapshots)} Crazyflies are ready")


def _firmware(firmware: Mapping[str, tuple[int, str]]) -> list[Finding]:
    groups: dict[tuple[int, str], list[str]] = {}
    for name, version in firmware.items():
        groups.setdefault(version, []).append(name)
    if not groups:
        return [Finding("firmware", FAIL, "unknown: nobody is connected")]
    found = []
    for (protocol, revision), names in groups.items():
        text = f"{', '.join(names)}: protocol {protocol}, revision {revision}"
        if protocol < LAST_PROTOCOL:
            found.append(Finding("firmware", FAIL, f"{text}: update it (protocol {LAST_PROTOCOL} or later)"))
        elif len(groups) > 1:
            found.append(Finding("firmware", WARN, f"{text}: not the same as the others'"))
    (protocol, revision), names = next(iter(groups.items()))
    return _all_well("firmware", found, f"all {len(names)}: protocol {protocol}, revision {revision}")


def _batteries(there: Sequence[Snapshot], robots: Mapping[str, RobotSettings]) -> list[Finding]:
    found, volts = [], []
    for s in there:
        assert s.vehicle is not None
        limits, voltage = robots[s.name].battery, s.vehicle.battery
        volts.append(voltage)
        if voltage < limits.voltage_critical:
            found.append(
                Finding("batteries", FAIL, f"{s.name}: {voltage:.2f} V, critical {limits.voltage_critical:g} V")
            )
        elif voltage < limits.voltage_warning:
            found.append(Finding("batteries", WARN, f"{s.name}: {voltage:.2f} V, warning {limits.voltage_warning:g} V"))
    if not volts:
        return [Finding("batteries", FAIL, "unknown: nobody is connected")]
    return _all_well("batteries", found, f"{min(volts):.2f} to {max(volts):.2f} V")


def _positions(there: Sequence[Snapshot], robots: Mapping[str, RobotSettings], now: float) -> list[Finding]:
    found, away = [], []
    for s in there:
        assert s.vehicle is not None
        distance = math.dist(s.vehicle.position[:2], robots[s.name].initial_position[:2])
        away.append(distance)
        where = place_text(s.vehicle.position)
        if not all(map(math.isfinite, s.vehicle.position)):
            found.append(Finding("positions", FAIL, f"{s.name}: not finite {where}"))
        elif distance > FAR_M:
            text = f"{s.name}: at {where} in the world, {distance:.2f} m from its initial_position"
            found.append(Finding("positions", WARN, text))
        if s.tracker is not None and s.tracker.rate(now) == 0.0:
            text = f"{s.name}: not seen by motion capture {s.tracker.reason}".rstrip()
            found.append(Finding("positions", FAIL, text))
    if not away:
        return [Finding("positions", FAIL, "unknown: nobody is connected")]
    text = f"at most {max(away):.2f} m from the initial positions"
    rates = [s.tracker.rate(now) for s in there if s.tracker is not None]
    if rates:
        text += f"; motion capture at {min(rates):.0f} to {max(rates):.0f} Hz"
    return _all_well("positions", found, text)


def _clocks(settings: SwarmSettings, there: Sequence[Snapshot], now: float) -> list[Finding]:
    if not settings.station.positions.on:
        return [Finding("clocks", OK, "one clock, the station's: there is no motion capture")]
    found, medians = [], []
    for s in there:
        if s.tracker is None or s.tracker.rate(now) == 0.0:
            continue
        median = s.tracker.latency(0.5)
        medians.append(median)
        if not AHEAD_S <= median <= LATE_S:
            text = (
                f"{s.name}: poses are {median * 1000:.1f} ms old when they are sent: late, or stamped by another clock"
            )
            found.append(Finding("clocks", WARN, text))
    if not medians:
        return [Finding("clocks", WARN, "motion capture's is unknown: no pose comes")]
    return _all_well(
        "clocks", found, f"poses are {min(medians) * 1000:.1f} to {max(medians) * 1000:.1f} ms old when sent"
    )


def _geofence(settings: SwarmSettings, there: Sequence[Snapshot]) -> list[Finding]:
    fence = settings.station.safety
    if not fence.geofence:
        return [Finding("geofence", WARN, "switched off")]
    found = []
    for s in there:
        assert s.vehicle is not None
        if problem := outside_fence(s.vehicle.position, fence, settings.station.room_origin_in_world):
            found.append(Finding("geofence", FAIL, f"{s.name}: {problem}"))
    low, high = ("(" + ", ".join(f"{p:g}" for p in c) + ")" for c in (fence.geofence_min, fence.geofence_max))
    return _all_well("geofence", found, f"{low} to {high} in map; all stand inside")


def _radios(settings: SwarmSettings, radios: Radios) -> list[Finding]:
    loads = settings.loads
    if not loads:
        return [Finding("budget", OK, "no radios (udp, usb)")]
    bad = WARN if settings.station.force_budget else FAIL
    found = [Finding("budget", OK if load.fits else bad, str(load)) for load in loads]
    if radios.spare is None:
        found.append(Finding("emergency", WARN, "no radio is left for emergency stops: plug in one more"))
    else:
        found.append(Finding("emergency", OK, f"radio {radios.spare.radio} is kept for emergency stops"))
    for name in radios.foreign:
        found.append(Finding("budget", WARN, f"radio {name}: packets are repeated: somebody else sends on the channel"))
    return found


def _priority(settings: SwarmSettings, problem: str) -> Finding:
    if not settings.station.priority:
        return Finding("priority", WARN, "none (station.priority is 0): keep the station free of other work")
    if problem:
        return Finding("priority", WARN, f"no real-time priority ({problem}): keep the station free of other work")
    return Finding("priority", OK, f"real-time priority {settings.station.priority}")
