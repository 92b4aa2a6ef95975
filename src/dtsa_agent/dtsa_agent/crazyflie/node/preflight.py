"""Checks before take-off: each condition of a flight, and whether it holds. Needs no ROS."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator

from dtsa_agent.crazyflie.bridge import Bridge
from dtsa_agent.crazyflie.positions import quantile
from dtsa_agent.crazyflie.safety import outside_fence
from dtsa_agent.crazyflie.settings import MAX_START_OFFSET_M, GroundStationSettings
from dtsa_agent.crazyflie.state import OFF, State, VehicleState, place_text
from dtsa_agent.crazyflie.vehicle import CrazyflieVehicle

OK, WARN, FAIL = "ok", "warn", "FAIL"
MIN_LINK_QUALITY = 0.8  # share of the log packets that arrive
MIN_POSE_AGE_MS, MAX_POSE_AGE_MS = -2.0, 100.0  # of motion capture; outside, poses are late or the clocks differ
MIN_PROTOCOL = 10  # older firmware has no arming requests
NOBODY = FAIL, "unknown: no Crazyflie is connected"

Lines = Iterator[tuple[str, str]]  # level and text of each line
Connected = list[tuple[CrazyflieVehicle, VehicleState]]


def check_preflight(bridge: Bridge, priority_problem: str) -> list[tuple[str, str, str]]:
    """Check all conditions of a flight, about a second after all have connected.

    :param priority_problem: why there is no real-time priority; empty if there is.
    :returns: item, level (OK, WARN or FAIL) and text of each line.
    """
    vehicles, station = list(bridge.vehicles.values()), bridge.settings.station
    connected = [(v, v.last) for v in vehicles if v.state not in OFF and v.last is not None]
    spare, priority = bridge.radios.spare, (OK, f"real-time priority {station.priority}")
    emergency = OK, "sent by the links: there are no radios"
    if bridge.settings.loads:
        kept = f"radio {spare.radio} is kept for emergency stops" if spare else ""
        emergency = (OK, kept) if kept else (WARN, "no radio is left for emergency stops: they go by the links' radios")
    if priority_problem or not station.priority:
        why = f"no real-time priority ({priority_problem})" if station.priority else "none (station.priority is 0)"
        priority = WARN, f"{why}: keep the station free of other work"
    items: dict[str, Iterable[tuple[str, str]]] = {
        "links": _links(vehicles), "firmware": _firmware(vehicles), "batteries": _batteries(connected),
        "positions": _positions(connected), "clocks": _clocks(station, connected),
        "geofence": _geofence(station, connected), "budget": _budget(bridge), "emergency": [emergency],
        "priority": [priority],
    }  # fmt: skip
    findings = []
    for item, lines in items.items():
        listed = [(item, level, text) for level, text in lines]
        # OK lines are listed only for items without problems; the budget has one line a radio.
        findings += listed if item == "budget" else [line for line in listed if line[1] != OK] or listed
    return findings


def _links(vehicles: list[CrazyflieVehicle]) -> Lines:
    for v in vehicles:
        quality = v.link_quality(time.monotonic())
        if v.state == State.EMERGENCY:
            yield FAIL, f"{v.name}: emergency ({v.action}): switch it off and on"
        elif v.state != State.READY:
            yield FAIL, f"{v.name}: {v.state.name.lower()} ({v.action})"
        elif quality < MIN_LINK_QUALITY:
            yield WARN, f"{v.name}: {quality:.0%} of the packets arrive"
    yield OK, f"{len(vehicles)} of {len(vehicles)} Crazyflies are ready"


def _firmware(vehicles: list[CrazyflieVehicle]) -> Lines:
    versions = {v.name: v.link.firmware for v in vehicles if v.link.firmware is not None}
    texts = {name: f"protocol {protocol}, revision {revision}" for name, (protocol, revision) in versions.items()}
    for name, (protocol, _) in versions.items():
        if protocol < MIN_PROTOCOL:
            yield FAIL, f"{name}: {texts[name]}: update it (protocol {MIN_PROTOCOL} or later)"
        elif len(set(texts.values())) > 1:
            yield WARN, f"{name}: {texts[name]}: not the same as the others'"
    yield (OK, f"all {len(texts)}: {next(iter(texts.values()))}") if texts else NOBODY


def _batteries(connected: Connected) -> Lines:
    for v, report in connected:
        volts, limit = report.battery, v.robot.battery
        if volts < limit.voltage_critical:
            yield FAIL, f"{v.name}: {volts:.2f} V, critical {limit.voltage_critical:g} V"
        elif volts < limit.voltage_warning:
            yield WARN, f"{v.name}: {volts:.2f} V, warning {limit.voltage_warning:g} V"
    volts_of_all = [report.battery for _, report in connected]
    yield (OK, f"{min(volts_of_all):.2f} to {max(volts_of_all):.2f} V") if connected else NOBODY


def _positions(connected: Connected) -> Lines:
    now, offsets, rates = time.monotonic(), [0.0], []
    for v, report in connected:
        offsets.append(math.dist(report.position[:2], v.robot.initial_position[:2]))
        where = place_text(report.position)
        if not all(map(math.isfinite, report.position)):
            yield FAIL, f"{v.name}: not finite {where}"
        elif offsets[-1] > MAX_START_OFFSET_M:
            yield WARN, f"{v.name}: at {where} in the world, {offsets[-1]:.2f} m from its initial_position"
        if v.tracker.settings.enabled:
            rates.append(v.tracker.rate_hz(now))
            if rates[-1] == 0.0:
                yield FAIL, f"{v.name}: not seen by motion capture {v.tracker.reason}".rstrip()
    capture = f"; motion capture at {min(rates):.0f} to {max(rates):.0f} Hz" if rates else ""
    yield (OK, f"at most {max(offsets):.2f} m from the initial positions{capture}") if connected else NOBODY


def _clocks(station: GroundStationSettings, connected: Connected) -> Lines:
    if not station.positions.enabled:
        yield OK, "one clock, the station's: there is no motion capture"
        return
    trackers = {v.name: v.tracker for v, _ in connected if v.tracker.latencies}
    ages = {name: quantile(tracker.latencies, 0.5) * 1000 for name, tracker in trackers.items()}
    for name, age in ages.items():
        if not MIN_POSE_AGE_MS <= age <= MAX_POSE_AGE_MS:
            yield WARN, f"{name}: poses are {age:.1f} ms old when they are sent: late, or another clock's"
    if ages:
        yield OK, f"poses are {min(ages.values()):.1f} to {max(ages.values()):.1f} ms old when sent"
    else:
        yield WARN, "clock of motion capture unknown: no pose arrives"


def _geofence(station: GroundStationSettings, connected: Connected) -> Lines:
    fence = station.safety
    if not fence.geofence:
        yield WARN, "switched off"
    for v, report in connected:
        if problem := outside_fence(report.position, fence, station.room_origin_in_world):
            yield FAIL, f"{v.name}: {problem}"
    low, high = ("(" + ", ".join(f"{p:g}" for p in c) + ")" for c in (fence.geofence_min, fence.geofence_max))
    yield OK, f"{low} to {high} in map; all vehicles are inside"


def _budget(bridge: Bridge) -> Lines:
    loads, overload_level = bridge.settings.loads, WARN if bridge.settings.station.force_budget else FAIL
    for load in loads:
        yield OK if load.fits else overload_level, str(load)
    for name, dongle in sorted(bridge.radios.dongles.items()):
        if dongle.foreign:
            yield WARN, f"radio {name}: packets are repeated: another transmitter uses its channel"
    if not loads:
        yield OK, "no radios (udp, usb)"
