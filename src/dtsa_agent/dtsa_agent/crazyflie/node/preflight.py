"""Before motors turn: a list of what a flight needs, and what of it is not so. Without ROS and without links."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from dtsa_agent.crazyflie.safety import outside_fence
from dtsa_agent.crazyflie.settings import SwarmSettings
from dtsa_agent.crazyflie.state import State, VehicleState, place_text
from dtsa_agent.crazyflie.vehicle import OFF, Snapshot

if TYPE_CHECKING:
    from dtsa_agent.crazyflie.drivers import DongleSet  # importing it wants cflib

OK, WARN, FAIL = "ok", "warn", "FAIL"
FAR_M = 0.25  # from its initial_position
POOR_LINK = 0.8  # share of the log packets that arrive
AHEAD_S, LATE_S = -0.002, 0.1  # a pose of motion capture that is not so old is late, or its clock is another one
LAST_PROTOCOL = 10  # older firmware knows no arming requests

Firmware = Mapping[str, tuple[int, str]]  # protocol version and revision of those that are connected
Items = Iterator[tuple[str, str]]  # level and text of each line


class Finding(NamedTuple):
    """One line of the list."""

    item: str
    level: str  # OK, WARN or FAIL
    text: str

    def __str__(self) -> str:
        return f"{self.level:4}  {self.item:9}  {self.text}"


def preflight(
    settings: SwarmSettings, snapshots: Sequence[Snapshot], firmware: Firmware, radios: DongleSet, priority_problem: str
) -> list[Finding]:
    """Return the whole list.

    :param snapshots: of all robots, a second or so after they have connected.
    :param priority_problem: why there is no real-time priority; empty: there is.
    """
    here = [(s, s.vehicle) for s in snapshots if s.state not in OFF and s.vehicle is not None]
    items = {
        "links": _links(snapshots), "firmware": _firmware(firmware), "batteries": _batteries(settings, here),
        "positions": _positions(settings, here), "clocks": _clocks(settings, here),
        "geofence": _geofence(settings, here), "budget": _budget(settings, radios),
        "emergency": _emergency(settings, radios), "priority": _priority(settings, priority_problem),
    }  # fmt: skip
    found = []
    for item, lines in items.items():
        given = [Finding(item, level, text) for level, text in lines]
        bad = [finding for finding in given if finding.level != OK]
        # What is well is said only where nothing is not; each radio has its own line.
        found += given if item == "budget" else bad or given
    return found


Here = Sequence[tuple[Snapshot, VehicleState]]


def _links(snapshots: Sequence[Snapshot]) -> Items:
    for s in snapshots:
        if s.state == State.EMERGENCY:
            yield FAIL, f"{s.name}: emergency ({s.reason}): switch it off and on"
        elif s.state != State.READY:
            yield FAIL, f"{s.name}: {s.state.name.lower()} ({s.reason})"
        elif s.link_quality < POOR_LINK:
            yield WARN, f"{s.name}: {s.link_quality:.0%} of the packets arrive"
    yield OK, f"{len(snapshots)} of {len(snapshots)} Crazyflies are ready"


def _firmware(firmware: Firmware) -> Items:
    groups: dict[tuple[int, str], list[str]] = {}
    for name, version in firmware.items():
        groups.setdefault(version, []).append(name)
    for (protocol, revision), names in groups.items():
        text = f"protocol {protocol}, revision {revision}"
        if protocol < LAST_PROTOCOL:
            yield FAIL, f"{', '.join(names)}: {text}: update it (protocol {LAST_PROTOCOL} or later)"
        elif len(groups) > 1:
            yield WARN, f"{', '.join(names)}: {text}: not the same as the others'"
        else:
            yield OK, f"all {len(names)}: {text}"
    if not groups:
        yield FAIL, "unknown: nobody is connected"


def _batteries(settings: SwarmSettings, here: Here) -> Items:
    limits = {robot.name: robot.battery for robot in settings.robots}
    for s, vehicle in here:
        volts, limit = vehicle.battery, limits[s.name]
        if volts < limit.voltage_critical:
            yield FAIL, f"{s.name}: {volts:.2f} V, critical {limit.voltage_critical:g} V"
        elif volts < limit.voltage_warning:
            yield WARN, f"{s.name}: {volts:.2f} V, warning {limit.voltage_warning:g} V"
    volts_of_all = [vehicle.battery for _, vehicle in here]
    if not here:
        yield FAIL, "unknown: nobody is connected"
    else:
        yield OK, f"{min(volts_of_all):.2f} to {max(volts_of_all):.2f} V"


def _positions(settings: SwarmSettings, here: Here) -> Items:
    places, now, away = {robot.name: robot.initial_position for robot in settings.robots}, time.monotonic(), [0.0]
    for s, vehicle in here:
        away.append(math.dist(vehicle.position[:2], places[s.name][:2]))
        where = place_text(vehicle.position)
        if not all(map(math.isfinite, vehicle.position)):
            yield FAIL, f"{s.name}: not finite {where}"
        elif away[-1] > FAR_M:
            yield WARN, f"{s.name}: at {where} in the world, {away[-1]:.2f} m from its initial_position"
        if s.tracker is not None and s.tracker.rate(now) == 0.0:
            yield FAIL, f"{s.name}: not seen by motion capture {s.tracker.reason}".rstrip()
    if not here:
        yield FAIL, "unknown: nobody is connected"
    rates = [s.tracker.rate(now) for s, _ in here if s.tracker is not None]
    seen = f"; motion capture at {min(rates):.0f} to {max(rates):.0f} Hz" if rates else ""
    yield OK, f"at most {max(away):.2f} m from the initial positions{seen}"


def _clocks(settings: SwarmSettings, here: Here) -> Items:
    if not settings.station.positions.on:
        yield OK, "one clock, the station's: there is no motion capture"
        return
    ages = {s.name: s.tracker.latency(0.5) for s, _ in here if s.tracker is not None and s.tracker.latencies}
    for name, age in ages.items():
        if not AHEAD_S <= age <= LATE_S:
            yield WARN, f"{name}: poses are {age * 1000:.1f} ms old when they are sent: late, or another clock's"
    if ages:
        yield OK, f"poses are {min(ages.values()) * 1000:.1f} to {max(ages.values()) * 1000:.1f} ms old when sent"
    else:
        yield WARN, "motion capture's is unknown: no pose comes"


def _geofence(settings: SwarmSettings, here: Here) -> Items:
    fence = settings.station.safety
    if not fence.geofence:
        yield WARN, "switched off"
        return
    for s, vehicle in here:
        if problem := outside_fence(vehicle.position, fence, settings.station.room_origin_in_world):
            yield FAIL, f"{s.name}: {problem}"
    low, high = ("(" + ", ".join(f"{p:g}" for p in c) + ")" for c in (fence.geofence_min, fence.geofence_max))
    yield OK, f"{low} to {high} in map; all stand inside"


def _budget(settings: SwarmSettings, radios: DongleSet) -> Items:
    loads, bad = settings.loads, WARN if settings.station.force_budget else FAIL
    for load in loads:
        yield OK if load.fits else bad, str(load)
    for name in radios.foreign:
        yield WARN, f"radio {name}: packets are repeated: somebody else sends on its channel"
    if not loads:
        yield OK, "no radios (udp, usb)"


def _emergency(settings: SwarmSettings, radios: DongleSet) -> Items:
    if not settings.loads:
        yield OK, "by the links: there are no radios"
    elif radios.spare is None:
        yield WARN, "no radio is left for emergency stops: they go by the radios of the links"
    else:
        yield OK, f"radio {radios.spare.radio} is kept for emergency stops"


def _priority(settings: SwarmSettings, problem: str) -> Items:
    why = problem and f"no real-time priority ({problem})"
    if not settings.station.priority:
        why = "none (station.priority is 0)"
    yield (WARN, f"{why}: keep the station free of other work") if why else (
        OK, f"real-time priority {settings.station.priority}"
    )  # fmt: skip
