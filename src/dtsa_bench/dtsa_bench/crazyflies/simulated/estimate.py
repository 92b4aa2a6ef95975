"""What the Crazyflie's estimator says about it: the true state with noise, as the values of its log variables."""

from __future__ import annotations

import math
from dataclasses import dataclass

from .crtp import LOG_ENTRIES
from .firmware import Firmware
from .planner import IDLE, Triple

GRAVITY = 9.81
VARIANCE_RESET = 1.0  # m^2, right after the estimator was reset
VARIANCE_REST = 2e-5  # m^2, once it has converged
CONVERGE_S = 0.08  # s, time constant
LOW_V = 3.2
RSSI = 42  # -dBm
_NAMES = [entry.full_name for entry in LOG_ENTRIES]


@dataclass(slots=True)
class Estimate:
    """One vehicle's state as its own estimator sees it: decks measure its position. Times (`t`) are s, the fleet's."""

    position: Triple = (0.0, 0.0, 0.0)  # m, world (z = 0 is the floor)
    velocity: Triple = (0.0, 0.0, 0.0)  # m/s
    acceleration: Triple = (0.0, 0.0, 0.0)  # m/s^2
    reset_time: float = -1e9  # s, when the estimator was reset
    offset: Triple = (0.0, 0.0, 0.0)  # m: a fault, so far it is from the truth
    frozen: bool = False  # a fault: it does not change any more

    def update(self, position: Triple, velocity: Triple, acceleration: Triple) -> None:
        """The filter's new state (m, m/s, m/s^2, world), unless a fault is in the way."""
        if not self.frozen:
            x, y, z = (p + o for p, o in zip(position, self.offset, strict=True))
            self.position, self.velocity, self.acceleration = (x, y, z), velocity, acceleration

    def correct(self, place: Triple, deviation: float) -> None:
        """A position from outside (m, world, with its standard deviation): decks know better."""

    def reset(self, t: float, place: Triple) -> None:
        """The estimator is restarted at a place (m, world)."""
        self.reset_time = t

    def variance(self, t: float) -> float:
        """Variance of the position in m^2: large after a reset, then small."""
        return VARIANCE_REST + VARIANCE_RESET * math.exp(-(t - self.reset_time) / CONVERGE_S)


def attitude(acceleration: Triple, yaw: float) -> tuple[float, float]:
    """Roll and pitch (rad, REP-103) of a quadcopter with this acceleration (m/s^2, world) and heading (rad)."""
    ax, ay, az = acceleration
    c, s = math.cos(yaw), math.sin(yaw)
    forward, left, up = c * ax + s * ay, -s * ax + c * ay, max(az + GRAVITY, 1.0)
    return -math.atan2(left, math.hypot(up, forward)), math.atan2(forward, up)


def quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """Quaternion (x, y, z, w) of Euler angles in rad (REP-103)."""
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def compress(q: tuple[float, float, float, float]) -> int:
    """The firmware's 32 bits of a unit quaternion (x, y, z, w): index of the largest, then the others."""
    largest = max(range(4), key=lambda i: abs(q[i]))
    negate = q[largest] < 0
    bits = largest
    for i in range(4):
        if i != largest:
            size = min(511, int(511 * abs(q[i]) * math.sqrt(2) + 0.5))
            bits = bits << 10 | ((q[i] < 0) != negate) << 9 | size
    return bits


def log_values(estimate: Estimate, firmware: Firmware, t: float) -> dict[str, float]:
    """All log variables at time t, by their full names, in the firmware's units."""
    roll, pitch = attitude(estimate.acceleration, firmware.yaw)
    supervisor, battery, setpoint = firmware.supervisor, firmware.battery, firmware.setpoint
    info = supervisor.info(
        planner_active=firmware.planner.state != IDLE, trajectory_finished=firmware.planner.finished(t)
    )
    values = (  # in the order of LOG_ENTRIES
        *(1000 * v for v in (*estimate.position, *estimate.velocity)),
        compress(quaternion(roll, pitch, firmware.yaw)),
        *(0.0, 0.0, 1000 * setpoint.yaw_rate if setpoint is not None else 0.0),
        *estimate.position,
        *estimate.velocity,
        # The firmware's log shows pitch with the opposite sign.
        *map(math.degrees, (roll, -pitch, firmware.yaw)),
        *(battery.voltage * 1000, battery.voltage),
        3 if battery.voltage < LOW_V else 0,
        min(100, max(0, battery.charge * 100)),
        info,
        *(supervisor.motors_allowed, supervisor.flying, supervisor.tumbled),
        *(estimate.variance(t),) * 3,
        RSSI,
    )
    return dict(zip(_NAMES, values, strict=True))
