"""Sums over a flight, by ``libdtsa_sim/metrics.c``; what they mean: docs/reference/metrics.md."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Swarm
from dtsa_agent.core.kernel import ffi, lib, memory

from .wakings import Wakings

CRASHED, ARRIVED = lib.METRICS_CRASHED, lib.METRICS_ARRIVED  # bits of what FlightSums.update returns
_update = lib.metrics_update
_NAMES = [name for name, _ in ffi.typeof("metrics_sums").fields]


class FlightSums:
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
        self._moving, self._path = moving.copy(), np.zeros(len(moving))
        arrays = {
            "path": self._path, "last_position": start.copy(), "target": target.copy(), "moving": self._moving,
            "gone": wakings.gone, "goal": wakings.goal, "woken": wakings.woken, "heard": wakings.heard,
            "delays": wakings.delays,
        }  # fmt: skip
        self._lent = {name: memory(array, writable=True) for name, array in arrays.items()}
        self._sums = ffi.new("metrics_sums *", {"min_distance2": 1e300})
        values = {"n": len(moving), "news_from": news_from, "collision_m": collision_m, "r_min": r_min}
        self._metrics = ffi.new("metrics *", {**values, **self._lent, "sums": self._sums})
        self._seen: tuple[Any, Any] = None, None  # track and tables of the last slot
        self._planes: Any = None

    def update(self, slot: int, track: NDArray[np.float64], tables: Swarm | None) -> int:
        """Takes in a slot; returns CRASHED, ARRIVED or both.

        :param slot: slots that are over.
        :param track: (S, 3, N) m, true positions at its control instants.
        :param tables: what the agents know now; None: ages are left out.
        """
        if track is not self._seen[0] or tables is not self._seen[1]:  # mostly they are the same again
            self._look_at(track, tables)
        state: int = _update(self._metrics, slot)
        return state

    def _look_at(self, track: NDArray[np.float64], tables: Swarm | None) -> None:
        if track.shape[1:] != (3, len(self._moving)):
            raise ValueError(f"track: shape {track.shape}")
        self._seen, self._planes = (track, tables), memory(track)
        self._metrics.track, self._metrics.steps = self._planes, len(track)
        self._metrics.tables = ffi.NULL if tables is None else tables.kernel

    def drop(self, index: int) -> None:
        """A mover that is lost counts no more."""
        self._moving[index] = 0

    def result(self) -> dict[str, Any]:
        """The sums so far."""
        sums: dict[str, Any] = {name: getattr(self._sums, name) for name in _NAMES}
        return {**sums, "pair": (sums.pop("pair_1"), sums.pop("pair_2")), "path": self._path.tolist()}
