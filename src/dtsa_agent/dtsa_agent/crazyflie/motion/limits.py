"""What is not flown although it could be: places outside the geofence, speeds that nobody means."""

from __future__ import annotations

import math

from dtsa_agent.crazyflie.settings.config import StationSettings
from dtsa_agent.crazyflie.state.conversions import (
    FULL_STATE,
    HOVER,
    POSITION,
    VELOCITY_WORLD,
    Setpoint,
    Vector,
    outside_by,
    place_text,
    to_map,
    to_world,
)  # fmt: skip


def outside_fence(place: Vector, station: StationSettings) -> str:
    """How a place is outside the geofence; empty if it is not, or if there is no fence.

    :param place: m, world.
    :param station: fence, tolerance, and where the room is.
    """
    fence = station.safety
    if not fence.geofence:
        return ""
    here = to_map(place, station.room_origin_in_world)
    for away, axis in outside_by(here, fence.geofence_min, fence.geofence_max):
        if away > fence.geofence_tolerance_m:
            return f"{place_text(here)} is {away:.2f} m outside the geofence in {axis}"
    return ""


def room_of(station: StationSettings) -> tuple[Vector, Vector]:
    """Lower and upper corner of the room, m, world; infinite without a geofence.

    :param station: fence, and where the room is.
    """
    fence, origin = station.safety, station.room_origin_in_world
    if not fence.geofence:
        return (-math.inf, -math.inf, -math.inf), (math.inf, math.inf, math.inf)
    return to_world(fence.geofence_min, origin), to_world(fence.geofence_max, origin)


def check_stream(setpoint: Setpoint, station: StationSettings) -> None:
    """Refuse a streamed command that leads out of the room, or is too fast.

    :param setpoint: the command, in the firmware's units.
    :raises ValueError: why it is refused.
    """
    place, velocity = _place_and_velocity(setpoint, station)
    speed, limit = math.hypot(*velocity), station.max_stream_mps
    if speed > limit:
        raise ValueError(f"a command with {speed:.2f} m/s is refused (station.max_stream_mps is {limit:g})")
    if place is not None and (problem := outside_fence(place, station)):
        raise ValueError(f"a command to {problem} is refused")


def _place_and_velocity(setpoint: Setpoint, station: StationSettings) -> tuple[Vector | None, tuple[float, ...]]:
    """Where (m, world) and how fast (m/s) a command leads."""
    a = setpoint.arguments
    if setpoint.kind == POSITION:
        return (a[0], a[1], a[2]), ()  # type: ignore[return-value]
    if setpoint.kind == VELOCITY_WORLD:
        return None, (a[0], a[1], a[2])  # type: ignore[return-value]
    if setpoint.kind == HOVER:
        x, y, _ = station.room_origin_in_world
        return (x, y, a[3]), (a[0], a[1])  # type: ignore[return-value]
    if setpoint.kind == FULL_STATE:
        return a[0], a[1]  # type: ignore[return-value]
    return None, ()
