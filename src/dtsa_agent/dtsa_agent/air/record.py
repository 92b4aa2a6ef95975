"""What a live agent did and prints: a record a slot, counts of bounded size for its summary, and lines in flight."""

from __future__ import annotations

import resource
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

from dtsa_agent.core.delays import Delays
from dtsa_agent.core.station import OTHER_SETTINGS, REJECTED, STATES, HoverReason, Station
from dtsa_agent.core.swarm import Floats

_SECOND = 1_000_000_000
_ON_TIME_NS = 1_000_000
TOO_LATE = "too late"  # an own frame that would have disturbed the next turn
_STATUS_NS = 100_000_000  # from one check of the station's status to the next
_STATE_NS = _SECOND  # a state that lasts is reported after this time, and the next one not before twice that
_FOREIGN_NS = 30 * _SECOND  # from a line about foreign datagrams to the next
_TIMED_FRAMES, _OFF_SHARE = 100, 0.05  # frames off their slots: of so many, so large a share means too short slots
_FOREIGN = {
    OTHER_SETTINGS: "other settings: slot length, agents, policy, seed, session or another one that all must share",
    REJECTED: "another key, or frames played again",
}


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
    sent_ns: int = -1  # when its frame was handed to the network; -1: not at all
    datagram: bytes = b""  # as on the air; empty: nothing was sent
    before: list[ReceivedFrame] = field(default_factory=list)  # since it restarted, before this first slot
    heard: list[ReceivedFrame] = field(default_factory=list)  # while this slot was open, in this order


class Watcher(Protocol):
    """Follows what an agent does."""

    def slot(self, record: SlotRecord) -> None:
        """A slot is over; the watcher may keep the record."""

    def refused(self, reason: str, data: bytes, arrival_ns: int) -> None:
        """A datagram, of which these are the first 512 bytes, was not accepted; ns of the own clock."""


class SlotRecords:
    """Puts together what happens in the slots of one agent, and hands each to a watcher, if any, when it is over."""

    def __init__(self, watcher: Watcher | None) -> None:
        self._watcher = watcher
        self._record: SlotRecord | None = None  # of the present slot
        self._before: list[ReceivedFrame] = []  # since the agent restarted, before its first slot

    def open(self, record: SlotRecord) -> None:
        """A slot has begun; the one before is over."""
        self.close()
        self._record, record.before, self._before = record, self._before, []

    def restart(self) -> None:
        """The agent restarts: the slot is over, and what it has heard before counts no more."""
        self.close()
        self._before.clear()

    def transmit(self, at_ns: int, datagram: bytes) -> None:
        """The agent has sent a datagram at a time of its own clock."""
        if self._record is not None:
            self._record.sent_ns, self._record.datagram = at_ns, datagram

    def receive(self, frame: ReceivedFrame) -> None:
        """The agent has heard a frame."""
        (self._before if self._record is None else self._record.heard).append(frame)

    def close(self) -> None:
        """The present slot is over."""
        record, self._record = self._record, None
        if record is not None and self._watcher is not None:
            self._watcher.slot(record)


class AgentReports:
    """Counts of one agent, of bounded size, for its summary, and its lines in flight: one when its state changes, and
    one for each fault that lasts. Times are ns, CLOCK_MONOTONIC.

    :param log: prints a line; None: nothing is printed.
    :param show: shows a line in place of the one before, once a second; None: nothing is shown.
    """

    def __init__(
        self, id: int, slot_ms: float, log: Callable[[str], None] | None, now_ns: int,
        show: Callable[[str], None] | None = None,
    ) -> None:  # fmt: skip
        self._id, self._slot_ms, self._log, self._show = id, slot_ms, log or (lambda line: None), show
        self.began_ns, self.ended_ns = now_ns, 0
        self._joined_s = 0.0  # processor time until it had slots
        self.not_taken_in: Counter[str] = Counter()  # datagrams not accepted, by reason
        self._unsent: Counter[str] = Counter()  # own frames that the port has refused, by reason
        self._hovered: Counter[tuple[int, bool]] = Counter()  # slots, by reason and whether it had flown before
        self._flew = False
        self._others = self._hears = 0  # agents that are present, and those heard of them, over all checks
        self._late, self._off = Delays(), Delays()  # frames sent, by how late they left; heard, by how far off
        self._on_time = 0
        self._status_due_ns = self._show_due_ns = now_ns
        self._state = self._printed = ""  # the present state, and the one that was printed last
        self._state_due_ns = now_ns + _STATE_NS
        self._foreign_due_ns = self._foreign_next_ns = 0
        self._outage_ns = self._outage_count = 0  # since when no frame leaves; 0: they do
        self._outage_printed = False
        self._timed = (-1, 0)  # frames of about the own time so far, of these off their slots
        self._slots_too_short = False

    def join(self) -> None:
        """It has slots, perhaps other ones than before."""
        self._joined_s = self._joined_s or _processor_s()

    def slot(self, station: Station, now_ns: int) -> None:
        """A slot has begun."""
        hovers = station.hovers
        self._flew |= hovers == HoverReason.NONE
        self._hovered[hovers, self._flew] += 1
        if now_ns >= self._status_due_ns:
            self._status_due_ns = now_ns + _STATUS_NS
            self.status(station.status, now_ns)

    def status(self, status: Any, now_ns: int) -> None:
        """Report the state in a ``dtsa_station_status`` with slots."""
        contact = f"hears {status.hears} of {status.others}, is heard by {status.heard_by} (quorum {status.needed})"
        text = {
            HoverReason.NONE: f"flies: {contact}",
            HoverReason.SAME_ID: f"hovers: another agent sends as {self._id}",
            HoverReason.NO_QUORUM: f"hovers: {contact}",
            HoverReason.IS_NEW: f"is new, and hovers until the others know it: {contact}",
        }[status.hovers]
        if status.hovers != HoverReason.NONE and STATES[status.state] == "alone":
            text = "is alone, and hovers until it hears others"
        self.state(text, now_ns)
        if status.hovers != HoverReason.IS_NEW:
            self._others += status.others
            self._hears += status.hears
        if self._show is not None and now_ns >= self._show_due_ns:
            self._show_due_ns = now_ns + _SECOND
            self._show(f"slot {status.slot}, {status.sent} sent, {status.heard} heard; {text}")
        self._check_slot_length(status.timed, status.off)
        if self._foreign_due_ns and now_ns >= self._foreign_due_ns:
            counts = [f"{self.not_taken_in[why]} of {_FOREIGN[why]}" for why in _FOREIGN if self.not_taken_in[why]]
            self._log(f"datagrams not taken in so far: {'; '.join(counts)}")
            self._foreign_due_ns, self._foreign_next_ns = 0, now_ns + _FOREIGN_NS

    def state(self, text: str, now_ns: int) -> None:
        """Report a state once it has lasted; what follows a colon may change without another line."""
        state = text.partition(":")[0]
        if state != self._state:
            self._state, self._state_due_ns = state, max(self._state_due_ns, now_ns + _STATE_NS)
        if state != self._printed and now_ns >= self._state_due_ns:
            self._printed, self._state_due_ns = state, now_ns + 2 * _STATE_NS
            self._log(text)

    def _check_slot_length(self, timed: int, off: int) -> None:
        """Report slots that are too short, by how many of the frames heard were off by more than a quarter of one."""
        before, off_before = self._timed
        count = timed - max(before, 0)
        if count < _TIMED_FRAMES:
            return
        self._timed = timed, off
        share = (off - off_before) / count
        # The first ones may be of agents that are about to adopt the time of this one.
        if before >= 0 and share > _OFF_SHARE and not self._slots_too_short:
            self._slots_too_short = True
            self._log(
                f"slots of {self._slot_ms:g} ms are too short for this network: {share:.0%} of the last {count} frames"
                " were off by more than a quarter of a slot"
            )

    def count_refused(self, fault: str, now_ns: int) -> None:
        """A datagram was not accepted: one of other settings or another key is worth a line."""
        self.not_taken_in[fault] += 1
        if fault in _FOREIGN:
            self._foreign_due_ns = self._foreign_due_ns or max(now_ns + _SECOND, self._foreign_next_ns)

    def count_arrival(self, off_ns: int) -> None:
        """A frame has arrived so much earlier or later than expected, over a port whose arrivals vary."""
        self._off.add(abs(off_ns))

    def count_transmission(self, late_ns: int, now_ns: int) -> None:
        """A frame has left so much later than its slot began."""
        self._late.add(late_ns)
        self._on_time += late_ns <= _ON_TIME_NS
        if self._outage_count:
            if self._outage_printed:
                lasted_s = (now_ns - self._outage_ns) / 1e9
                self._log(f"frames leave again; for {lasted_s:.1f} s none did, {self._outage_count} were refused")
            self._outage_ns, self._outage_count, self._outage_printed = 0, 0, False

    def count_unsent(self, refusal: str, now_ns: int) -> None:
        """The port has refused a frame; a queue that is full for a moment is worth no line."""
        self._unsent[refusal] += 1
        self._outage_ns = self._outage_ns or now_ns
        self._outage_count += 1
        if not self._outage_printed and now_ns - self._outage_ns >= _SECOND:
            self._outage_printed = True
            self._log(f"no frame has left for {(now_ns - self._outage_ns) / 1e9:.1f} s: {refusal}")

    def summary(self, status: Any, longest_gap: tuple[int, int], **refused_by_tables: int) -> dict[str, Any]:
        """Return the counts as plain values.

        :param status: a ``dtsa_station_status``.
        :param longest_gap: slots, and the id of the agent.
        :param refused_by_tables: frames that the agent's tables have refused, by reason.
        """
        used, ended = _processor_s(), self.ended_ns or time.monotonic_ns()
        unsent = self._unsent + Counter({TOO_LATE: max(0, status.unsent - self._unsent.total())})
        held, shared = (self._hovered[why, False] for why in (HoverReason.NO_QUORUM, HoverReason.SAME_ID))
        never = f"never had its quorum, and hovered for {held} slots" if held else ""
        if shared > held:
            never = f"another agent sent as {self._id}, and it hovered for {shared} slots"
        return {
            "wall_time_s": (ended - self.began_ns) / 1e9,
            "slots": status.slots,
            "sent": status.sent,
            "unsent": unsent.total(),
            "unsent_because": dict(sorted(unsent.items())),
            "sends_on_time_share": self._on_time / status.sent if status.sent else None,
            "send_late_ms": self._late.quantiles_ms(),
            "heard": status.heard,
            **({"arrivals_off_ms": self._off.quantiles_ms()} if self._off.count() else {}),
            "heard_share": self._hears / self._others if self._others else None,
            "oldest_heard_slots": longest_gap[0] if self._others else None,
            "oldest_heard_of": longest_gap[1] or None,
            "processor_s": used,
            "processor_us_per_slot": (used - self._joined_s) / status.slots * 1e6 if status.slots else None,
            "state": STATES[status.state],
            "times_taken_over": max(0, status.restarts - 1),
            "times_corrected": status.shifts,
            "alignments": status.alignments,
            "flight_time_error_us": status.flight_error_ns / 1e3,
            "never_flew": "" if self._flew else never,
            "held_at_start_slots": held,
            "held_slots": self._hovered[HoverReason.NO_QUORUM, True],
            "slots_too_short": self._slots_too_short,
            "not_taken_in": dict(sorted((self.not_taken_in + Counter(refused_by_tables)).items())),
        }


def _processor_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime
