"""Frames that the port refuses one after the other: an agent says so in flight."""

from __future__ import annotations

from collections.abc import Callable

_WAITS_NS = 1_000_000_000  # a queue that is full for a moment is only counted


class Outage:
    """A time in which no own frame leaves.

    :param say: is told a line when it has lasted for a second, and one when it is over; None: nobody is.
    """

    __slots__ = ("_count", "_said", "_say", "since_ns")

    def __init__(self, say: Callable[[str], None] | None) -> None:
        self._say, self._count, self._said = say, 0, False
        #: ns, CLOCK_MONOTONIC, of the first frame that was refused; 0: the last frame left.
        self.since_ns = 0

    def refused(self, reason: str, now_ns: int) -> None:
        """The port has refused a frame.

        :param reason: why.
        :param now_ns: ns, CLOCK_MONOTONIC.
        """
        self.since_ns = self.since_ns or now_ns
        self._count += 1
        if self._say is not None and not self._said and now_ns - self.since_ns >= _WAITS_NS:
            self._said = True
            self._say(f"no frame has left for {(now_ns - self.since_ns) / 1e9:.1f} s: {reason}")

    def left(self, now_ns: int) -> None:
        """A frame has left.

        :param now_ns: ns, CLOCK_MONOTONIC.
        """
        if self._say is not None and self._said:
            duration = (now_ns - self.since_ns) / 1e9
            self._say(f"frames leave again; for {duration:.1f} s none did, {self._count} were refused")
        self.since_ns, self._count, self._said = 0, 0, False
