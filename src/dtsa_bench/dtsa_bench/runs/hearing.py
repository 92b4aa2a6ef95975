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
_PATIENCE_NS = 1_000_000_000  # of flight, before a page is told that nobody hears anybody
_LONGEST = 500  # characters of what a summary says
_ROUNDS = 2  # as many slots as this times N pass before somebody must have been heard


class Hearing:
    """Counts frames of N agents, where they arrived, and where they were taken in."""

    def __init__(self, agents: int, slots: int = 0, sent: int = 0, delivered: int = 0, taken_in: int = 0) -> None:
        self._agents = agents
        self.slots, self.sent, self.delivered, self.taken_in = slots, sent, delivered, taken_in

    def slot(self, frames: int, received: NDArray[Any]) -> None:
        """Count a slot that is over; received is (F, N), 1 where a frame arrived."""
        self.slots += 1
        self.sent += frames
        self.delivered += int(np.count_nonzero(received))

    def take_in(self, mask: NDArray[Any]) -> None:
        """Count a frame that agents took in; mask is (N,)."""
        self.taken_in += int(np.count_nonzero(mask))

    def settle(self, not_taken_in: Mapping[str, int]) -> None:
        """Subtract what agents say that they refused, by reason: only they know if their keys differ."""
        self.taken_in = max(0, min(self.taken_in, self.delivered - not_taken_in.get(REFUSED, 0)))

    def problem(self, not_taken_in: Mapping[str, int] | None = None) -> str:
        """Say why no agent heard another, or why most frames were of no use; empty: neither is so.

        :param not_taken_in: number of messages and frames kept out by the agents, by reason.
        """
        if self._agents < 2 or self.slots < _ROUNDS * self._agents or 2 * self.taken_in >= self.delivered > 0:
            return ""
        if not self.sent:
            return f"nobody heard anybody: no frame was sent in {self.slots} slots"
        if not self.delivered:
            return f"nobody heard anybody: {self.sent} frames were sent, and none arrived"
        kept_out = f"of {self.delivered} frames that arrived {self.delivered - self.taken_in} were not taken in"
        start = "most frames were of no use" if self.taken_in else "nobody heard anybody"
        counts = not_taken_in or {}
        known = [(counts.get(name, counts.get(f"frame {name}", 0)), why) for name, why in _WHY.items()]
        text = ", ".join(f"{count} {why}" for count, why in known if count)
        return f"{start}: {kept_out}" + (f"; the agents' processes count {text}" if text else "")


class Unheard:
    """What a page is told of it: once, and again when the kind of the problem changes."""

    def __init__(self, slot_ns: int) -> None:
        self._first, self._told = _PATIENCE_NS // slot_ns, ""

    def news(self, slot: int, problem: str) -> str:
        """Return a :meth:`Hearing.problem` at the start of a slot if it has to be told now; otherwise nothing."""
        kind = problem.partition(":")[0]
        if slot < self._first or kind == self._told:
            return ""
        self._told = kind
        return problem


def of_datagrams(agents: int, slots: int, sent: int, heard: int, not_taken_in: Mapping[str, int]) -> Hearing:
    """Return what agents on a network say: datagrams sent, taken in, and those not taken in by reason."""
    return Hearing(agents, slots, sent, heard + sum(not_taken_in.get(name, 0) for name in _WHY), heard)


def recorded_problem(bag: str | Path) -> str:
    """Return what the summary of a flight says of it; empty if there is none beside its directory ``bag``."""
    try:
        found = json.loads((Path(bag).resolve().parent.parent / "summary.json").read_text(encoding="utf-8"))
        said = found.get("unheard")
    except (OSError, ValueError, AttributeError):
        return ""
    return said[:_LONGEST] if isinstance(said, str) else ""


def sentence(problem: str) -> str:
    """Return a problem as a sentence; empty: none."""
    return f"{problem[:1].upper()}{problem[1:]}." if problem else ""
