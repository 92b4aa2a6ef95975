"""What an agent counts about itself."""

from __future__ import annotations

import resource
import time
from collections import Counter
from typing import Any

from dtsa_agent.core.agents.delays import Delays

_ON_TIME_NS = 1_000_000
TOO_LATE = "too late"  # an own frame that would have disturbed the next turn


class Tally:
    """Counts of one agent; of bounded size, however long it flies."""

    def __init__(self) -> None:
        self.refused: Counter[str] = Counter()  # datagrams not taken in, by reason
        self.slots = 0  # slots that are over
        self.heard = 0  # frames of others taken in
        self.unsent: Counter[str] = Counter()  # own frames that did not leave, by reason
        self.began_ns = self.ended_ns = 0  # CLOCK_MONOTONIC
        self.first_slot = -1  # with which it began for the first time
        self.joined_ns = -1  # CLOCK_MONOTONIC, when
        self._joined_s = 0.0  # processor time until then
        self._there = self._hears = 0  # others that are there, and of these those that it hears, over all looks
        self._last: dict[int, int] = {}  # slot of the last frame, by sender
        self._oldest, self._oldest_of = 0, 0  # slots, and of whom
        self._late = Delays()  # frames sent, by how late they left
        self._off: Delays | None = None  # frames heard, by how far off they arrived
        self._on_time = 0

    def begun(self, slot: int, now_ns: int) -> None:
        """It begins, or begins anew: then slots count differently, and who was heard before counts as not heard yet.

        :param slot: the first slot.
        :param now_ns: ns, CLOCK_MONOTONIC.
        """
        if self.first_slot < 0:
            self.first_slot, self.joined_ns, self._joined_s = slot, now_ns, _processor_s()
        self._last.clear()

    def hear(self, sender: int, slot: int, leaves: bool) -> None:
        """A frame of another agent was taken in.

        :param sender: id.
        :param slot: in which it was sent.
        :param leaves: it says that it leaves: its silence is no outage.
        """
        self.heard += 1
        age = slot - self._last.get(sender, slot)
        if age > self._oldest and self._there:
            self._oldest, self._oldest_of = age, sender
        self._last[sender] = slot
        if leaves:
            del self._last[sender]

    def look(self, there: int, hears: int) -> None:
        """How it stands with the others while it flies, or could.

        :param there: number of others that are there.
        :param hears: of these, those that it hears.
        """
        self._there += there
        self._hears += hears

    def sent(self, late_ns: int) -> None:
        """A frame was sent.

        :param late_ns: ns, how much later than its slot started.
        """
        self._late.add(late_ns)
        self._on_time += late_ns <= _ON_TIME_NS

    def off(self, off_ns: int) -> None:
        """A frame was heard over a port whose arrivals vary.

        :param off_ns: ns, how much earlier or later than expected it arrived.
        """
        if self._off is None:
            self._off = Delays()
        self._off.add(abs(off_ns))

    def summary(self, slot: int = -1) -> dict[str, Any]:
        """The counts as plain values.

        :param slot: the present one.
        """
        for sender, last in self._last.items():
            if slot - last > self._oldest and self._there:
                self._oldest, self._oldest_of = slot - last, sender
        sent = self._late.count()
        used = _processor_s()
        ended = self.ended_ns or time.monotonic_ns()
        return {
            "wall_time_s": (ended - self.began_ns) / 1e9,
            "first_slot": self.first_slot if self.first_slot >= 0 else None,
            "joined_after_s": (self.joined_ns - self.began_ns) / 1e9 if self.joined_ns >= 0 else None,
            "slots": self.slots,
            "sent": sent,
            "unsent": self.unsent.total(),
            "unsent_because": dict(sorted(self.unsent.items())),
            "sends_on_time_share": self._on_time / sent if sent else None,
            "send_late_ms": _quantiles(self._late),
            "heard": self.heard,
            **({} if self._off is None else {"arrivals_off_ms": _quantiles(self._off)}),
            "heard_share": self._hears / self._there if self._there else None,
            "oldest_heard_slots": self._oldest if self._there else None,
            "oldest_heard_of": self._oldest_of or None,
            "processor_s": used,
            "processor_us_per_slot": (used - self._joined_s) / self.slots * 1e6 if self.slots else None,
            "memory_mb": _memory_mb(),
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
