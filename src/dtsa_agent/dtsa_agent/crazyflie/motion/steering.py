"""A person steers a vehicle by velocities along its heading: not too fast, and not into the walls. Pure."""

from __future__ import annotations

import math

from dtsa_agent.crazyflie.settings.config import StationSettings
from dtsa_agent.crazyflie.state.conversions import Setpoint, Vector, VehicleState, velocity_world, yaw_of

from .limits import room_of

BRAKING_MPS2 = 0.6  # it always can stop before a wall with that
WALL_M = 0.15  # this far inside the geofence
FLOOR_M = 0.3  # nobody is steered lower than this: it is landed by an order
TURN_RADPS = 2.0


def steered(velocity: Vector, yaw_rate: float, state: VehicleState, station: StationSettings, stamp: float) -> Setpoint:
    """The command for a wanted velocity.

    :param velocity: m/s, forward, left and up, as the vehicle's heading is.
    :param yaw_rate: rad/s, counter-clockwise.
    :param state: what the vehicle has reported last.
    :param station: largest speed (`max_speed_mps`) and geofence.
    :param stamp: s, monotonic.
    :raises ValueError: a number is not finite.
    """
    forward, left, up = velocity
    if not all(math.isfinite(v) for v in (forward, left, up, yaw_rate)):
        raise ValueError("a command with a number that is not finite")
    heading = yaw_of(state.orientation)
    c, s = math.cos(heading), math.sin(heading)
    wanted = (c * forward - s * left, s * forward + c * left, up)
    speed = math.hypot(*wanted)
    share = min(1.0, station.max_speed_mps / speed) if speed else 0.0
    low, high = room_of(station)
    low = low[0] + WALL_M, low[1] + WALL_M, max(low[2] + WALL_M, FLOOR_M)
    x, y, z = (
        _slowed(share * v, (b - WALL_M) - p if v > 0.0 else p - a)
        for v, p, a, b in zip(wanted, state.position, low, high, strict=True)
    )
    return velocity_world((x, y, z), min(TURN_RADPS, max(-TURN_RADPS, yaw_rate)), stamp)


def _slowed(v: float, room: float) -> float:
    """A velocity (m/s) from which it can stop within some room (m)."""
    return math.copysign(min(abs(v), math.sqrt(2.0 * BRAKING_MPS2 * max(room, 0.0))), v)
