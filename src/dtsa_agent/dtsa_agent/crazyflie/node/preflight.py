"""Checks before take-off: each condition of a flight, and whether it holds. Needs neither ROS nor links."""

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
MAX_START_OFFSET_M = 0.25  # a vehicle farther from its initial_position is reported
MIN_LINK_QUALITY = 0.8  # share of the log packets that arrive
MIN_POSE_AGE_S, MAX_POSE_AGE_S = -0.002, 0.1  # of motion capture; outside, poses are late or the clocks differ
MIN_PROTOCOL = 10  # older firmware has no arming requests

FirmwareVersions = Mapping[str, tuple[int, str]]  # protocol version and revision of each connected Crazyflie, by name
Lines = Iterator[tuple[str, str]]  # level and text of each line
ConnectedVehicles = Sequence[tuple[Snapshot, VehicleState]]


class Finding(NamedTuple):
    """One line of the list."""

    item: str
    level: str  # OK, WARN or FAIL
    text: str

    def __str__(self) -> str:
        return f"{self.level:4}  {self.item:9}  {self.text}"


def check_preflight(
    settings: SwarmSettings,
    snapshots: Sequence[Snapshot],
    firmware: FirmwareVersions,
    radios: DongleSet,
    priority_problem: str,
) -> list[Finding]:
    """Check all conditions of a flight; return the list for the operator.

    :param snapshots: of all robots, taken about a second after they have connected.
    :param priority_problem: why there is no real-time priority; empty if there is.
    """
    connected = [(s, s.vehicle) for s in snapshots if s.state not in OFF and s.vehicle is not None]
    items = {
        "links": _links(snapshots), "firmware": _firmware(firmware), "batteries": _batteries(settings, connected),
        "positions": _positions(settings, connected), "clocks": _clocks(settings, connected),
        "geofence": _geofence(settings, connected), "budget": _budget(settings, radios),
        "emergency": _emergency(settings, radios), "priority": _priority(settings, priority_problem),
    }  # fmt: skip
    findings = []
    for item, lines in items.items():
        item_findings = [Finding(item, level, text) for level, text in lines]
        problems = [finding for finding in item_findings if finding.level != OK]
        # OK lines are listed only for items without problems; the budget has one line a radio.
        findings += item_findings if item == "budget" else problems or item_findings
    return findings


def _links(snapshots: Sequence[Snapshot]) -> Lines:
    for s in snapshots:
        if s.state == State.EMERGENCY:
            yield FAIL, f"{s.name}: emergency ({s.reason}): switch it off and on"
        elif s.state != State.READY:
            yield FAIL, f"{s.name}: {s.state.name.lower()} ({s.reason})"
        elif s.link_quality < MIN_LINK_QUALITY:
            yield WARN, f"{s.name}: {s.link_quality:.0%} of the packets arrive"
    yield OK, f"{len(snapshots)} of {len(snapshots)} Crazyflies are ready"


def _firmware(firmware: FirmwareVersions) -> Lines:
    groups: dict[tuple[int, str], list[str]] = {}
    for name, version in firmware.items():
        groups.setdefault(version, []).append(name)
    for (protocol, revision), names in groups.items():
        text = f"protocol {protocol}, revision {revision}"
        if protocol < MIN_PROTOCOL:
            yield FAIL, f"{', '.join(names)}: {text}: update it (protocol {MIN_PROTOCOL} or later)"
        elif len(groups) > 1:
            yield WARN, f"{', '.join(names)}: {text}: not the same as the others'"
        else:
            yield OK, f"all {len(names)}: {text}"
    if not groups:
        yield FAIL, "unknown: no Crazyflie is connected"


def _batteries(settings: SwarmSettings, connected: ConnectedVehicles) -> Lines:
    limits = {robot.name: robot.battery for robot in settings.robots}
    for s, vehicle in connected:
        volts, limit = vehicle.battery, limits[s.name]
        if volts < limit.voltage_critical:
            yield FAIL, f"{s.name}: {volts:.2f} V, critical {limit.voltage_critical:g} V"
        elif volts < limit.voltage_warning:
            yield WARN, f"{s.name}: {volts:.2f} V, warning {limit.voltage_warning:g} V"
    volts_of_all = [vehicle.battery for _, vehicle in connected]
    if not connected:
        yield FAIL, "unknown: no Crazyflie is connected"
    else:
        yield OK, f"{min(volts_of_all):.2f} to {max(volts_of_all):.2f} V"


def _positions(settings: SwarmSettings, connected: ConnectedVehicles) -> Lines:
    starts, now, offsets = {robot.name: robot.initial_position for robot in settings.robots}, time.monotonic(), [0.0]
    for s, vehicle in connected:
        offsets.append(math.dist(vehicle.position[:2], starts[s.name][:2]))
        where = place_text(vehicle.position)
        if not all(map(math.isfinite, vehicle.position)):
            yield FAIL, f"{s.name}: not finite {where}"
        elif offsets[-1] > MAX_START_OFFSET_M:
            yield WARN, f"{s.name}: at {where} in the world, {offsets[-1]:.2f} m from its initial_position"
        if s.tracker is not None and s.tracker.rate_hz(now) == 0.0:
            yield FAIL, f"{s.name}: not seen by motion capture {s.tracker.reason}".rstrip()
    if not connected:
        yield FAIL, "unknown: no Crazyflie is connected"
    rates = [s.tracker.rate_hz(now) for s, _ in connected if s.tracker is not None]
    capture = f"; motion capture at {min(rates):.0f} to {max(rates):.0f} Hz" if rates else ""
    yield OK, f"at most {max(offsets):.2f} m from the initial positions{capture}"


def _clocks(settings: SwarmSettings, connected: ConnectedVehicles) -> Lines:
    if not settings.station.positions.enabled:
        yield OK, "one clock, the station's: there is no motion capture"
        return
    ages = {
        s.name: s.tracker.latency_quantile(0.5) for s, _ in connected if s.tracker is not None and s.tracker.latencies
    }
    for name, age in ages.items():
        if not MIN_POSE_AGE_S <= age <= MAX_POSE_AGE_S:
            yield WARN, f"{name}: poses are {age * 1000:.1f} ms old when they are sent: late, or another clock's"
    if ages:
        yield OK, f"poses are {min(ages.values()) * 1000:.1f} to {max(ages.values()) * 1000:.1f} ms old when sent"
    else:
        yield WARN, "clock of motion capture unknown: no pose arrives"


def _geofence(settings: SwarmSettings, connected: ConnectedVehicles) -> Lines:
    fence = settings.station.safety
    if not fence.geofence:
        yield WARN, "switched off"
        return
    for s, vehicle in connected:
        if problem := outside_fence(vehicle.position, fence, settings.station.room_origin_in_world):
            yield FAIL, f"{s.name}: {problem}"
    low, high = ("(" + ", ".join(f"{p:g}" for p in c) + ")" for c in (fence.geofence_min, fence.geofence_max))
    yield OK, f"{low} to {high} in map; all vehicles are inside"


def _budget(settings: SwarmSettings, radios: DongleSet) -> Lines:
    loads, overload_level = settings.loads, WARN if settings.station.force_budget else FAIL
    for load in loads:
        yield OK if load.fits else overload_level, str(load)
    for name in radios.foreign:
        yield WARN, f"radio {name}: packets are repeated: another transmitter uses its channel"
    if not loads:
        yield OK, "no radios (udp, usb)"


def _emergency(settings: SwarmSettings, radios: DongleSet) -> Lines:
    if not settings.loads:
        yield OK, "sent by the links: there are no radios"
    elif radios.spare is None:
        yield WARN, "no radio is left for emergency stops: they go by the radios of the links"
    else:
        yield OK, f"radio {radios.spare.radio} is kept for emergency stops"


def _priority(settings: SwarmSettings, problem: str) -> Lines:
    if not settings.station.priority:
        yield WARN, "none (station.priority is 0): keep the station free of other work"
    elif problem:
        yield WARN, f"no real-time priority ({problem}): keep the station free of other work"
    else:
        yield OK, f"real-time priority {settings.station.priority}"
