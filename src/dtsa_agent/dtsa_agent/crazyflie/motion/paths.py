"""How long the firmware's high-level commander needs for a path that it can follow.

It flies polynomials of degree 7 from rest to rest, whatever the duration. If one is too short, the vehicle lags behind
its path, and a landing stops the motors at the end of the path, wherever the vehicle is by then.
"""

from __future__ import annotations

from dtsa_agent.crazyflie.settings.config import StationSettings

PEAK = 35 / 16  # largest over mean speed of such a polynomial, at its middle
SHORTEST_S = 0.1  # of any path, however short
MIN_LAND_S = 1.0


def shortest_s(distance: float, limit: float) -> float:
    """Shortest duration (s) of a path from rest to rest.

    :param distance: m.
    :param limit: largest speed on it, m/s.
    """
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
    """Duration (s) of a landing.

    :param distance: m, how far down.
    :param wanted: s; 0: at the station's landing speed. One that is too short is made longer.
    """
    seconds = wanted if wanted > 0.0 else max(MIN_LAND_S, abs(distance) / station.land_speed_mps)
    return max(seconds, shortest_s(distance, station.max_speed_mps))
