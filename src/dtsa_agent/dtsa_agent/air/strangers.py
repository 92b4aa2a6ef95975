"""Datagrams with other settings or another key: an agent counts them, and says so in flight."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from .datagram import OTHER_SETTINGS, REJECTED

_WAITS_NS = 1_000_000_000  # from the first such datagram to the line: the line has a count then
_AGAIN_NS = 30_000_000_000  # from a line to the next one
_WHY = {
    OTHER_SETTINGS: "other settings: slot length, agents, policy, seed, session or another one that all must share",
    REJECTED: "another key, or frames played again",
}


class Strangers:
    """Counts datagrams that others send with other settings or another key.

    :param say: is told a line, a second after the first one, and not again for 30 s; None: nobody is.
    """

    __slots__ = ("_counts", "_next_ns", "_say", "due_ns")

    def __init__(self, say: Callable[[str], None] | None) -> None:
        self._say, self._counts = say, Counter[str]()
        #: ns, CLOCK_MONOTONIC, when there is something to say; 0: there is nothing.
        self.due_ns = 0
        self._next_ns = 0

    def note(self, reason: str, now_ns: int) -> None:
        """A datagram was not taken in.

        :param reason: why.
        :param now_ns: ns, CLOCK_MONOTONIC.
        """
        if reason in _WHY and self._say is not None:
            self._counts[reason] += 1
            self.due_ns = self.due_ns or max(now_ns + _WAITS_NS, self._next_ns)

    def say(self, now_ns: int) -> None:
        """Says what there is to say, if it is time for that.

        :param now_ns: ns, CLOCK_MONOTONIC.
        """
        if now_ns < self.due_ns or self._say is None:
            return
        told = "; ".join(f"{count} of {_WHY[reason]}" for reason, count in sorted(self._counts.items()))
        self._say(f"datagrams not taken in so far: {told}")
        self.due_ns, self._next_ns = 0, now_ns + _AGAIN_NS
