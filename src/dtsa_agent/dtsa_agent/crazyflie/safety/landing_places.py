"""Where those that land come down: nobody onto another one. Pure.

Whoever has somebody below it first moves aside, at its own height and one at a time, to the nearest place where nobody
is, will land, or stands. All others sink straight down.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass

from dtsa_agent.crazyflie.state.conversions import Vector

BELOW_M = 0.3  # whoever is lower and horizontally nearer than this is in the way down
LOWER_M = 0.1  # by so much
CLEAR_M = 0.45  # a place aside keeps this distance from all others, horizontally
PASS_M = 0.35  # the way to it keeps this one from those that fly, unless they are nearer already
LEVEL_M = 0.5  # ... and are not so far below
REACH_M = 2.0  # no place aside is farther away
RING_M = 0.1  # between the rings of places that are looked at
SECTORS = 24
MOVE_MPS = 0.4  # mean speed of the way aside
PASSES_S = 2.0  # one below that flies and does not land may fly on: it is waited for as long
PATIENCE_S = 10.0  # then one sinks where it is: no battery lasts for ever


@dataclass(frozen=True, slots=True)
class Other:
    """Another vehicle.

    :param place: m, world.
    :param flies: it moves, or may. :param lands: it is on its way down.
    :param goal: m, world: where it moves before it sinks; None: nowhere.
    """

    name: str
    place: Vector
    flies: bool = False
    lands: bool = False
    goal: Vector | None = None

    @property
    def places(self) -> tuple[Vector, ...]:
        """Where nobody else may land, m, world."""
        return (self.place,) if self.goal is None else (self.place, self.goal)


@dataclass(frozen=True, slots=True)
class Descent:
    """What one that lands does now: it sinks; with a place (m, world) it first goes there; or it waits.

    :param why: what keeps it from sinking; empty: nothing.
    """

    aside: Vector | None = None
    wait: bool = False
    why: str = ""


SINK = Descent()


def in_the_way(here: Vector, others: Sequence[Other], down_to: float = 0.0) -> Other | None:
    """Onto whom one would sink; None: nobody.

    :param here: m, world: where it is.
    :param down_to: m, the height at which it stops.
    """
    for other in others:
        for place in other.places:
            if down_to - BELOW_M < place[2] < here[2] - LOWER_M and _across(here, place) < BELOW_M:
                return other
    return None


def place_aside(here: Vector, others: Sequence[Other], low: Vector, high: Vector) -> Vector | None:
    """The nearest place (m, world) beside all others, at the same height, with a clear way; None: there is none.

    :param here: m, world: where it is.
    :param low: lower corner of the room, m, world. :param high: m, upper corner.
    """
    taken = [place for other in others for place in other.places]
    level = [p for other in others if other.flies for p in other.places if p[2] > here[2] - LEVEL_M]
    for ring in range(1, round(REACH_M / RING_M) + 1):
        spots = []
        for sector in range(SECTORS):
            angle = 2.0 * math.pi * sector / SECTORS
            x, y = here[0] + ring * RING_M * math.cos(angle), here[1] + ring * RING_M * math.sin(angle)
            spot = (x, y, here[2])
            room = min((_across(spot, place) for place in taken), default=math.inf)
            inside = low[0] <= x <= high[0] and low[1] <= y <= high[1]
            if inside and room >= CLEAR_M and all(_passes(here, spot, place) for place in level):
                spots.append((room, spot))
        if spots:
            return max(spots)[1]
    return None


def _across(a: Vector, b: Vector) -> float:
    return math.hypot(a[0] - b[0], a[1] - b[1])


def _passes(begin: Vector, end: Vector, place: Vector) -> bool:
    """Whether a straight way keeps clear of a place; one that is nearer already must not come nearer still."""
    way = end[0] - begin[0], end[1] - begin[1]
    to = place[0] - begin[0], place[1] - begin[1]
    along = (way[0] * to[0] + way[1] * to[1]) / (way[0] ** 2 + way[1] ** 2)
    along = min(1.0, max(0.0, along))
    return math.hypot(to[0] - along * way[0], to[1] - along * way[1]) >= min(PASS_M, math.hypot(*to) - 1e-9)


class LandingPlaces:
    """Says to each that lands what it does; one at a time moves aside, and no place is given away twice.

    :param low: lower corner of the room, m, world. :param high: m, upper corner.
    """

    def __init__(self, low: Vector, high: Vector) -> None:
        self._low, self._high = low, high
        self._lock = threading.Lock()
        self._goals: dict[str, Vector] = {}  # m, world, of those that land and have moved aside, or do so now
        self._mover, self._until = "", -math.inf  # who moves, until when at most (s, monotonic)

    def goal(self, name: str) -> Vector | None:
        """Where one moves, or has moved, before it sinks, m, world; None: nowhere."""
        return self._goals.get(name)

    def descent(
        self, name: str, here: Vector, others: Sequence[Other], since: float, now: float, down_to: float = 0.0
    ) -> Descent:
        """What one that lands does now.

        :param here: m, world: where it is.
        :param since: s, monotonic: when its landing was ordered. :param now: s, monotonic.
        :param down_to: m, the height at which it stops.
        """
        with self._lock:
            landing = {other.name for other in others if other.lands} | {name}
            self._goals = {n: goal for n, goal in self._goals.items() if n in landing}
            if self._mover == name or self._mover not in landing:
                self._until = -math.inf
            below = in_the_way(here, others, down_to)
            if below is None:
                return SINK
            why = f"{below.name} is below it"
            if now - since > PATIENCE_S:
                return Descent(why=f"{why}, and it can wait no longer")
            if now < self._until or (below.flies and not below.lands and now - since < PASSES_S):
                return Descent(wait=True, why=why)
            spot = place_aside(here, others, self._low, self._high)
            if spot is None:
                return Descent(wait=True, why=f"{why}, and there is no room beside")
            self._goals[name] = spot
            self._mover, self._until = name, now + 1.0 + _across(here, spot) / MOVE_MPS
            return Descent(aside=spot, why=why)
