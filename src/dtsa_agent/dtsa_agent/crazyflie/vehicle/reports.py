"""What is reported of one vehicle: to the safety rules, and to status, diagnostics and summaries."""

from __future__ import annotations

import math
from dataclasses import dataclass

from dtsa_agent.crazyflie.positions.motion_capture import PositionNumbers
from dtsa_agent.crazyflie.safety.rules import Watched
from dtsa_agent.crazyflie.state.conversions import VehicleState, to_map
from dtsa_agent.crazyflie.state.state_machine import State

from .known_state import QUALITY_WINDOW_S
from .vehicle import Vehicle


@dataclass(frozen=True, slots=True)
class Snapshot:
    """State of one vehicle for status and diagnostics."""

    name: str
    id: int
    state: State
    reason: str
    vehicle: VehicleState | None
    log_age: float  # s; infinite before the first packet
    command_age: float  # s; infinite before the first command
    link_quality: float  # 0..1
    rssi: int
    sent: int
    received: int
    refused: int  # streamed commands that were not for this state
    replaced: int  # streamed commands that a newer one overtook
    latency_p99: float  # s; 0 before the first command
    command_hz: float
    positions: PositionNumbers | None = None  # None: there is no motion capture


def watched(vehicle: Vehicle, now: float) -> Watched:
    """What the safety rules need (now: s, monotonic)."""
    with vehicle.lock:
        known, battery, last = vehicle.known, vehicle.robot.battery, vehicle.last
        place = None if last is None else last.position
        if known.wrong:
            place = known.seen_at(now)
        return Watched(
            vehicle.name,
            vehicle.state,
            None if place is None else to_map(place, vehicle.station.room_origin_in_world),
            math.inf if last is None else last.battery,
            battery.flight_warning,
            battery.flight_landing,
            vehicle.log_age(now),
            None if known.wrong else vehicle.controls.setpoint_age(now),
            known.unseen_s(now),
            known.wrong,
            known.wrong_s(now),
        )


def snapshot(vehicle: Vehicle, now: float) -> Snapshot:
    """Everything for the status (now: s, monotonic)."""
    with vehicle.lock:
        link, quality, tracker = vehicle.link, vehicle.known.logged(now), vehicle.known.tracker
        if link.quality is not None:
            quality = min(quality, link.quality)
        delays = sorted(link.latencies.copy())
        sends = [t for t in link.send_times.copy() if now - t <= QUALITY_WINDOW_S]
        return Snapshot(
            vehicle.name,
            vehicle.robot.id,
            vehicle.state,
            vehicle.action,
            vehicle.last,
            vehicle.log_age(now),
            vehicle.controls.command_age(now),
            quality,
            link.rssi,
            link.sent,
            link.received,
            vehicle.refused,
            link.replaced,
            delays[int(0.99 * (len(delays) - 1))] if delays else 0.0,
            len(sends) / QUALITY_WINDOW_S,
            None if tracker is None else tracker.numbers(now),
        )
