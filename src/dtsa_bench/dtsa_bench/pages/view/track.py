"""What a server remembers of a run: its last moments."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from itertools import islice
from typing import Any

from .moments import Moment

MOST_MOMENTS = 12_000  # ten minutes at 20 a second
MOST_BYTES = 256 << 20
_OVERHEAD = 200  # bytes of a moment beside its contents


@dataclass(frozen=True, slots=True)
class Vehicles:
    """Crazyflies as their bridge sees them now."""

    rows: tuple[tuple[str, str, float, float, str], ...]  # name, state, battery in V, link quality 0 to 1, reason
    answer: str = ""  # what has come of the last order


class Track:
    """A run as a page shows it; one thread writes, others read. The oldest moments go when there are too many.

    :param name: what it is called until its settings are known.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._lock = threading.Lock()
        self._moments: deque[Moment] = deque()
        self._first = 0  # number of the oldest moment that is kept
        self._bytes = 0
        self._info: dict[str, Any] | None = None
        self._state = ""
        self._runs = 0
        #: What is known of Crazyflies beside or without a run: replaced, never changed. None: there are none.
        self.vehicles: Vehicles | None = None

    @property
    def info(self) -> tuple[int, dict[str, Any] | None]:
        """Number of the run that is shown, and what a page has to know of it; None: nothing is known yet."""
        with self._lock:
            return self._runs, self._info

    @property
    def state(self) -> str:
        """How the run is doing, as people read it; empty: it is under way."""
        return self._state

    def begin(self, info: dict[str, Any]) -> None:
        """A run begins, `info` as `run_info` gives it; what is known of another one is dropped."""
        with self._lock:
            self._runs += 1
            self._info, self._state = info, ""
            self._first += len(self._moments)
            self._moments.clear()
            self._bytes = 0

    def add(self, moment: Moment) -> None:
        """Adds the next moment."""
        with self._lock:
            self._moments.append(moment)
            self._bytes += _size(moment)
            while len(self._moments) > MOST_MOMENTS or (self._bytes > MOST_BYTES and len(self._moments) > 1):
                self._bytes -= _size(self._moments.popleft())
                self._first += 1

    def end(self, state: str) -> None:
        """The run, or what is known of it, has come to an end; `state` says to people why."""
        self._state = state

    def since(self, number: int, most: int) -> tuple[int, list[Moment]]:
        """At most so many moments from a number on, and the first one's number: a later one where older are gone."""
        with self._lock:
            start = max(number, self._first)
            place = start - self._first
            return start, list(islice(self._moments, place, place + most))


def _size(moment: Moment) -> int:
    return len(moment.text) + len(moment.heard) + len(moment.believed) + _OVERHEAD
