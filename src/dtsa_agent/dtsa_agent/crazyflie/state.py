"""State reports of a Crazyflie in ROS's units (REP-103: m, rad, x forward, y left, z up), and its state machine.

    disconnected --> connecting --> ready <--> armed --> flying --> landing --> ready
                                      |          |         |           |
                                      +----------+---------+-----------+--> lost       (silent for too long)
                                      +----------+---------+-----------+--> emergency  (motors stopped for good)

Reports of the firmware's supervisor decide between ready, armed and flying; orders decide about landing. A Crazyflie
that arms itself (2.1, 2.1+) is ready until the ground station orders it to arm, and again once it has landed. `lost`
ends with the next packet from the Crazyflie, `emergency` only with a new connection.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # x, y, z, w

# All fit in one log block: 20 of at most 26 bytes.
LOG_VARIABLES = (
    *(f"stateEstimateZ.{name}" for name in ("x", "y", "z", "vx", "vy", "vz", "quat")), "pm.vbatMV", "supervisor.info",
)  # fmt: skip


class VehicleState(NamedTuple):
    """One state report of a Crazyflie."""

    position: Vector  # m, world
    velocity: Vector  # m/s, world
    orientation: Quaternion  # body to world
    battery: float  # V
    info: int  # bits of the firmware's supervisor


def decode_log(values: Mapping[str, float]) -> VehicleState:
    """Return the state report in one log packet; values by the names in `LOG_VARIABLES`, in the firmware's units."""
    x, y, z, vx, vy, vz, quaternion, millivolt, info = (values[name] for name in LOG_VARIABLES)
    place, velocity = (x * 0.001, y * 0.001, z * 0.001), (vx * 0.001, vy * 0.001, vz * 0.001)
    return VehicleState(place, velocity, decompress_quaternion(int(quaternion)), millivolt * 0.001, int(info))


def decompress_quaternion(bits: int) -> Quaternion:
    """Return the unit quaternion (x, y, z, w) in the firmware's 32 bits (quatcompress.h).

    The upper two bits are the index of the largest component, which is positive and follows from the others. Each of
    these has ten bits: the sign, then the magnitude in 511ths of 1/sqrt(2).
    """
    largest = bits >> 30
    q = [0.0, 0.0, 0.0, 0.0]
    remainder = 1.0
    for i in (3, 2, 1, 0):
        if i != largest:
            value = (bits & 511) * (math.sqrt(0.5) / 511)
            q[i] = -value if bits & 512 else value
            remainder -= value * value
            bits >>= 10
    q[largest] = math.sqrt(max(remainder, 0.0))
    return q[0], q[1], q[2], q[3]


def yaw_of(q: Quaternion) -> float:
    """Return the heading (rad) of an orientation (x, y, z, w)."""
    x, y, z, w = q
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def to_world(place: Vector, origin: Vector) -> Vector:
    """Convert from frame `map` (the room's centre) to the Crazyflies' world, in which `map` begins at `origin`."""
    return place[0] + origin[0], place[1] + origin[1], place[2] + origin[2]


def to_map(place: Vector, origin: Vector) -> Vector:
    """Convert from the Crazyflies' world to frame `map`; the inverse of `to_world`."""
    return place[0] - origin[0], place[1] - origin[1], place[2] - origin[2]


def outside_by(place: Vector, low: Vector, high: Vector) -> list[tuple[float, str]]:
    """Return how far a place is outside a box along each axis, m (negative: inside), with the axis's name."""
    return [(max(a - p, p - b), axis) for p, a, b, axis in zip(place, low, high, "xyz", strict=True)]


def place_text(place: Vector) -> str:
    """Format a place (m) to the centimetre."""
    return "(" + ", ".join(f"{round(v, 2) + 0.0:.2f}" for v in place) + ")"  # no -0.00


def rotate_inverse(q: Quaternion, v: Vector) -> Vector:
    """Rotate a vector from world axes to the axes of a body with this orientation."""
    x, y, z, w = -q[0], -q[1], -q[2], q[3]
    tx, ty, tz = 2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])
    return (v[0] + w * tx + y * tz - z * ty, v[1] + w * ty + z * tx - x * tz, v[2] + w * tz + x * ty - y * tx)


CAN_BE_ARMED, IS_ARMED, AUTO_ARM, CAN_FLY, IS_FLYING = 1, 2, 4, 8, 16
IS_TUMBLED, IS_LOCKED, IS_CRASHED = 32, 64, 128
HL_ACTIVE = 256  # the high-level commander flies a trajectory


class State(enum.IntEnum):
    """State of one Crazyflie; the numbers are those of dtsa_msgs/Status."""

    DISCONNECTED = 0
    CONNECTING = 1
    READY = 2
    ARMED = 3
    FLYING = 4
    LANDING = 5
    EMERGENCY = 6
    LOST = 7


CONNECTED = frozenset({State.READY, State.ARMED, State.FLYING, State.LANDING, State.EMERGENCY})
IN_AIR = frozenset({State.FLYING, State.LANDING})
OFF = frozenset({State.DISCONNECTED, State.CONNECTING})
WATCHED = frozenset({State.ARMED, *IN_AIR})


class StateMachine:
    """State of one Crazyflie; `on_change` is called with the state before, the state now and the reason for it."""

    def __init__(self, on_change: Callable[[State, State, str], None]) -> None:
        self.state = State.DISCONNECTED
        self.reason = "not connected yet"
        self._on_change = on_change
        self.arms_itself = False  # reported by the firmware
        self.arming_ordered = False  # whether one that arms itself counts as armed
        self._landing = False  # a landing was ordered and is not over
        self._stopped = False  # an emergency stop was sent

    def enter(self, state: State, reason: str) -> None:
        if state == self.state:
            return
        before, self.state, self.reason = self.state, state, reason
        if state in OFF:
            self._landing = self._stopped = self.arming_ordered = False
        self._on_change(before, state, reason)

    def note_takeoff(self, reason: str) -> None:
        """Note that a take-off was ordered: an earlier landing is over."""
        self._landing = False
        if self.state == State.LANDING:
            self.enter(State.FLYING, reason)
        self.reason = reason

    def note_landing(self, reason: str) -> None:
        self._landing = True
        if self.state in (State.FLYING, State.ARMED, State.READY):
            self.enter(State.LANDING, reason)

    def note_emergency_stop(self, reason: str) -> None:
        self._stopped = True
        if self.state not in OFF:
            self.enter(State.EMERGENCY, reason)

    def note_lost_link(self, reason: str) -> None:
        if self.state in CONNECTED:
            self.enter(State.LOST, reason)

    def update(self, info: int) -> None:
        """Enter the state that the supervisor's bits in a log packet show."""
        if self.state in (State.DISCONNECTED, State.EMERGENCY):
            return
        troubles = (IS_LOCKED, "locked after an emergency stop"), (IS_TUMBLED, "tumbled"), (IS_CRASHED, "crashed")
        reasons = [reason for bit, reason in troubles if info & bit]
        if reasons or self._stopped:
            self.enter(State.EMERGENCY, reasons[0] if reasons else self.reason)
            return
        self.arms_itself = bool(info & AUTO_ARM)
        reason = "heard again" if self.state == State.LOST else ""
        if info & IS_FLYING:
            if not self._landing:
                self.enter(State.FLYING, reason or "in the air")
            elif self.state != State.LANDING:
                self.enter(State.LANDING, reason or self.reason)
            return
        if self.state == State.LANDING or (self.state == State.LOST and self._landing):
            reason = "landed"
        if self.state in IN_AIR or self._landing:
            self.arming_ordered = False
        self._landing = False
        if self.arming_ordered if self.arms_itself else info & IS_ARMED:
            self.enter(State.ARMED, reason or "armed")
        else:
            self.enter(State.READY, reason or "motors locked")
