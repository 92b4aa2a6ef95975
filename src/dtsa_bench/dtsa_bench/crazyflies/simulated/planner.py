"""The firmware's high-level commander: smooth paths between two states of rest."""

from __future__ import annotations

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


@dataclass(frozen=True, slots=True)
class PlannedPath:
    """One flight from here to there."""

    start: float  # s
    duration: float  # s
    axes: tuple[tuple[float, ...], ...]  # x, y, z
    end: Goal

    def goal(self, t: float) -> Goal:
        """Where it leads at t (s); after its end: the end, at rest."""
        if t >= self.start + self.duration:
            return self.end
        x, y, z = (evaluate(axis, t - self.start) for axis in self.axes)
        return Goal((x[0], y[0], z[0]), (x[1], y[1], z[1]), (x[2], y[2], z[2]), self.end.yaw)


class Planner:
    """Paths between high-level commands. Times (`t`) are s by the fleet's clock; yaw is in rad, world."""

    def __init__(self) -> None:
        self.state = IDLE
        self.path: PlannedPath | None = None

    def stop(self) -> None:
        """Motors off, and the path is forgotten."""
        self.state = IDLE

    def disable(self) -> None:
        """The path is forgotten; nothing is commanded until the next order."""
        self.state = DISABLED

    def takeoff(self, t: float, here: Goal, height: float, yaw: float, duration: float) -> bool:
        """Climb to `height` (m above the floor) within `duration` (s), from rest; False: only an idle planner does."""
        if self.state != IDLE:
            return False
        self._from_rest(t, here, height, yaw, duration)
        self.state = FLYING
        return True

    def land(self, t: float, here: Goal, height: float, yaw: float, duration: float) -> bool:
        """Sink to `height` within `duration`, from rest, then stop the motors; False: it is landing already."""
        if self.state == LANDING:
            return False
        self._from_rest(t, here, height, yaw, duration)
        self.state = LANDING
        return True

    def go_to(self, t: float, here: Goal, place: Triple, yaw: float, duration: float) -> None:
        """Fly to a place within `duration` and hold it, beginning with speed and acceleration as they are."""
        self._plan(t, here, place, yaw, duration)
        self.state = FLYING

    def _from_rest(self, t: float, here: Goal, height: float, yaw: float, duration: float) -> None:
        x, y, _ = here.position
        self._plan(t, Goal(here.position), (x, y, height), yaw, duration)

    def _plan(self, t: float, here: Goal, place: Triple, yaw: float, duration: float) -> None:
        starts = zip(here.position, here.velocity, here.acceleration, place, strict=True)
        axes = tuple(septic(p, v, a, end, duration) for p, v, a, end in starts)
        self.path = PlannedPath(t, duration, axes, Goal(place, yaw=yaw))

    def finished(self, t: float) -> bool:
        """True once the last path has been flown (or there is none)."""
        return self.path is None or t >= self.path.start + self.path.duration

    def goal(self, t: float) -> Goal | None:
        """What to hold now; None while idle, which a landing that is over makes it."""
        if self.state == LANDING and self.finished(t):
            self.state = IDLE
        if self.state in (IDLE, DISABLED) or self.path is None:
            return None
        return self.path.goal(t)
