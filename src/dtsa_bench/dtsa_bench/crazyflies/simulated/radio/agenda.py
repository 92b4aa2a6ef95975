"""What happens when, on one time line."""

from __future__ import annotations

import heapq
from collections.abc import Callable


class Agenda:
    """What happens when, in the order of times."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, Callable[[], None]]] = []
        self._count = 0

    def at(self, when_ns: int, action: Callable[[], None]) -> None:
        """Do something at a time.

        :param when_ns: ns, the time.
        """
        self._count += 1
        heapq.heappush(self._heap, (when_ns, self._count, action))

    @property
    def next_ns(self) -> int | None:
        """Time of the next thing; None: there is nothing."""
        return self._heap[0][0] if self._heap else None

    def run(self, until_ns: int) -> None:
        """Do all that is due.

        :param until_ns: ns, up to and with this time.
        """
        while self._heap and self._heap[0][0] <= until_ns:
            heapq.heappop(self._heap)[2]()
