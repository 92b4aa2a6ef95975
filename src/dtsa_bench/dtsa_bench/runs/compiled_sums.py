"""Sums over a flight, by the compiled kernel; :class:`~dtsa_bench.runs.plain_sums.PlainSums` says what they are."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import AbstractSwarm
from dtsa_agent.core.binding import METRICS
from dtsa_agent.core.compiled import kernel as _kernel

from .wakings import DELAYS, Wakings

# libdtsa_sim/metrics.h
_SUMS = np.dtype(
    [(name, "f8") for name in ("min_distance2", "error_sum", "error_max")]
    + [(name, "i8") for name in ("pair_1", "pair_2", "min_slot", "age_count", "age_sum", "age_max")]
    + [(name, "i8") for name in ("waking_count", "waking_sum", "waking_max")]
)


class KernelSums:
    """Paths, distances, ages and errors of one flight.

    :param start: (3, N) m, where the agents start.
    :param target: (3, N) m.
    :param moving: (N,) who has to arrive.
    :param news_from: ages and errors count from this slot on.
    :param collision_m: two agents closer than this have crashed, m.
    :param r_min: who is this close to its target has arrived, m.
    :param wakings: who has got a goal; what is heard of them is counted in it.
    """

    def __init__(
        self,
        start: NDArray[np.float64],
        target: NDArray[np.float64],
        moving: NDArray[np.uint8],
        news_from: int,
        collision_m: float,
        r_min: float,
        wakings: Wakings,
    ) -> None:
        agents = len(moving)
        self._moving, self._path, self._sums = moving.copy(), np.zeros(agents), np.zeros(1, dtype=_SUMS)
        self._sums["min_distance2"] = 1e300
        values = {"n": agents, "news_from": news_from, "collision_m": collision_m, "r_min": r_min}
        arrays = {
            "path": self._path, "last_position": start.copy(), "target": target.copy(), "moving": self._moving,
            "sums": self._sums.view(np.int64),
            "gone": wakings.gone, "goal": wakings.goal, "woken": wakings.woken, "heard": wakings.heard,
            "delays": wakings.delays,
        }  # fmt: skip
        self._handle = _kernel.metrics(
            METRICS.image(values, arrays, {"n": agents, "d": DELAYS, "s": len(_SUMS.names or ())}), arrays
        )

    def update(self, slot: int, track: NDArray[np.float64], tables: AbstractSwarm | None) -> int:
        """Takes in a slot; returns METRICS_CRASHED, METRICS_ARRIVED or both.

        :param slot: slots that are over.
        :param track: (S, 3, N) m, true positions at its control instants.
        :param tables: what the agents know now; None: ages are left out.
        """
        return _kernel.update(self._handle, slot, track.tobytes(), None if tables is None else tables.kernel)

    def drop(self, index: int) -> None:
        """A mover that is lost counts no more.

        :param index: its index.
        """
        self._moving[index] = 0

    def result(self) -> dict[str, Any]:
        """The sums so far."""
        sums: dict[str, Any] = {name: self._sums[name][0].item() for name in _SUMS.names or ()}
        return {**sums, "pair": (sums.pop("pair_1"), sums.pop("pair_2")), "path": self._path.tolist()}
