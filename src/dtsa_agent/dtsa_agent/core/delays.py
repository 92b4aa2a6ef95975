"""How long things took, in constant memory."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np
from numpy.typing import NDArray

_BOUNDS = 1_000.0 * 1.05 ** np.arange(380)  # ns, 1 us to 107 s: a quantile is right to 5 %
_SCALAR_BOUNDS = _BOUNDS.tolist()  # NumPy takes ten times as long for a single delay


class Delays:
    """Count delays by size, for one or several series; a series of None in a question: all of them."""

    def __init__(self, series: int = 1) -> None:
        self._counts = np.zeros((series, len(_BOUNDS) + 1), dtype=np.int64)
        self._largest = np.zeros(series)

    def add(self, delay_ns: float, series: int = 0) -> None:
        """Receive one delay, ns; what is below 0 counts as 0."""
        self._counts[series, bisect_left(_SCALAR_BOUNDS, delay_ns)] += 1
        if delay_ns > self._largest[series]:
            self._largest[series] = delay_ns

    def add_many(self, delay_ns: NDArray[np.generic], series: NDArray[np.intp]) -> None:
        """Receive delays, (n,) ns, of several series, (n,) indices, all different."""
        self._counts[series, np.searchsorted(_BOUNDS, delay_ns)] += 1
        self._largest[series] = np.maximum(self._largest[series], delay_ns)

    def count(self, series: int | None = None) -> int:
        """Number of delays."""
        return int(self._counts[slice(None) if series is None else series].sum())

    def quantile_ms(self, share: float, series: int | None = None) -> float | None:
        """The delay that a share of all do not exceed, ms, to 5 %; None without any."""
        largest = self.largest_ms(series)
        if largest is None:
            return None
        counts = self._counts.sum(axis=0) if series is None else self._counts[series]
        at = int(np.searchsorted(np.cumsum(counts), share * self.count(series)))
        return largest if at >= len(_BOUNDS) else min(float(_BOUNDS[at]) / 1e6, largest)

    def largest_ms(self, series: int | None = None) -> float | None:
        """The largest delay, ms; None without any."""
        if not self.count(series):
            return None
        return float(self._largest[slice(None) if series is None else series].max()) / 1e6

    def quantiles_ms(self, series: int | None = None) -> dict[str, float | None]:
        """Median, 99 % quantile and largest delay, ms, for summaries; None without any."""
        middle, high = (self.quantile_ms(share, series) for share in (0.5, 0.99))
        return {"p50": middle, "p99": high, "max": self.largest_ms(series)}
