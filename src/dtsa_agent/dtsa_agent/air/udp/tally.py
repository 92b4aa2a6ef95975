"""What an agent counts about itself."""

from __future__ import annotations

import resource
import time
from collections import Counter
from typing import Any

_ON_TIME_NS = 1_000_000
_BINS_NS = 10_000  # of the histogram of lateness: as fine as it is told
_MS = 1e6


class Tally:
    """Counts of one agent; of bounded size, however long it flies.

    :param slot_ns: ns, length of a slot: a frame is never later than half of it.
    """

    def __init__(self, slot_ns: int) -> None:
        self.refused: Counter[str] = Counter()  # datagrams not taken in, by reason
        self.slots = 0  # slots that are over
        self.heard = 0  # frames of others taken in
        self.unsent = 0  # own frames that would have left half a slot late or more
        self.began_ns = self.ended_ns = 0  # CLOCK_MONOTONIC
        self.first_slot = -1  # with which it began for the first time
        self.joined_ns = -1  # CLOCK_MONOTONIC, when
        self._late = [0] * (slot_ns // 2 // _BINS_NS + 2)  # frames sent, by how late they left
        self._latest_ns = self._on_time = 0

    def begun(self, slot: int, now_ns: int) -> None:
        """It begins, or begins anew.

        :param slot: the first slot.
        :param now_ns: ns, CLOCK_MONOTONIC.
        """
        if self.first_slot < 0:
            self.first_slot, self.joined_ns = slot, now_ns

    def sent(self, late_ns: int) -> None:
        """A frame was sent.

        :param late_ns: ns, how much later than its slot started.
        """
        self._late[min(max(late_ns, 0) // _BINS_NS, len(self._late) - 1)] += 1
        self._latest_ns = max(self._latest_ns, late_ns)
        self._on_time += late_ns <= _ON_TIME_NS

    def _quantile_ms(self, share: float) -> float | None:
        count, wanted = sum(self._late), share * sum(self._late)
        reached = 0
        for index, number in enumerate(self._late):
            reached += number
            if count and reached >= wanted:
                return (index + 1) * _BINS_NS / _MS
        return None

    def summary(self) -> dict[str, Any]:
        """The counts as plain values."""
        sent = sum(self._late)
        used = resource.getrusage(resource.RUSAGE_SELF)
        ended = self.ended_ns or time.monotonic_ns()
        return {
            "wall_time_s": (ended - self.began_ns) / 1e9,
            "first_slot": self.first_slot if self.first_slot >= 0 else None,
            "joined_after_s": (self.joined_ns - self.began_ns) / 1e9 if self.joined_ns >= 0 else None,
            "slots": self.slots,
            "sent": sent,
            "unsent": self.unsent,
            "sends_on_time_share": self._on_time / sent if sent else None,
            "send_late_ms": {
                "p50": self._quantile_ms(0.5),
                "p99": self._quantile_ms(0.99),
                "max": self._latest_ns / _MS if sent else None,
            },
            "heard": self.heard,
            "processor_s": used.ru_utime + used.ru_stime,
            "memory_mb": used.ru_maxrss / 1024,
        }
