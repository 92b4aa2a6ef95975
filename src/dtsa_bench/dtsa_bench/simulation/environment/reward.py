"""What a slot was worth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class SlotResults:
    """What the last slot brought in B flights of N agents; arrays belong to the environment: read them only."""

    slot: NDArray[np.int64]  # (B,) its number
    flew: NDArray[np.bool_]  # (B,) whether the flight was still going on
    sent: NDArray[np.bool_]  # (B, N) who sent
    outcome: NDArray[np.int64]  # (B,) index into OUTCOMES: idle, success, collision
    ages: NDArray[np.int64]  # (B, N, N) age from waking on, slots, of what [observer] knows of [agent]; -1: none counts
    crashed: NDArray[np.bool_]  # (B,) two agents came too close
    completed: NDArray[np.bool_]  # (B,) all had arrived, and the tail is over
    position: NDArray[np.float64]  # (B, 3, N) m, frame map, true, at the slot's end


Reward = Callable[[SlotResults], NDArray[np.float64]]


class MeanAge:
    """The default: minus the mean age from waking on, over pairs, in slots; a crash costs a penalty on top.

    In slots in which nobody flies it is 0. `waking_age_mean_slots` is the mean of the same ages over all pairs of all
    slots.

    :param crash: penalty. It has to exceed what the rest of a flight may cost: a crash ends the flight.
    """

    def __init__(self, crash: float = 10_000.0) -> None:
        self.crash = crash

    def __call__(self, results: SlotResults) -> NDArray[np.float64]:
        """(B, 1) the same for all agents of a flight."""
        ages = results.ages
        counted = ages >= 0
        pairs = counted.sum(axis=(1, 2))
        mean = np.where(counted, ages, 0).sum(axis=(1, 2)) / np.maximum(pairs, 1)
        worth: NDArray[np.float64] = -mean - self.crash * results.crashed
        return worth[:, None]
