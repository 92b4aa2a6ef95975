"""The least mean age that any schedule can give three agents, by dynamic programming, and how far greedy is from it.

Three agents that all move send to each other in slots; each receiver loses a frame with probability p, whatever the
other one does. The policy knows all six ages. The mean cost of a policy, and of the best one, come from relative value
iteration over all states, with ages cut off at a cap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_bench.simulation.schemes.knowledge import whittle_index

#: Pairs (receiver, sender) whose ages are the state, by axis.
PAIRS = tuple((j, k) for j in range(3) for k in range(3) if j != k)


@dataclass(frozen=True, slots=True)
class Optimum:
    """Mean ages in slots, 0: heard in the slot that has just ended; over all pairs."""

    loss: float
    best: float
    greedy: float
    whittle: float
    """By the sum of Whittle's indices."""
    tdma: float
    cap: int


def optimum(loss: float, cap: int = 9, tolerance: float = 1e-6) -> Optimum:
    """Solve the problem for three agents, each of which loses a frame with a probability."""
    ages = np.indices((cap + 1,) * len(PAIRS), dtype=np.int8)
    cost = np.asarray(ages.sum(axis=0) / len(PAIRS), dtype=np.float64)
    greedy = _largest_sum(list(ages))
    whittle = _largest_sum([whittle_index(age + 1.0, loss) for age in ages])
    del ages
    best, of_greedy, of_whittle = (_mean_cost(cost, loss, tolerance, choice) for choice in (None, greedy, whittle))
    return Optimum(loss, best, of_greedy, of_whittle, _round_robin(loss), cap)


def _largest_sum(weights: Sequence[NDArray[Any]]) -> NDArray[np.intp]:
    """The sender with the largest sum over its receivers, for each state."""
    sums = [sum(weights[i] for i, (_, k) in enumerate(PAIRS) if k == sender) for sender in range(3)]
    return np.asarray(np.stack(sums).argmax(axis=0))


def _round_robin(loss: float) -> float:
    """TDMA: turns of an agent come every third slot, and the number of them until a frame arrives is geometric.

    Between turns the age grows by 1 a slot: its mean is (N - 1) / 2, and N p / (1 - p) for the turns that were lost.
    """
    return 1.0 + 3.0 * loss / (1.0 - loss)


def _mean_cost(cost: NDArray[np.float64], loss: float, tolerance: float, choice: NDArray[np.intp] | None) -> float:
    """Cost of a slot in the long run, by relative value iteration."""
    value = np.zeros_like(cost)
    for _ in range(100_000):
        expected = [_after(value, sender, loss) for sender in range(3)]
        step = cost + (np.minimum.reduce(expected) if choice is None else np.choose(choice, expected))
        difference = step - value
        low, high = float(difference.min()), float(difference.max())
        value = step - step.flat[0]
        if high - low < tolerance:
            return (low + high) / 2
    raise RuntimeError(f"no convergence with loss {loss}: the mean cost is between {low} and {high}")


def _after(value: NDArray[np.float64], sender: int, loss: float) -> NDArray[np.float64]:
    """Expected value after a slot in which an agent sends: (cap + 1,) * 6."""
    axes = [i for i, (_, k) in enumerate(PAIRS) if k == sender]
    result = np.zeros_like(value)
    for received in product((True, False), repeat=len(axes)):
        probability = float(np.prod([1.0 - loss if r else loss for r in received]))
        if not probability:
            continue
        moved = value
        for axis in range(len(PAIRS)):
            if axis in axes and received[axes.index(axis)]:
                moved = np.take(moved, [0], axis=axis)  # heard: age 0
            else:
                older = np.minimum(np.arange(1, moved.shape[axis] + 1), value.shape[axis] - 1)
                moved = np.take(moved, older, axis=axis)
        result += probability * moved
    return result
