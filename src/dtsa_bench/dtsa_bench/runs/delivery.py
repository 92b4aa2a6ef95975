"""Whether the agents of a flight have heard each other; a flight in which they have not counts as failed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.agent import REFUSED

_WHY = {
    "rejected": "rejected (no tag, or one of another key, session or slot)",
    "malformed": "malformed",
    "foreign": "foreign (of another swarm or time)",
}
_PATIENCE_NS = 1_000_000_000  # of flight, before a page reports that no agent hears another
_LONGEST = 500  # characters of what a summary says
_ROUNDS = 2  # as many slots as this times N pass before somebody must have been heard


class DeliveryCounts:
    """Frames that N agents sent, the receivers that they arrived at, and those that accepted them."""

    def __init__(self, agents: int, slots: int = 0, sent: int = 0, delivered: int = 0, accepted: int = 0) -> None:
        self._agents = agents
        self.slots, self.sent, self.delivered, self.accepted = slots, sent, delivered, accepted

    def add_slot(self, frames: int, received: NDArray[Any]) -> None:
        """Count a slot that is over; received is (F, N), 1 where a frame arrived."""
        self.slots += 1
        self.sent += frames
        self.delivered += int(np.count_nonzero(received))

    def add_accepted(self, mask: NDArray[Any]) -> None:
        """Count a frame that agents accepted; mask is (N,)."""
        self.accepted += int(np.count_nonzero(mask))

    def subtract_refused(self, not_taken_in: Mapping[str, int]) -> None:
        """Subtract what agents say that they refused, by reason: only they know if their keys differ."""
        self.accepted = max(0, min(self.accepted, self.delivered - not_taken_in.get(REFUSED, 0)))

    def problem(self, not_taken_in: Mapping[str, int] | None = None) -> str:
        """Say why no agent heard another, or why most frames were of no use; empty: neither is so.

        :param not_taken_in: number of messages and frames kept out by the agents, by reason.
        """
        if self._agents < 2 or self.slots < _ROUNDS * self._agents or 2 * self.accepted >= self.delivered > 0:
            return ""
        if not self.sent:
            return f"no agent heard another: no frame was sent in {self.slots} slots"
        if not self.delivered:
            return f"no agent heard another: {self.sent} frames were sent, and none arrived"
        kept_out = f"of {self.delivered} frames that arrived {self.delivered - self.accepted} were not taken in"
        start = "most frames were of no use" if self.accepted else "no agent heard another"
        counts = not_taken_in or {}
        known = [(counts.get(name, counts.get(f"frame {name}", 0)), why) for name, why in _WHY.items()]
        text = ", ".join(f"{count} {why}" for count, why in known if count)
        return f"{start}: {kept_out}" + (f"; the agents' processes count {text}" if text else "")


class OncePerFault:
    """Reports a problem of deliveries once, and again when its kind changes."""

    def __init__(self, slot_ns: int) -> None:
        self._first, self._reported = _PATIENCE_NS // slot_ns, ""

    def fault_to_report(self, slot: int, problem: str) -> str:
        """Return a :meth:`DeliveryCounts.problem` at the start of a slot if it is to be reported now, else nothing."""
        kind = problem.partition(":")[0]
        if slot < self._first or kind == self._reported:
            return ""
        self._reported = kind
        return problem


def counts_of_datagrams(
    agents: int, slots: int, sent: int, heard: int, not_taken_in: Mapping[str, int]
) -> DeliveryCounts:
    """Return the counts of agents on a network: datagrams sent, accepted, and those not accepted by reason."""
    return DeliveryCounts(agents, slots, sent, heard + sum(not_taken_in.get(name, 0) for name in _WHY), heard)


def recorded_problem(bag: str | Path) -> str:
    """Return the problem in the summary of a flight; empty if there is none beside its directory ``bag``."""
    try:
        summary = json.loads((Path(bag).resolve().parent.parent / "summary.json").read_text(encoding="utf-8"))
        problem = summary.get("unheard")
    except (OSError, ValueError, AttributeError, RecursionError):
        return ""
    return problem[:_LONGEST] if isinstance(problem, str) else ""


def as_sentence(problem: str) -> str:
    """Return a problem as a sentence; empty: none."""
    return f"{problem[:1].upper()}{problem[1:]}." if problem else ""
