"""Whether a Crazyflie's estimate of its own place can be believed: before it flies, and in flight. Pure."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

from dtsa_agent.crazyflie.state.conversions import Vector, VehicleState

from .motion_capture import Room, outside_room

SAMPLES = 5  # of a settled estimator, one after the other
STEADY_M = 0.05  # its place moves less than that meanwhile
ACCELERATION = 1.5  # m/s per s of silence that velocities may have changed between two packets
STUCK_M = 0.15  # a place that does not change has lost its velocity after so much of it
STANDING_M = 0.15  # so low it may stand, or be about to: there is nothing to change
APART_S = 0.3  # s, how long estimate and motion capture may differ before it counts


@dataclass(slots=True)
class Settling:
    """Decides when the estimator has settled after it was restarted.

    With motion capture: when its place agrees with where the vehicle is seen. Without: when its variances are small.
    In both cases the place must be steady, and inside the room.

    :param variance_limit: m^2.
    :param origin: m, where the world sees the origin of `map`.
    :param room: m, map; None: no limits.
    :param agree_m: m, largest distance from where it is seen; None: there is no motion capture.
    """

    variance_limit: float
    origin: Vector
    room: Room | None
    agree_m: float | None
    problem: str = "nothing is known about it"
    _places: deque[Vector] = field(default_factory=lambda: deque(maxlen=SAMPLES))

    def restart(self) -> None:
        """The filter was restarted: what was logged before does not count."""
        self.problem = "the firmware logs nothing about it"
        self._places.clear()

    def sample(self, place: Vector, variances: Vector, seen: Vector | None) -> bool:
        """Take in what the firmware logs; True once it has settled.

        :param place: m, world: what the estimator says.
        :param variances: m^2, of the three axes.
        :param seen: m, world: where motion capture sees it now; None: not at all.
        """
        self._places.append(place)
        self.problem = self._what_is_wrong(place, variances, seen)
        return not self.problem

    def _what_is_wrong(self, place: Vector, variances: Vector, seen: Vector | None) -> str:
        where = ", ".join(f"{p:.2f}" for p in place)
        if not all(math.isfinite(v) for v in (*place, *variances)):
            return f"its estimate is not finite ({where})"
        if self.agree_m is not None:
            if seen is None:
                return "motion capture does not see it"
            away = math.dist(place, seen)
            if away > self.agree_m:
                there = ", ".join(f"{p:.2f}" for p in seen)
                return f"it believes to be at ({where}), motion capture sees it {away:.2f} m away at ({there})"
        elif max(variances) > self.variance_limit:
            return f"variance {max(variances):.3g} m^2, limit {self.variance_limit:g} m^2, at ({where})"
        if outside := outside_room(place, self.origin, self.room):
            return f"it believes to be outside: {outside}"
        spread = max(math.dist(place, p) for p in self._places)
        if len(self._places) < SAMPLES or spread > STEADY_M:
            return f"its place moves by {spread:.2f} m, at ({where})"
        return ""


@dataclass(slots=True)
class EstimateWatch:
    """Notices in flight when an estimate jumps, stands still, or is not where motion capture sees the vehicle.

    What was wrong once stays wrong until the vehicle stands.

    :param jump_m: m from one packet to the next that the velocity does not explain; 0: never.
    :param freeze_s: s without any change; 0: never.
    :param error_m: m from where motion capture sees it; 0: never.
    """

    jump_m: float
    freeze_s: float
    error_m: float
    wrong: str = ""  # what is wrong; empty: nothing
    since: float = 0.0  # s, monotonic, from when on
    _last: tuple[VehicleState, float] | None = None
    _moved: float = 0.0  # s, monotonic, when it changed last
    _unmoved_m: float = 0.0  # m, way by its velocity since the place changed last
    _agreed: float = 0.0  # s, monotonic, when estimate and motion capture agreed last

    def update(self, state: VehicleState, now: float, seen: Vector | None, *, flying: bool) -> bool:
        """Take in a log packet; True when something is wrong that was not before.

        :param seen: m, world: where motion capture sees it now; None: not at all.
        """
        last, self._last = self._last, (state, now)
        if not flying or last is None:
            self.wrong = ""
            self._moved = self._agreed = now
            self._unmoved_m = 0.0
            return False
        before = last[0]
        if state.position != before.position or state.position[2] < STANDING_M:
            self._moved, self._unmoved_m = now, 0.0
        else:
            self._unmoved_m += math.hypot(*state.velocity) * (now - last[1])
            if state.velocity != before.velocity or state.orientation != before.orientation:
                self._moved = now  # the place alone may stay the same, to the millimetre, unless its velocity is large
        if seen is None or math.dist(seen, state.position) <= self.error_m:
            self._agreed = now
        if self.wrong:
            return False
        self.wrong = self._what_is_wrong(state, last, now, seen)
        self.since = now
        return bool(self.wrong)

    def _what_is_wrong(
        self, state: VehicleState, last: tuple[VehicleState, float], now: float, seen: Vector | None
    ) -> str:
        before, dt = last[0], now - last[1]
        follows = [p + v * dt for p, v in zip(before.position, before.velocity, strict=True)]
        jump = math.dist(state.position, follows)
        if self.jump_m and jump > self.jump_m + ACCELERATION * dt:
            return f"the estimate jumps by {jump:.2f} m within {dt:.2f} s"
        if self.freeze_s and now - self._moved > self.freeze_s:
            return f"the estimate has not changed for {now - self._moved:.2f} s"
        if self.freeze_s and self._unmoved_m > STUCK_M:
            return f"the estimated place has not changed, though it moved by {self._unmoved_m:.2f} m by its velocity"
        if self.error_m and seen is not None and now - self._agreed > APART_S:
            away = math.dist(seen, state.position)
            return f"the estimate is {away:.2f} m from where motion capture sees it"
        return ""
