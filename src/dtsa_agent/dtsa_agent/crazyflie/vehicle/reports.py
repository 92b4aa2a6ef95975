"""What is told of one vehicle: to the safety rules, and to those who watch."""

from __future__ import annotations

import math

from dtsa_agent.crazyflie.safety.rules import Watched
from dtsa_agent.crazyflie.state.conversions import to_map

from .known_state import QUALITY_WINDOW_S
from .snapshot import Snapshot
from .vehicle import Vehicle


def watched(vehicle: Vehicle, now: float) -> Watched:
    """What the safety rules need.

    :param now: s, monotonic.
    """
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
            battery.voltage_warning,
            battery.voltage_critical,
            vehicle.log_age(now),
            None if known.wrong else vehicle.controls.led_for(now),
            known.unseen_s(now),
            known.wrong,
            known.wrong_s(now),
        )


def snapshot(vehicle: Vehicle, now: float) -> Snapshot:
    """Everything for the status.

    :param now: s, monotonic.
    """
    with vehicle.lock:
        link, quality = vehicle.link, vehicle.known.logged(now)
        if link.radio_quality is not None:
            quality = min(quality, link.radio_quality)
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
            link.outbox.replaced,
            delays[int(0.99 * (len(delays) - 1))] if delays else 0.0,
            len(sends) / QUALITY_WINDOW_S,
            vehicle.known.captured(now),
        )
