"""How long things took, in constant memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_STEP = 1.05  # ratio of neighbouring bounds: a quantile is right to 5 %
_FIRST_NS = 1_000.0
_BOUNDS = _FIRST_NS * _STEP ** np.arange(380)  # 1 us to 107 s


class Delays:
    """Counts delays by size, for one or several series.

    :param series: number of series.
    """

    def __init__(self, series: int = 1) -> None:
        self._counts = np.zeros((series, len(_BOUNDS) + 1), dtype=np.int64)
        self._largest = np.zeros(series)

    def add(self, delay_ns: float, series: int = 0) -> None:
        """Takes in one delay.

        :param delay_ns: ns; what is below 0 counts as 0.
        :param series: index of its series.
        """
        self._counts[series, int(np.searchsorted(_BOUNDS, delay_ns))] += 1
        self._largest[series] = max(self._largest[series], delay_ns)

    def add_many(self, delay_ns: NDArray[np.int64], series: NDArray[np.intp]) -> None:
        """Takes in delays of several series, at most one of each.

        :param delay_ns: (n,) ns.
        :param series: (n,) index of the series of each, all different.
        """
        self._counts[series, np.searchsorted(_BOUNDS, delay_ns)] += 1
        self._largest[series] = np.maximum(self._largest[series], delay_ns)

    def count(self, series: int | None = None) -> int:
        """Number of delays.

        :param series: index of one series; None: all.
        """
        return int((self._counts if series is None else self._counts[series]).sum())

    def quantile_ms(self, share: float, series: int | None = None) -> float | None:
        """The delay that a share of all do not exceed, ms, to 5 %; None without any.

        :param share: 0 to 1.
        :param series: index of one series; None: all.
        """
        counts = self._counts.sum(axis=0) if series is None else self._counts[series]
        total = int(counts.sum())
        if not total:
            return None
        at = int(np.searchsorted(np.cumsum(counts), share * total))
        largest = self.largest_ms(series)
        assert largest is not None
        return largest if at >= len(_BOUNDS) else min(float(_BOUNDS[at]) / 1e6, largest)

    def largest_ms(self, series: int | None = None) -> float | None:
        """The largest delay, ms; None without any.

        :param series: index of one series; None: all.
        """
        if not self.count(series):
            return None
        return float(self._largest.max() if series is None else self._largest[series]) / 1e6
