"""Ages and errors of what agents know of each other, by slot, agent and observer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Ages:
    """By slot and agent: means over all observers that still have that agent in A_p; NaN without any."""

    age: NDArray[np.float64]  # slots, (S, N)
    error: NDArray[np.float64]  # m, (S, N)
    observers: NDArray[np.int64]  # (S, N)
    results: NDArray[np.bool_]  # (S,) slots that the means of a flight take

    @classmethod
    def empty(cls, slots: int, agents: int) -> Ages:
        """Without an observer in any slot."""
        shape = slots, agents
        return cls(np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, np.int64), np.zeros(slots, np.bool_))

    def put(self, slot: int, counted: NDArray[Any], age: NDArray[Any], error: NDArray[Any]) -> None:
        """Set the means of a slot from pairs of observers and agents: who counts, ages and errors, (V, N)."""
        observers = self.observers[slot] = counted.sum(axis=0)
        some = observers > 0
        for mean, values in ((self.age, age), (self.error, error)):
            mean[slot, some] = np.where(counted, values, 0).sum(axis=0)[some] / observers[some]


@dataclass(frozen=True, slots=True)
class ObservedPairs:
    """What each observer knew of each other agent that it had heard, at the end of one slot: P pairs."""

    slot: int
    observer: NDArray[np.int64]  # (P,) ids
    agent: NDArray[np.int64]  # (P,) ids
    age: NDArray[np.int64]  # slots, (P,)
    error: NDArray[np.float64]  # m, (P,)
    counted: NDArray[np.bool_]  # (P,) the observer still has it in A_p, and it moves
