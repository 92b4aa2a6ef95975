"""What a live agent did: one record a slot, for a recorder, and counts of bounded size, for its summary."""

from __future__ import annotations

import resource
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Protocol

from dtsa_agent.core.delays import Delays
from dtsa_agent.core.station import STATES
from dtsa_agent.core.swarm import Floats

_ON_TIME_NS = 1_000_000
TOO_LATE = "too late"  # an own frame that would have disturbed the next turn


@dataclass(frozen=True, slots=True)
class ReceivedFrame:
    """A frame of another agent that was received in time."""

    sender: int  # id
    slot: int  # in which it was sent
    arrival_ns: int  # own clock
    datagram: bytes  # as it was on the air
    accepted: bool  # whether the tables took it


@dataclass(slots=True)
class SlotRecord:
    """One slot of one agent. Times are ns of its own clock."""

    slot: int
    start_ns: int  # when it started, as the agent knew when it opened it
    opened_ns: int  # when it was decided
    is_first: bool  # the agent began or restarted with this slot, knowing nothing
    present: int  # 1; 2: it is leaving
    chosen: int  # id of the sender that it expects, 0: none
    reason: int  # index into REASONS
    digest: int  # of the agent's table
    score: float
    track: Floats  # (S, 3) m, frame map: true positions at the control instants of the slot before
    velocity: Floats  # (3,) m/s, at the start
    command: Floats  # (3,) m/s, at the start
    goal: Floats  # (3,) m
    frame: bytes = b""  # what it was to send, without a tag; empty: silent
    sent_ns: int = -1  # when that was handed to the network; -1: not at all
    datagram: bytes = b""  # as on the air; empty: nothing was sent
    before: list[ReceivedFrame] = field(default_factory=list)  # since it restarted, before this first slot
    heard: list[ReceivedFrame] = field(default_factory=list)  # while this slot was open, in this order


class Watcher(Protocol):
    """Follows what an agent does."""

    def slot(self, record: SlotRecord) -> None:
        """A slot is over; the watcher may keep the record."""

    def refused(self, reason: str, data: bytes, arrival_ns: int) -> None:
        """A datagram, of which these are the first 512 bytes, was not accepted; ns of the own clock."""


class AgentCounts:
    """Counts of one agent. Times are CLOCK_MONOTONIC."""

    def __init__(self) -> None:
        self.refused: Counter[str] = Counter()  # datagrams not accepted, by reason
        self.unsent: Counter[str] = Counter()  # own frames that the port has refused, by reason
        self.began_ns = self.ended_ns = 0
        self.first_slot = self.joined_ns = -1  # with which it began for the first time, and when
        self.hovered = [0, 0]  # slots without a quorum, before it flew for the first time and since then
        self.flew = False
        self._joined_s = 0.0  # processor time until then
        self._others = self._hears = 0  # agents that are present, and those heard of them, over all checks
        self._late = Delays()  # frames sent, by how late they left
        self._off: Delays | None = None  # frames heard, by how far off they arrived
        self._on_time = 0

    def add_start(self, slot: int) -> None:
        """It begins, or restarts, with a slot."""
        if self.first_slot < 0:
            self.first_slot, self.joined_ns, self._joined_s = slot, time.monotonic_ns(), _processor_s()

    def add_contacts(self, others: int, hears: int) -> None:
        """It could fly, and hears so many of the others."""
        self._others += others
        self._hears += hears

    def add_sent(self, late_ns: int) -> None:
        """A frame was sent so much later than its slot started."""
        self._late.add(late_ns)
        self._on_time += late_ns <= _ON_TIME_NS

    def add_arrival(self, off_ns: int) -> None:
        """A frame arrived so much earlier or later than expected, over a port whose arrivals vary."""
        self._off = self._off or Delays()
        self._off.add(abs(off_ns))

    def summary(self, status: Any, longest_gap: tuple[int, int]) -> dict[str, Any]:
        """Return the counts as plain values."""
        used, ended = _processor_s(), self.ended_ns or time.monotonic_ns()
        unsent = self.unsent + Counter({TOO_LATE: max(0, status.unsent - self.unsent.total())})
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
    """The most memory that this process has had since its program began (ru_maxrss: also before that), MB."""
    try:
        with open("/proc/self/status", encoding="ascii") as lines:
            return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1024
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
