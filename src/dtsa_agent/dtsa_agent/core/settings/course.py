"""Which of its goals an agent flies to now, from the slot's number and its own position alone.

An agent runs this for itself, the simulator for all, the metrics for all: the same numbers in, the same goals
out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Plan:
    """The goals of all agents, known before the flight.

    :param start: (3, N), m, frame map: where each waits for its first slot.
    :param goals: (K, 3, N), m: where each flies to, one after the other; the last one is its target.
    :param begin: (N,) first slot in which each flies.
    :param pause: (N,) slots that each rests at a goal before it flies on to the next.
    :param moving: (N,) who flies at all.
    :param r_min: m, closer than this an agent has arrived.
    """

    start: Array
    goals: Array
    begin: NDArray[np.int64]
    pause: NDArray[np.int64]
    moving: NDArray[np.bool_]
    r_min: float

    @property
    def way(self) -> Array:
        """Length of the straight lines from goal to goal, (N,), m."""
        points = np.concatenate((self.start[None], self.goals))
        return np.asarray(np.sqrt((np.diff(points, axis=0) ** 2).sum(axis=1)).sum(axis=0))


class Course:
    """How far some agents are with their plans.

    :param plan: the goals of all agents.
    :param local: (L,) indices (id - 1) of the agents followed.
    """

    def __init__(self, plan: Plan, local: NDArray[np.int32]) -> None:
        self._start = plan.start[:, local]
        self._goals = plan.goals[:, :, local]
        self._begin, self._pause = plan.begin[local], plan.pause[local]
        self._moving = plan.moving[local]
        self._r_min = plan.r_min
        self._columns = np.arange(len(local))
        self.leg = np.full(len(local), -1, dtype=np.int64)  # index of the present goal, -1: waits for its first slot
        self._since = np.full(len(local), -1, dtype=np.int64)  # slot of arrival at the present goal, -1: under way
        self.goal: Array = self._start.copy()  # (3, L) m, frame map, where each flies to now
        self.changed = np.full(len(local), -1, dtype=np.int64)  # slot in which that became its goal

    def reset(self) -> None:
        """Back to the start of the flight."""
        self.leg[:] = self._since[:] = self.changed[:] = -1
        self.goal = self._start.copy()

    @property
    def active(self) -> NDArray[np.bool_]:
        """The agents that fly now, (L,); the others hover."""
        return np.asarray(self._moving & (self.leg >= 0))

    @property
    def final(self) -> NDArray[np.bool_]:
        """The agents that have no further goal after the present one, (L,)."""
        return np.asarray(~self._moving | (self.leg == len(self._goals) - 1))

    def advance(self, slot: int, position: Array) -> bool:
        """Takes note of where the agents are when a slot begins.

        :param slot: its number.
        :param position: (3, L) true positions, m, frame map.
        :returns: whether anybody's goal has changed.
        """
        onward = (self.leg < 0) & (self._begin <= slot)
        if len(self._goals) > 1:
            offset = position - self.goal
            under_way = (self.leg >= 0) & (self.leg < len(self._goals) - 1)
            arrived = under_way & (np.sqrt((offset * offset).sum(axis=0)) <= self._r_min)
            self._since[arrived & (self._since < 0)] = slot
            onward |= under_way & (self._since >= 0) & (slot - self._since >= self._pause)
        if not onward.any():
            return False
        self.leg[onward] += 1
        self._since[onward] = -1
        self.changed[onward] = slot
        chosen = self._goals[np.maximum(self.leg, 0), :, self._columns].T
        self.goal = np.where(self.leg >= 0, chosen, self._start)
        return True
