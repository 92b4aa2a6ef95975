"""What a live agent counts about itself; of bounded size, however long it flies."""

from __future__ import annotations

import resource
import time
from collections import Counter
from typing import Any

from dtsa_agent.core.delays import Delays
from dtsa_agent.core.station import STATES

_ON_TIME_NS = 1_000_000
TOO_LATE = "too late"  # an own frame that would have disturbed the next turn


class Tally:
    """Counts of one agent. Times are CLOCK_MONOTONIC."""

    def __init__(self) -> None:
        self.refused: Counter[str] = Counter()  # datagrams not accepted, by reason
        self.unsent: Counter[str] = Counter()  # own frames that the port has not taken, by reason
        self.began_ns = self.ended_ns = 0
        self.first_slot = self.joined_ns = -1  # with which it began for the first time, and when
        self.hovered = [0, 0]  # slots without a quorum, before it flew for the first time and since then
        self.flew = False
        self._joined_s = 0.0  # processor time until then
        self._others = self._hears = 0  # agents that are there, and those heard of them, over all looks
        self._late = Delays()  # frames sent, by how late they left
        self._off: Delays | None = None  # frames heard, by how far off they arrived
        self._on_time = 0

    def begun(self, slot: int) -> None:
        """It begins, or restarts."""
        if self.first_slot < 0:
            self.first_slot, self.joined_ns, self._joined_s = slot, time.monotonic_ns(), _processor_s()

    def look(self, others: int, hears: int) -> None:
        """How it stands with the others while it flies, or could."""
        self._others += others
        self._hears += hears

    def sent(self, late_ns: int) -> None:
        """A frame was sent so much later than its slot started."""
        self._late.add(late_ns)
        self._on_time += late_ns <= _ON_TIME_NS

    def off(self, off_ns: int) -> None:
        """A frame arrived so much earlier or later than expected, over a port whose arrivals vary."""
        self._off = self._off or Delays()
        self._off.add(abs(off_ns))

    def summary(self, status: Any, longest_gap: tuple[int, int]) -> dict[str, Any]:
        """The counts as plain values."""
        used, ended = _processor_s(), self.ended_ns or time.monotonic_ns()
        late = status.unsent - self.unsent.total()
        unsent = self.unsent + Counter({TOO_LATE: max(0, late)})
        never = self.hovered[0] and not self.flew
        return {
            "wall_time_s": (ended - self.began_ns) / 1e9,
            "first_slot": self.first_slot if self.first_slot >= 0 else None,
            "joined_after_s": (self.joined_ns - self.began_ns) / 1e9 if self.joined_ns >= 0 else None,
            "slots": status.slots,
            "sent": status.sent,
            "unsent": unsent.total(),
            "unsent_because": dict(sorted(unsent.items())),
            "sends_on_time_share": self._on_time / status.sent if status.sent else None,
            "send_late_ms": _quantiles(self._late),
            "heard": status.heard,
            **({} if self._off is None else {"arrivals_off_ms": _quantiles(self._off)}),
            "heard_share": self._hears / self._others if self._others else None,
            "oldest_heard_slots": longest_gap[0] if self._others else None,
            "oldest_heard_of": longest_gap[1] or None,
            "processor_s": used,
            "processor_us_per_slot": (used - self._joined_s) / status.slots * 1e6 if status.slots else None,
            "memory_mb": _memory_mb(),
            "state": STATES[status.state],
            "times_taken_over": max(0, status.restarts - 1),
            "times_corrected": status.shifts,
            "alignments": status.alignments,
            "flight_time_error_us": status.flight_error_ns / 1e3,
            "never_flew": f"never had its quorum, and hovered for {self.hovered[0]} slots" if never else "",
            "held_at_start_slots": self.hovered[0],
            "held_slots": self.hovered[1],
        }


def _quantiles(delays: Delays) -> dict[str, float | None]:
    return {"p50": delays.quantile_ms(0.5), "p99": delays.quantile_ms(0.99), "max": delays.largest_ms()}


def _processor_s() -> float:
    """Processor time of this process so far, s."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def _memory_mb() -> float:
    """The most memory that this process has had since its program began, MB."""
    try:
        with open("/proc/self/status", encoding="ascii") as lines:
            return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1024
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
