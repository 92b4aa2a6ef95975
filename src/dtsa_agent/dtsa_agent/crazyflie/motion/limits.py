"""What is not flown although it could be: places outside the geofence, too fast commands, too short durations.

The firmware's high-level commander flies polynomials of degree 7 from rest to rest, whatever the duration. If it is too
short, the vehicle lags behind its path, and a landing stops the motors at the end of the path, wherever the vehicle is.
"""

from __future__ import annotations

import math

from dtsa_agent.crazyflie.settings import StationSettings
from dtsa_agent.crazyflie.state.conversions import (
    FULL_STATE,
    POSITION,
    VELOCITY_WORLD,
    Setpoint,
    Vector,
    outside_by,
    place_text,
    to_map,
)

PEAK = 35 / 16  # largest over mean speed of such a polynomial, at its middle
SHORTEST_S = 0.1  # of any path, however short
MIN_LAND_S = 1.0


def outside_fence(place: Vector, station: StationSettings) -> str:
    """How a place (m, world) is outside the geofence; empty if it is not, or if there is no fence."""
    fence = station.safety
    if not fence.geofence:
        return ""
    here = to_map(place, station.room_origin_in_world)
    for away, axis in outside_by(here, fence.geofence_min, fence.geofence_max):
        if away > fence.geofence_tolerance_m:
            return f"{place_text(here)} is {away:.2f} m outside the geofence in {axis}"
    return ""


def check_stream(setpoint: Setpoint, station: StationSettings) -> None:
    """Refuse a streamed command that leads out of the room, or is too fast.

    :raises ValueError: why it is refused.
    """
    place, velocity = _place_and_velocity(setpoint)
    speed, limit = math.hypot(*velocity), station.max_stream_mps
    if speed > limit:
        raise ValueError(f"a command with {speed:.2f} m/s is refused (station.max_stream_mps is {limit:g})")
    if place is not None and (problem := outside_fence(place, station)):
        raise ValueError(f"a command to {problem} is refused")


def _place_and_velocity(setpoint: Setpoint) -> tuple[Vector | None, tuple[float, ...]]:
    """Where (m, world) and how fast (m/s) a command leads."""
    a = setpoint.arguments
    if setpoint.kind == POSITION:
        return (a[0], a[1], a[2]), ()  # type: ignore[return-value]
    if setpoint.kind == VELOCITY_WORLD:
        return None, (a[0], a[1], a[2])  # type: ignore[return-value]
    if setpoint.kind == FULL_STATE:
        return a[0], a[1]  # type: ignore[return-value]
    return None, ()


def shortest_s(distance: float, limit: float) -> float:
    """Shortest duration (s) of a path (m) from rest to rest with a largest speed of `limit` (m/s)."""
    return max(SHORTEST_S, PEAK * abs(distance) / limit)


def too_short(duration: float, distance: float, limit: float) -> str:
    """Why a duration (s) is too short for a distance (m) at a largest speed of `limit` (m/s); empty if it is not."""
    needed = shortest_s(distance, limit)
    if duration >= needed:
        return ""
    return (
        f"duration {duration:.2f} s is too short for {abs(distance):.2f} m: "
        f"at least {needed:.2f} s (station.max_speed_mps is {limit:g})"
    )


def landing_s(distance: float, wanted: float, station: StationSettings) -> float:
    """Duration (s) of a landing over a distance (m): as wanted (0: at the station's speed), or longer if too short."""
    seconds = wanted if wanted > 0.0 else max(MIN_LAND_S, abs(distance) / station.land_speed_mps)
    return max(seconds, shortest_s(distance, station.max_speed_mps))
