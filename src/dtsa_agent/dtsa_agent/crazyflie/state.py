"""What a Crazyflie reports, in ROS's units (REP-103: m, rad, x forward, y left, z up), and the states it goes through.

What the firmware does differently: the compressed state log counts in mm, mm/s and mrad/s; pitch in
`stateEstimate.pitch` has the opposite sign (nose up is positive there, nose down in REP-103). Commands to it are
converted in `commands`.

The states, as the ground station sees them:

    disconnected --> connecting --> ready <--> armed --> flying --> landing --> ready
                                      |          |         |           |
                                      +----------+---------+-----------+--> lost       (silent for too long)
                                      +----------+---------+-----------+--> emergency  (motors stopped for good)

What the firmware's supervisor reports decides between ready, armed and flying; orders decide about landing. A Crazyflie
that arms itself (2.1, 2.1+) is ready until the ground station orders to arm it, and again once it has landed. `lost`
ends when the Crazyflie is heard again, `emergency` only with a new connection.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from dtsa_agent.core.errors import LocalProtocolError

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # x, y, z, w

# One log block of 20 bytes has everything; a block may have 26.
LOG_VARIABLES = (
    *(f"stateEstimateZ.{name}" for name in ("x", "y", "z", "vx", "vy", "vz", "quat")), "pm.vbatMV", "supervisor.info",
)  # fmt: skip


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
    place, velocity = (x * 0.001, y * 0.001, z * 0.001), (vx * 0.001, vy * 0.001, vz * 0.001)
    return VehicleState(place, velocity, decompress_quaternion(int(quaternion)), millivolt * 0.001, int(info))


def decompress_quaternion(bits: int) -> Quaternion:
    """Unit quaternion (x, y, z, w) from the firmware's 32 bits (quatcompress.h).

    The upper two bits say which component is the largest; it is positive and follows from the others, which take ten
    bits each: sign, then the size in 511ths of 1/sqrt(2).
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
    """Heading (rad) of an orientation (x, y, z, w)."""
    x, y, z, w = q
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def to_world(place: Vector, origin: Vector) -> Vector:
    """From the frame `map` (the room's centre) to the Crazyflies' world, which sees the origin of `map` at `origin`."""
    return place[0] + origin[0], place[1] + origin[1], place[2] + origin[2]


def to_map(place: Vector, origin: Vector) -> Vector:
    """From the Crazyflies' world to the frame `map`; the inverse of `to_world`."""
    return place[0] - origin[0], place[1] - origin[1], place[2] - origin[2]


def outside_by(place: Vector, low: Vector, high: Vector) -> list[tuple[float, str]]:
    """How far a place is outside a box along each axis, m (negative: inside), and the axis's name."""
    return [(max(a - p, p - b), axis) for p, a, b, axis in zip(place, low, high, "xyz", strict=True)]


def place_text(place: Vector) -> str:
    """A place (m) for people."""
    return "(" + ", ".join(f"{round(v, 2) + 0.0:.2f}" for v in place) + ")"  # no -0.00


def rotate_inverse(q: Quaternion, v: Vector) -> Vector:
    """Turn a vector from the world's axes into those of a body with this orientation."""
    x, y, z, w = -q[0], -q[1], -q[2], q[3]
    tx, ty, tz = 2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])
    return (v[0] + w * tx + y * tz - z * ty, v[1] + w * ty + z * tx - x * tz, v[2] + w * tz + x * ty - y * tx)


def rotate(q: Quaternion, v: Vector) -> Vector:
    """Turn a vector from the axes of a body with this orientation into the world's."""
    return rotate_inverse((-q[0], -q[1], -q[2], q[3]), v)


# -- states ---------------------------------------------------------------------------------------------------------
CAN_BE_ARMED, IS_ARMED, AUTO_ARM, CAN_FLY, IS_FLYING = 1, 2, 4, 8, 16
IS_TUMBLED, IS_LOCKED, IS_CRASHED = 32, 64, 128
HL_ACTIVE = 256  # the high-level commander has something to fly


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


S = State
CONNECTED = frozenset({S.READY, S.ARMED, S.FLYING, S.LANDING, S.EMERGENCY})
IN_AIR = frozenset({S.FLYING, S.LANDING})
ALLOWED: dict[State, frozenset[State]] = {
    S.DISCONNECTED: frozenset({S.CONNECTING}),
    S.CONNECTING: frozenset({S.READY, S.ARMED, S.FLYING, S.DISCONNECTED, S.EMERGENCY}),
    S.READY: frozenset({S.ARMED, S.FLYING, S.LANDING, S.EMERGENCY, S.LOST, S.DISCONNECTED}),
    S.ARMED: frozenset({S.READY, S.FLYING, S.LANDING, S.EMERGENCY, S.LOST, S.DISCONNECTED}),
    S.FLYING: frozenset({S.READY, S.ARMED, S.LANDING, S.EMERGENCY, S.LOST}),
    S.LANDING: frozenset({S.READY, S.ARMED, S.FLYING, S.EMERGENCY, S.LOST}),
    S.EMERGENCY: frozenset({S.LOST, S.CONNECTING, S.DISCONNECTED}),
    S.LOST: frozenset({S.READY, S.ARMED, S.FLYING, S.LANDING, S.EMERGENCY, S.CONNECTING, S.DISCONNECTED}),
}


class StateMachine:
    """State of one Crazyflie, and why it is in it.

    :param changed: called with the state before, the state now and the reason.
    """

    def __init__(self, changed: Callable[[State, State, str], None]) -> None:
        self.state = S.DISCONNECTED
        self.reason = "not connected yet"
        self._changed = changed
        self.arms_itself = False  # the firmware says so
        self._wanted = False  # the ground station wants it armed: of one that arms itself nothing else can tell
        self._landing = False  # a landing was ordered and is not over
        self._stopped = False  # an emergency stop was sent

    def go(self, state: State, reason: str) -> None:
        """Enter a state; LocalProtocolError: there is no way from the present state to that one."""
        if state == self.state:
            return
        if state not in ALLOWED[self.state]:
            raise LocalProtocolError(f"no way from {self.state.name} to {state.name}")
        before, self.state, self.reason = self.state, state, reason
        if state in (S.CONNECTING, S.DISCONNECTED):
            self._landing = self._stopped = self._wanted = False
        self._changed(before, state, reason)

    def arm(self, wanted: bool) -> None:
        """Arming or disarming was ordered."""
        self._wanted = wanted

    def takeoff(self, reason: str) -> None:
        """A take-off was ordered: an earlier landing is over."""
        self._landing = False
        if self.state == S.LANDING:
            self.go(S.FLYING, reason)
        self.reason = reason

    def land(self, reason: str) -> None:
        """A landing was ordered."""
        self._landing = True
        if self.state in (S.FLYING, S.ARMED, S.READY):
            self.go(S.LANDING, reason)

    def emergency(self, reason: str) -> None:
        """An emergency stop was ordered."""
        self._stopped = True
        if self.state not in (S.DISCONNECTED, S.CONNECTING):
            self.go(S.EMERGENCY, reason)

    def silent(self, reason: str) -> None:
        """Nothing was heard for too long, or the link broke."""
        if self.state in CONNECTED:
            self.go(S.LOST, reason)

    def observe(self, info: int) -> None:
        """Follow the supervisor's bits in a log packet."""
        if self.state in (S.DISCONNECTED, S.EMERGENCY):
            return
        troubles = (IS_LOCKED, "locked after an emergency stop"), (IS_TUMBLED, "tumbled"), (IS_CRASHED, "crashed")
        reasons = [reason for bit, reason in troubles if info & bit]
        if reasons or self._stopped:
            self.go(S.EMERGENCY, reasons[0] if reasons else self.reason)
            return
        self.arms_itself = bool(info & AUTO_ARM)
        back = "heard again" if self.state == S.LOST else ""
        if info & IS_FLYING:
            if not self._landing:
                self.go(S.FLYING, back or "in the air")
            elif self.state != S.LANDING:
                self.go(S.LANDING, back or self.reason)
            return
        if self.state == S.LANDING or (self.state == S.LOST and self._landing):
            back = "landed"
        if self.state in IN_AIR or self._landing:
            self._wanted = False
        self._landing = False
        if self._wanted if self.arms_itself else info & IS_ARMED:
            self.go(S.ARMED, back or "armed")
        else:
            self.go(S.READY, back or "motors locked")
