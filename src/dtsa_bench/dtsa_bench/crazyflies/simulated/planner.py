"""The firmware's high-level commander: smooth paths between two states of rest."""

from __future__ import annotations

import math
from dataclasses import dataclass

Triple = tuple[float, float, float]

# States of the planner, as the firmware names them.
IDLE = "idle"  # holds the motors off: nothing was ordered yet, a landing is over, or a streamed command took over
FLYING = "flying"
LANDING = "landing"
DISABLED = "disabled"  # neither wants motors on nor off: another source gives set-points


@dataclass(frozen=True, slots=True)
class Goal:
    """Where the planner wants a vehicle to be, or where it was last."""

    position: Triple = (0.0, 0.0, 0.0)  # m
    velocity: Triple = (0.0, 0.0, 0.0)  # m/s
    acceleration: Triple = (0.0, 0.0, 0.0)  # m/s^2
    yaw: float = 0.0  # rad


def septic(p0: float, v0: float, a0: float, p1: float, duration: float) -> tuple[float, ...]:
    """Coefficients (constant first) of the polynomial of degree 7 from (p0, v0, a0) to rest at p1 within a duration.

    Jerk is zero at both ends, acceleration at the end. Without a duration the end is reached at once.
    """
    t = duration
    if t <= 0.0:
        return (p1,)
    d, v, a = p1 - p0, v0 * t, a0 * t * t
    return (
        p0,
        v0,
        a0 / 2,
        0.0,
        (35 * d - 20 * v - 5 * a) / t**4,
        (-84 * d + 45 * v + 10 * a) / t**5,
        (70 * d - 36 * v - 7.5 * a) / t**6,
        (-20 * d + 10 * v + 2 * a) / t**7,
    )


def evaluate(coefficients: tuple[float, ...], t: float) -> Triple:
    """Value, first and second derivative of a polynomial at t."""
    value = speed = acceleration = 0.0
    for c in reversed(coefficients):  # Horner's scheme for the value and two derivatives at once
        acceleration = acceleration * t + 2 * speed
        speed = speed * t + value
        value = value * t + c
    return value, speed, acceleration


class Planner:
    """Paths between high-level commands. Times (`t`) are s by the fleet's clock; yaw is in rad, world."""

    def __init__(self) -> None:
        self.state = IDLE
        self._start = self._end_time = -math.inf  # s
        self._axes: tuple[tuple[float, ...], ...] = ()  # x, y, z
        self._end = Goal()

    def plan(self, state: str, t: float, here: Goal, place: Triple, yaw: float, duration: float) -> None:
        """Fly from here to a place within `duration` (s), beginning with speed and acceleration as they are."""
        starts = zip(here.position, here.velocity, here.acceleration, place, strict=True)
        self._axes = tuple(septic(p, v, a, end, duration) for p, v, a, end in starts)
        self.state, self._start, self._end_time, self._end = state, t, t + duration, Goal(place, yaw=yaw)

    def finished(self, t: float) -> bool:
        """True once the last path has been flown (or there is none)."""
        return t >= self._end_time

    def goal(self, t: float) -> Goal | None:
        """What to hold now; None while idle, which a landing that is over makes it."""
        if self.state == LANDING and self.finished(t):
            self.state = IDLE
        if self.state in (IDLE, DISABLED):
            return None
        if self.finished(t):
            return self._end
        x, y, z = (evaluate(axis, t - self._start) for axis in self._axes)
        return Goal((x[0], y[0], z[0]), (x[1], y[1], z[1]), (x[2], y[2], z[2]), self._end.yaw)
