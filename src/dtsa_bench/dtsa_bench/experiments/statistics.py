"""Intervals for what a sweep measured: Wilson for shares, a seeded bootstrap for means (docs/reference/metrics.md)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

LEVEL = 0.95  # of every interval in reports, unless said otherwise
RESAMPLES = 4000
_AT_ONCE = 1 << 22  # values drawn that are in memory at once
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
    """A mean with its bootstrap interval: not a number without values; the interval, without two."""

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
    """Return the mean of the finite values with a bootstrap interval; equal values give equal intervals.

    Percentiles of resampled means are too close together by sqrt((n - 1) / n), and take the normal distribution where
    few values need Student's (Hesterberg 2015): of 3 values such intervals hold the mean in 75 % of all cases, not in
    95 %. So the distances from the mean to both are stretched by what is missing; not below 0 if no value is.
    """
    from scipy.special import stdtrit

    data = np.asarray(list(values), dtype=np.float64)
    data = data[np.isfinite(data)]
    count, mean = len(data), float(data.mean()) if len(data) else math.nan
    if count < 2:
        return Mean(mean, math.nan, math.nan, count)
    random = np.random.Generator(np.random.PCG64(_SEED))
    rows = max(1, _AT_ONCE // count)
    means = np.concatenate([
        data[random.integers(0, count, (min(rows, resamples - first), count))].mean(axis=1)
        for first in range(0, resamples, rows)
    ])  # fmt: skip
    ends = np.quantile(means, ((1 - level) / 2, (1 + level) / 2))
    student, normal = stdtrit(count - 1, 0.5 + level / 2), NormalDist().inv_cdf(0.5 + level / 2)
    low, high = mean + (ends - mean) * student / normal * math.sqrt(count / (count - 1))
    return Mean(mean, max(float(low), min(0.0, float(data.min()))), float(high), count)
