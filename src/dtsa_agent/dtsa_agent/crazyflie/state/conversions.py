"""All conversions between ROS (REP-103: m, rad, x forward, y left, z up) and the Crazyflie's firmware, in one place.

What the firmware does differently: the compressed state log counts in mm, mm/s and mrad/s; pitch in
`stateEstimate.pitch` has the opposite sign (nose up is positive there, nose down in REP-103); yaw and yaw rate of
streamed setpoints are in degrees, of high-level commands in rad; a full-state setpoint carries 16 bit numbers, so
positions beyond 32.767 m overflow, and its rates are in rad/s although the library says degrees.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # x, y, z, w

VELOCITY_WORLD, POSITION, FULL_STATE = "velocity_world", "position", "full_state"
FULL_STATE_LIMIT = 32.767  # m, m/s, m/s^2, rad/s: 16 bit numbers in thousandths

# One log block of 20 bytes has everything; a block may have 26.
LOG_VARIABLES = (
    "stateEstimateZ.x",
    "stateEstimateZ.y",
    "stateEstimateZ.z",
    "stateEstimateZ.vx",
    "stateEstimateZ.vy",
    "stateEstimateZ.vz",
    "stateEstimateZ.quat",
    "pm.vbatMV",
    "supervisor.info",
)
LOG_BYTES = 20


@dataclass(frozen=True, slots=True)
class VehicleState:
    """What a Crazyflie reports about itself."""

    position: Vector  # m, world
    velocity: Vector  # m/s, world
    orientation: Quaternion  # body to world
    battery: float  # V
    info: int  # bits of the firmware's supervisor


def decode_log(values: Mapping[str, float]) -> VehicleState:
    """State from the values of one log packet.

    :param values: by the names in `LOG_VARIABLES`, in the firmware's units.
    """
    x, y, z, vx, vy, vz, quaternion, millivolt, info = (values[name] for name in LOG_VARIABLES)
    return VehicleState(
        (x * 0.001, y * 0.001, z * 0.001),
        (vx * 0.001, vy * 0.001, vz * 0.001),
        decompress_quaternion(int(quaternion)),
        millivolt * 0.001,
        int(info),
    )


def decompress_quaternion(bits: int) -> Quaternion:
    """Unit quaternion (x, y, z, w) from the firmware's 32 bits (quatcompress.h).

    The upper two bits say which component is the largest; it is positive and follows from the others, which take ten
    bits each: sign, then the size in 511ths of 1/sqrt(2).
    """
    largest = bits >> 30
    q = [0.0, 0.0, 0.0, 0.0]
    rest = 1.0
    for i in (3, 2, 1, 0):
        if i != largest:
            value = (bits & 511) * (math.sqrt(0.5) / 511)
            q[i] = -value if bits & 512 else value
            rest -= value * value
            bits >>= 10
    q[largest] = math.sqrt(max(rest, 0.0))
    return q[0], q[1], q[2], q[3]


def yaw_of(q: Quaternion) -> float:
    """Heading (rad) of an orientation (x, y, z, w)."""
    x, y, z, w = q
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


@dataclass(frozen=True, slots=True)
class Setpoint:
    """One streamed command, ready for the radio: a method of cflib's commander and its arguments."""

    kind: str  # velocity_world, position or full_state
    arguments: tuple[object, ...]
    stamp: float  # s, monotonic time at which it came in


def velocity_world(velocity: Vector, yaw_rate: float, stamp: float) -> Setpoint:
    """Velocity in m/s along the world's axes, yaw rate in rad/s -> the firmware's degrees per second.

    :param velocity: (3,) m/s, world.
    :param yaw_rate: rad/s.
    :param stamp: s, monotonic, of the command.
    """
    return Setpoint(VELOCITY_WORLD, (*_finite(velocity), math.degrees(*_finite((yaw_rate,)))), stamp)


def position(place: Vector, yaw: float, stamp: float) -> Setpoint:
    """Place in m (world), yaw in rad -> the firmware's degrees.

    :param stamp: s, monotonic, of the command.
    """
    return Setpoint(POSITION, (*_finite(place), math.degrees(*_finite((yaw,)))), stamp)


def full_state(
    place: Vector, velocity: Vector, acceleration: Vector, orientation: Quaternion, rates: Vector, stamp: float
) -> Setpoint:
    """Position m, velocity m/s, acceleration m/s^2 (world), attitude (x, y, z, w), body rates rad/s (REP-103).

    Numbers beyond what the packet's 16 bits can say are kept at their limit: an overflow would send the Crazyflie the
    other way. An orientation of length zero (an unset message) means level, heading along x.

    :param stamp: s, monotonic, of the command.
    """
    vectors = [tuple(_saturate(v) for v in _finite(vector)) for vector in (place, velocity, acceleration)]
    roll_rate, pitch_rate, yaw_rate = (_saturate(v) for v in _finite(rates))
    q = _finite(orientation)
    norm = math.sqrt(sum(c * c for c in q))
    q = tuple(c / norm for c in q) if norm > 1e-6 else (0.0, 0.0, 0.0, 1.0)
    return Setpoint(FULL_STATE, (*vectors, q, roll_rate, pitch_rate, yaw_rate), stamp)


def _saturate(value: float) -> float:
    return min(FULL_STATE_LIMIT, max(-FULL_STATE_LIMIT, value))


def _finite(values: tuple[float, ...]) -> tuple[float, ...]:
    if not all(math.isfinite(v) for v in values):
        raise ValueError("a command with a number that is not finite")
    return values


def to_world(place: Vector, origin: Vector) -> Vector:
    """From the frame `map` (the room's centre) to the Crazyflies' own world.

    :param origin: m, where the world sees the origin of `map`.
    """
    return place[0] + origin[0], place[1] + origin[1], place[2] + origin[2]


def to_map(place: Vector, origin: Vector) -> Vector:
    """From the Crazyflies' own world to the frame `map`; the inverse of `to_world`.

    :param origin: (3,) m, world, where the map's origin is.
    """
    return place[0] - origin[0], place[1] - origin[1], place[2] - origin[2]


def outside_by(place: Vector, low: Vector, high: Vector) -> list[tuple[float, str]]:
    """How far a place is outside a box along each axis, m (negative: inside), with the axis's name.

    :param low: lower corner, m, same frame. :param high: m, upper corner.
    """
    return [(max(a - p, p - b), axis) for p, a, b, axis in zip(place, low, high, "xyz", strict=True)]


def place_text(place: Vector) -> str:
    """A place (m) for people."""
    return "(" + ", ".join(f"{round(v, 2) + 0.0:.2f}" for v in place) + ")"  # no -0.00


def rotate_inverse(q: Quaternion, v: Vector) -> Vector:
    """A vector of the world as the body sees it.

    :param q: orientation of the body (x, y, z, w). :param v: (3,) any vector, in the world's axes.
    """
    x, y, z, w = -q[0], -q[1], -q[2], q[3]
    tx, ty, tz = 2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])
    return (
        v[0] + w * tx + y * tz - z * ty,
        v[1] + w * ty + z * tx - x * tz,
        v[2] + w * tz + x * ty - y * tx,
    )


def rotate(q: Quaternion, v: Vector) -> Vector:
    """A vector of the body as the world sees it; the inverse of `rotate_inverse`.

    :param q: orientation of the body (x, y, z, w). :param v: (3,) any vector, in the body's axes.
    """
    return rotate_inverse((-q[0], -q[1], -q[2], q[3]), v)
