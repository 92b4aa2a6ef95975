"""Whether the channel keeps up with its time line: how late it is, and when it stood still."""

from __future__ import annotations

from dtsa_agent.core.agents.delays import Delays

_NS = 1_000_000_000
_STALL_SLOTS, _STALL_NS = 5, 50_000_000
_MOST_STALLS = 1000  # kept one by one; later ones are only counted
_BEHIND_NS, _TOO_LONG_NS = 1 * _NS, 8 * _NS  # who is that far behind for that long will not catch up


class Pace:
    """Follows the passes of the channel's loop. Times are ns from the start of slot 0."""

    def __init__(self, slot_ns: int) -> None:
        self._stall_ns = max(_STALL_SLOTS * slot_ns, _STALL_NS)
        self._last_ns = 0
        self.lag = Delays()  # from when a frame could have been delivered to when it was
        self.stalls: list[tuple[int, int]] = []  # ns from the start of slot 0: from, to
        self.stall_count = 0
        self.last_stall = (0, 0)
        self._behind_since_ns: int | None = None

    def passed(self, now_ns: int) -> int:
        """The next pass begins; for how long the channel stood still before it, ns, 0 if it did not."""
        gap, begun = now_ns - self._last_ns, self._last_ns
        self._last_ns = now_ns
        if gap < self._stall_ns:
            return 0
        self.stall_count += 1
        if len(self.stalls) < _MOST_STALLS:
            self.stalls.append((begun, now_ns))
        self.last_stall = begun, now_ns
        return gap

    def falls_behind(self, now_ns: int, done_ns: int) -> bool:
        """Whether a run that should have come to ``done_ns`` by now is too far behind for too long to catch up."""
        if now_ns - done_ns < _BEHIND_NS:
            self._behind_since_ns = None
            return False
        if self._behind_since_ns is None:
            self._behind_since_ns = now_ns
        return now_ns - self._behind_since_ns > _TOO_LONG_NS

    @property
    def behind_since_s(self) -> float:
        """Since when the run has been behind, s from the start of slot 0."""
        return (self._behind_since_ns or 0) / _NS
