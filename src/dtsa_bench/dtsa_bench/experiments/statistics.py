"""Intervals for what a sweep measured: Wilson for shares, a seeded bootstrap for means (docs/reference/metrics.md)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

LEVEL = 0.95  # of every interval in reports, unless said otherwise
RESAMPLES = 4000
_SEED = 20_240_229  # the intervals of a report are the same whenever it is made again


@dataclass(frozen=True, slots=True)
class Share:
    """k of n, with its Wilson interval."""

    count: int
    total: int
    low: float  # share, 0 to 1
    high: float

    @property
    def value(self) -> float:
        """k / n; not a number without runs."""
        return self.count / self.total if self.total else math.nan

    def __str__(self) -> str:
        return f"{self.count}/{self.total}"


@dataclass(frozen=True, slots=True)
class Mean:
    """A mean with its bootstrap interval; the three are not a number without values."""

    value: float
    low: float
    high: float
    count: int  # values it is the mean of


def wilson(count: int, total: int, level: float = LEVEL) -> Share:
    """Return the share count / total with the interval of Wilson (1927), which stays honest at 0 of n and n of n.

    :raises ValueError: unless 0 <= k <= n and 0 < level < 1.
    """
    if not 0 <= count <= total:
        raise ValueError(f"count: got {count}; allowed: 0 to {total}")
    if not 0.0 < level < 1.0:
        raise ValueError(f"level: got {level}; allowed: between 0 and 1")
    if total == 0:
        return Share(0, 0, 0.0, 1.0)
    z = NormalDist().inv_cdf(0.5 + level / 2)
    p, z2 = count / total, z * z
    middle = (p + z2 / (2 * total)) / (1 + z2 / total)
    half = z / (1 + z2 / total) * math.sqrt(p * (1 - p) / total + z2 / (4 * total * total))
    # At the ends the formula gives exactly 0 or 1; rounding must not move them.
    low = 0.0 if count == 0 else middle - half
    high = 1.0 if count == total else middle + half
    return Share(count, total, low, high)


def bootstrap_mean(values: Iterable[float], level: float = LEVEL, resamples: int = RESAMPLES) -> Mean:
    """Return the mean of the finite values with a percentile bootstrap interval; equal values give equal intervals."""
    data = np.asarray(list(values), dtype=np.float64)
    data = data[np.isfinite(data)]
    if not len(data):
        return Mean(math.nan, math.nan, math.nan, 0)
    mean = float(data.mean())
    if len(data) == 1:
        return Mean(mean, mean, mean, 1)
    random = np.random.Generator(np.random.PCG64(_SEED))
    means = data[random.integers(0, len(data), (resamples, len(data)))].mean(axis=1)
    low, high = np.quantile(means, ((1 - level) / 2, (1 + level) / 2))
    return Mean(mean, float(low), float(high), len(data))
