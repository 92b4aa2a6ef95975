"""The Crazyflie's Kalman filter when positions come from outside: nothing is known but what the host sends.

One axis like the other: position and velocity, driven by the measured acceleration, corrected by positions. As in the
firmware (kalman_core.c) variances grow to 100 m^2 and no further while nothing comes.
"""

from __future__ import annotations

from .planner import Triple

INITIAL_M2 = 100.0  # variance of the place after a reset
INITIAL_MPS2 = 1e-4  # ... and of the velocity
CAP = 100.0  # m^2, MAX_COVARIANCE
ACCELERATION_NOISE = 0.5  # m/s^2, as the filter assumes it


class PositionFilter:
    """State of one vehicle as its filter sees it."""

    def __init__(self) -> None:
        self.reset((0.0, 0.0, 0.0))

    def reset(self, place: Triple) -> None:
        """Begin anew at a place (m, world), which is not known well."""
        self.position: Triple = place
        self.velocity: Triple = (0.0, 0.0, 0.0)
        self.variance = INITIAL_M2
        self._cross = 0.0
        self._speed = INITIAL_MPS2

    def predict(self, dt: float, acceleration: Triple) -> None:
        """One step by the accelerometer.

        :param dt: s.
        :param acceleration: m/s^2, world, without gravity.
        """
        p, v, a = self.position, self.velocity, acceleration
        self.position = (p[0] + v[0] * dt, p[1] + v[1] * dt, p[2] + v[2] * dt)
        self.velocity = (v[0] + a[0] * dt, v[1] + a[1] * dt, v[2] + a[2] * dt)
        noise = (ACCELERATION_NOISE * dt) ** 2
        self.variance = min(CAP, self.variance + dt * (2 * self._cross + dt * self._speed))
        self._cross += dt * self._speed
        self._speed = min(CAP, self._speed + noise)
        self._cross = min(self._cross, (self.variance * self._speed) ** 0.5)

    def correct(self, place: Triple, deviation: float) -> None:
        """A position from outside.

        :param place: m, world.
        :param deviation: m, its standard deviation.
        """
        total = self.variance + deviation * deviation
        gain, speed_gain = self.variance / total, self._cross / total
        p, v = self.position, self.velocity
        e = (place[0] - p[0], place[1] - p[1], place[2] - p[2])
        self.position = (p[0] + gain * e[0], p[1] + gain * e[1], p[2] + gain * e[2])
        self.velocity = (v[0] + speed_gain * e[0], v[1] + speed_gain * e[1], v[2] + speed_gain * e[2])
        self._speed -= speed_gain * self._cross
        self._cross *= 1.0 - gain
        self.variance *= 1.0 - gain
