"""What a recorded run gives when it is followed slot by slot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Scenario


@dataclass(frozen=True, slots=True)
class Ages:
    """By slot and agent: means over all observers that still have that agent in A_p; NaN without any."""

    slot: NDArray[np.int64]  # (M,)
    age: NDArray[np.float64]  # slots, (M, N)
    error: NDArray[np.float64]  # m, (M, N)
    observers: NDArray[np.int64]  # (M, N)
    results: NDArray[np.bool_]  # (M,) slots that the means of a run take


@dataclass(frozen=True, slots=True)
class Observed:
    """What each observer knew of each other agent that it had heard, at the end of one slot: P pairs."""

    slot: int
    observer: NDArray[np.int64]  # (P,) ids
    agent: NDArray[np.int64]  # (P,) ids
    age: NDArray[np.int64]  # slots, (P,)
    error: NDArray[np.float64]  # m, (P,)
    counted: NDArray[np.bool_]  # (P,) the observer still has it in A_p, and it moves


@dataclass(frozen=True, slots=True)
class Followed:
    """What a recorded run gives when it is followed slot by slot; nothing where the bag does not hold enough."""

    scenario: Scenario | None
    ages: Ages | None
    summary: dict[str, Any]  # as in summary.json
    notes: list[str]  # what is left out, and why
