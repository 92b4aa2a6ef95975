"""What a live agent prints in flight: a line when its state changes, and one for each fault that lasts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

from dtsa_agent.core.station import FLIES, IS_NEW, NO_QUORUM, OTHER_SETTINGS, REJECTED, SAME_ID, STATES

_SECOND = 1_000_000_000
_STATE_NS = _SECOND  # a state that lasts is reported after this time, and the next one not before twice that
_FOREIGN_NS = 30 * _SECOND  # from a line about foreign datagrams to the next
_TIMED_FRAMES, _OFF_SHARE = 100, 0.05  # frames off their slots: of so many, so large a share means too short slots
_FOREIGN = {
    OTHER_SETTINGS: "other settings: slot length, agents, policy, seed, session or another one that all must share",
    REJECTED: "another key, or frames played again",
}


class Reports:
    """The lines of one agent. Times are CLOCK_MONOTONIC.

    :param log: prints a line; None: nothing is printed.
    :param show: shows a line in place of the one before, once a second; None: nothing is shown.
    """

    def __init__(
        self, id: int, slot_ms: float, log: Callable[[str], None] | None, now_ns: int,
        show: Callable[[str], None] | None = None,
    ) -> None:  # fmt: skip
        self._id, self._slot_ms, self._log, self._show = id, slot_ms, log or (lambda line: None), show
        self._show_due_ns = now_ns
        self._state = self._printed = ""  # the present state, and the one that was printed last
        self._state_due_ns = now_ns + _STATE_NS
        self._foreign: Counter[str] = Counter()
        self._foreign_due_ns = self._foreign_next_ns = 0
        self._outage_ns = self._outage_count = 0  # since when no frame leaves; 0: they do
        self._outage_printed = False
        self._timed = (-1, 0)  # frames of about the own time so far, of these off their slots
        self.slots_too_short = False

    def state(self, text: str, now_ns: int) -> None:
        """Report a state once it has lasted; what follows a colon may change without another line."""
        state = text.partition(":")[0]
        if state != self._state:
            self._state, self._state_due_ns = state, max(self._state_due_ns, now_ns + _STATE_NS)
        if state != self._printed and now_ns >= self._state_due_ns:
            self._printed, self._state_due_ns = state, now_ns + 2 * _STATE_NS
            self._log(text)

    def status(self, status: Any, now_ns: int) -> None:
        """Report the state in a ``dtsa_station_status`` with slots."""
        contact = f"hears {status.hears} of {status.others}, is heard by {status.heard_by} (quorum {status.needed})"
        texts = {
            FLIES: f"flies: {contact}", SAME_ID: f"hovers: another agent sends as {self._id}",
            NO_QUORUM: f"hovers: {contact}", IS_NEW: f"is new, and hovers until the others know it: {contact}",
        }  # fmt: skip
        alone = status.hovers != FLIES and STATES[status.state] == "alone"
        text = "is alone, and hovers until it hears others" if alone else texts[status.hovers]
        self.state(text, now_ns)
        if self._show is not None and now_ns >= self._show_due_ns:
            self._show_due_ns = now_ns + _SECOND
            self._show(f"slot {status.slot}, {status.sent} sent, {status.heard} heard; {text}")
        self._check_slot_length(status.timed, status.off)
        if self._foreign_due_ns and now_ns >= self._foreign_due_ns:
            counts = "; ".join(f"{count} of {_FOREIGN[why]}" for why, count in sorted(self._foreign.items()))
            self._log(f"datagrams not taken in so far: {counts}")
            self._foreign_due_ns, self._foreign_next_ns = 0, now_ns + _FOREIGN_NS

    def _check_slot_length(self, timed: int, off: int) -> None:
        """Report slots that are too short, by how many of the frames heard were off by more than a quarter of one."""
        before, off_before = max(self._timed[0], 0), self._timed[1]
        if timed - before < _TIMED_FRAMES:
            return
        share = (off - off_before) / (timed - before)
        # The first ones may be of agents that are about to adopt the time of this one.
        if self._timed[0] >= 0 and share > _OFF_SHARE and not self.slots_too_short:
            self.slots_too_short = True
            self._log(
                f"slots of {self._slot_ms:g} ms are too short for this network: {share:.0%} of the last "
                f"{timed - before} frames were off by more than a quarter of a slot"
            )
        self._timed = timed, off

    def foreign(self, fault: str, now_ns: int) -> None:
        """Note a datagram that was not accepted: one of other settings or another key is worth a line."""
        if fault in _FOREIGN:
            self._foreign[fault] += 1
            self._foreign_due_ns = self._foreign_due_ns or max(now_ns + _SECOND, self._foreign_next_ns)

    def sent(self, refusal: str, now_ns: int) -> None:
        """Note a frame, and why the port has refused it; a queue that is full for a moment is worth no line."""
        if refusal:
            self._outage_ns, self._outage_count = self._outage_ns or now_ns, self._outage_count + 1
        lasted_ns = now_ns - self._outage_ns
        if refusal:
            if not self._outage_printed and lasted_ns >= _SECOND:
                self._outage_printed = True
                self._log(f"no frame has left for {lasted_ns / 1e9:.1f} s: {refusal}")
        elif self._outage_count:
            if self._outage_printed:
                self._log(
                    f"frames leave again; for {lasted_ns / 1e9:.1f} s none did, {self._outage_count} were refused"
                )
            self._outage_ns, self._outage_count, self._outage_printed = 0, 0, False
