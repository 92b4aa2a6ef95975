"""Wakings: who has got a goal while it stood, and how long the others took to hear of it.

Ages leave out those that an observer takes to stand: a mover that nobody has heard since it set out is in none of
them. What is counted here begins with the goal, for every receiver, heard or not (docs/reference/metrics.md).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Scenario
from dtsa_agent.core.kernel import lib

DELAYS = lib.METRICS_DELAYS


class Wakings:
    """State that the sums of a flight update: arrays over the N agents.

    :param scenario: what is flown.
    """

    def __init__(self, scenario: Scenario) -> None:
        agents = scenario.start.shape[1]
        self._course, self._plan = scenario.course(np.arange(agents, dtype=np.int32)), scenario.plan
        self._moving = np.asarray(scenario.moving, dtype=np.bool_)
        self.gone = np.zeros(agents, dtype=np.uint8)  # receives nothing any more
        self.goal = np.array(scenario.target, dtype=np.float64)  # (3, N) m; NaN: it flies on from there without a rest
        self.woken = np.full(agents, -1, dtype=np.int64)  # slot in which it got a goal; -1: it stands
        self.heard = np.zeros(agents, dtype=np.uint8)  # whether anybody has heard it since
        self.delays = np.zeros(DELAYS, dtype=np.int64)  # wakings by slots until somebody had heard; the last: or more
        self.count = 0
        if self._course is None:
            self._wake(self._moving, 0)
        else:
            self.follow(0, scenario.start)

    @property
    def final(self) -> NDArray[np.bool_] | None:
        """(N,) who has no further goal after the present one; None: nobody ever has."""
        return None if self._course is None else self._course.final

    def begin(self, slot: int) -> None:
        """Start to count at a slot: an agent that flies already counts as woken in it."""
        self.woken[self.woken >= 0] = np.maximum(self.woken[self.woken >= 0], slot)

    def follow(self, slot: int, position: NDArray[np.float64]) -> None:
        """Note the agents that get a goal as a slot begins; positions are (3, N) m in frame map."""
        course, plan = self._course, self._plan
        if course is None or plan is None or not course.advance(slot, position):
            return
        rests = (plan.pause > 0) | course.final
        self.goal[:] = np.where(rests, course.goal, np.nan)
        # An agent that has flown through a goal without a rest has been flying all the time.
        self._wake(self._moving & (course.changed == slot) & (self.woken < 0), slot)

    def _wake(self, who: NDArray[np.bool_], slot: int) -> None:
        self.woken[who], self.heard[who] = slot, 0
        self.count += int(who.sum())

    def summary(self, sums: dict[str, Any], slots: int, slot_ms: float) -> dict[str, Any]:
        """Return the results of a flight of so many slots as plain values; None where no agent got a goal."""
        news = sums["waking_count"]
        waiting = slots - self.woken[(self.woken >= 0) & (self.heard == 0)]  # at least so long
        delays = np.sort(np.concatenate((np.repeat(np.arange(DELAYS), self.delays), waiting)))
        mean = sums["waking_sum"] / news if news else None
        return {
            "waking_age_mean_slots": mean,
            "waking_age_max_slots": sums["waking_max"] if news else None,
            "waking_age_mean_ms": mean * slot_ms if mean is not None else None,
            "waking_age_max_ms": sums["waking_max"] * slot_ms if news else None,
            "wakings": self.count,
            "wakings_unheard": self.count - int(self.delays.sum()),
            "first_heard_median_slots": _quantile(delays, 0.5),
            "first_heard_95_slots": _quantile(delays, 0.95),
            "first_heard_max_slots": _quantile(delays, 1.0),
        }


def _quantile(values: NDArray[np.int64], share: float) -> int | None:
    """The least of sorted values that a share of them does not exceed."""
    return int(values[max(0, int(np.ceil(share * len(values))) - 1)]) if len(values) else None
