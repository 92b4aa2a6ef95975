"""The firmware's high-level commander: smooth paths between two states of rest."""

from __future__ import annotations

from dataclasses import dataclass

Triple = tuple[float, float, float]

# States of the planner, as the firmware names them.
DISABLED = "disabled"  # produces no setpoints: a streamed command took over, or none was given yet
FLYING = "flying"
LANDING = "landing"
STOPPED = "stopped"  # holds the motors off


def septic(p0: float, v0: float, p1: float, duration: float) -> tuple[float, ...]:
    """Coefficients (constant first) of the polynomial of degree 7 from (p0, v0) to rest at p1.

    Acceleration and jerk are zero at both ends.

    :param p0: start, m. :param v0: speed at the start, m/s. :param p1: end, m.
    :param duration: s, positive.
    """
    t = duration
    d = p1 - p0
    return (
        p0,
        v0,
        0.0,
        0.0,
        (35 * d - 20 * v0 * t) / t**4,
        (-84 * d + 45 * v0 * t) / t**5,
        (70 * d - 36 * v0 * t) / t**6,
        (-20 * d + 10 * v0 * t) / t**7,
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
class Path:
    """One flight from here to there."""

    start: float  # s
    duration: float  # s
    axes: tuple[tuple[float, ...], ...]  # x, y, z
    end: Triple  # m
    yaw: float  # rad, at the end


class Planner:
    """Setpoints between high-level commands. Time is an argument."""

    def __init__(self) -> None:
        self.state = DISABLED
        self.path: Path | None = None
        self._last: Triple = (0.0, 0.0, 0.0)

    def disable(self) -> None:
        """A streamed command has taken over: forget the path."""
        self.state = DISABLED
        self.path = None

    def stop(self) -> None:
        """Motors off."""
        self.state = STOPPED
        self.path = None

    def fly(self, t: float, position: Triple, velocity: Triple, goal: Triple, yaw: float, duration: float) -> None:
        """Take-off and go-to: fly to `goal` (m) within `duration` (s) and hold it."""
        self._plan(t, position, velocity, goal, yaw, duration)
        self.state = FLYING

    def land(self, t: float, position: Triple, velocity: Triple, height: float, yaw: float, duration: float) -> None:
        """Sink to `height` (m above the floor) within `duration` (s), then stop the motors."""
        x, y = self.path.end[:2] if self.path and self.finished(t) else position[:2]
        self._plan(t, position, velocity, (x, y, height), yaw, duration)
        self.state = LANDING

    def _plan(self, t: float, p: Triple, v: Triple, goal: Triple, yaw: float, duration: float) -> None:
        duration = max(duration, 0.1)
        axes = tuple(septic(p[i], v[i], goal[i], duration) for i in range(3))
        self.path = Path(t, duration, axes, goal, yaw)

    def finished(self, t: float) -> bool:
        """True once the last path has been flown (or there is none)."""
        return self.path is None or t >= self.path.start + self.path.duration

    def setpoint(self, t: float) -> tuple[Triple, Triple, Triple] | None:
        """Position, velocity and acceleration to hold now; None when the planner produces no movement."""
        if self.path is None:
            return None
        if self.finished(t):
            if self.state == LANDING:
                self.stop()
                return None
            return self.path.end, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        s = t - self.path.start
        x, y, z = (evaluate(axis, s) for axis in self.path.axes)
        return (x[0], y[0], z[0]), (x[1], y[1], z[1]), (x[2], y[2], z[2])
