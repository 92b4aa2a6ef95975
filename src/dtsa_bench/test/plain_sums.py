"""The sums over a flight in plain Python, which the compiled ones equal bit for bit: in the order of agents' ids."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Swarm
from dtsa_bench.runs.wakings import DELAYS, Wakings

Array = NDArray[np.float64]
CRASHED, ARRIVED = 1, 2  # bits of what PlainSums.update returns


class PlainSums:
    """Distances, paths, ages and errors of one flight; parameters are those of ``FlightSums``."""

    def __init__(
        self,
        start: Array,
        target: Array,
        moving: NDArray[np.uint8],
        news_from: int,
        collision_m: float,
        r_min: float,
        wakings: Wakings,
    ) -> None:
        self._wakings = wakings
        self._waking_count = self._waking_sum = self._waking_max = 0
        self._last = _columns(start)
        self._target = _columns(target)
        self._moving = [bool(flag) for flag in moving]
        self._news_from, self._collision_m, self._r_min = news_from, collision_m, r_min
        self._path = [0.0] * len(self._moving)
        self._nearest2, self._pair, self._nearest_slot = 1e300, (0, 0), 0
        self._age_count = self._age_sum = self._age_max = 0
        self._error_sum = self._error_max = 0.0

    def drop(self, index: int) -> None:
        """A mover that is lost counts no more."""
        self._moving[index] = False

    def update(self, slot: int, track: Array, tables: Swarm | None) -> int:
        """Takes in a slot that has just ended. Returns CRASHED, ARRIVED or both."""
        crashed = [self._take_instant(slot, _columns(instant)) for instant in track]
        now = self._last
        away = [
            math.sqrt(_squared(p, goal))
            for p, goal, moves in zip(now, self._target, self._moving, strict=True)
            if moves
        ]
        if tables is not None and slot >= self._news_from:
            tables.estimate(slot)
            for row in range(len(tables.observer)):
                self._take_table(slot, tables, row, now)
        if tables is not None:
            for row in range(len(tables.observer)):
                self._take_wakings(slot - 1, tables, row)
            self._note_arrivals(now)
        return CRASHED * any(crashed) | ARRIVED * all(distance <= self._r_min for distance in away)

    def _take_instant(self, slot: int, now: list[list[float]]) -> bool:
        nearest2 = 1e300
        for k, p in enumerate(now):
            for j in range(k + 1, len(now)):
                d2 = _squared(now[j], p)
                nearest2 = min(nearest2, d2)
                if d2 < self._nearest2:
                    self._nearest2, self._pair, self._nearest_slot = d2, (k + 1, j + 1), slot
        for k, p in enumerate(now):
            self._path[k] += math.sqrt(_squared(p, self._last[k]))
        self._last = now
        return nearest2 < self._collision_m * self._collision_m

    def _take_table(self, slot: int, tables: Swarm, row: int, truth: list[list[float]]) -> None:
        observer, errors = int(tables.observer[row]), 0.0
        weight = len(truth) - 1 if observer < 0 else 1
        believed = _columns(tables.estimate_position[row])
        sent, in_ap = tables.sent_slot[row].tolist(), tables.in_ap[row].tolist()
        for k, moves in enumerate(self._moving):
            if not moves or not in_ap[k] or k == observer or sent[k] < 0:
                continue
            age, error = slot - 1 - sent[k], math.sqrt(_squared(believed[k], truth[k]))
            self._age_count += weight
            self._age_sum += weight * age
            self._age_max = max(self._age_max, age)
            errors += error
            self._error_max = max(self._error_max, error)
        self._error_sum += errors * weight

    def _take_wakings(self, last: int, tables: Swarm, row: int) -> None:
        wakings, observer, sent = self._wakings, int(tables.observer[row]), tables.sent_slot[row].tolist()
        if observer >= 0 and wakings.gone[observer]:
            return
        weight = len(sent) - 1 if observer < 0 else 1
        for k, woken in enumerate(wakings.woken.tolist()):
            if woken < 0 or not self._moving[k] or k == observer:
                continue
            age = last - max(sent[k], woken - 1)
            self._waking_count += weight
            self._waking_sum += weight * age
            self._waking_max = max(self._waking_max, age)
            if sent[k] >= woken and not wakings.heard[k]:
                wakings.heard[k] = 1
                wakings.delays[min(last - woken, DELAYS - 1)] += 1

    def _note_arrivals(self, now: list[list[float]]) -> None:
        wakings = self._wakings
        for k, goal in enumerate(_columns(wakings.goal)):
            if wakings.woken[k] >= 0 and math.sqrt(_squared(now[k], goal)) <= self._r_min:
                wakings.woken[k] = -1

    def result(self) -> dict[str, Any]:
        """The sums so far."""
        return {
            "min_distance2": self._nearest2,
            "pair": self._pair,
            "min_slot": self._nearest_slot,
            "path": list(self._path),
            "age_count": self._age_count,
            "age_sum": self._age_sum,
            "age_max": self._age_max,
            "waking_count": self._waking_count,
            "waking_sum": self._waking_sum,
            "waking_max": self._waking_max,
            "error_sum": self._error_sum,
            "error_max": self._error_max,
        }


def _columns(planes: Array) -> list[list[float]]:
    rows: list[list[float]] = planes.T.tolist()
    return rows


def _squared(a: list[float], b: list[float]) -> float:
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return x * x + y * y + z * z
