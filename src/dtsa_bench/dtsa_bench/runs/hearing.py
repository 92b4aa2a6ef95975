"""Whether the agents of a flight have heard each other; a flight in which they have not counts as failed."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.agents.agent import REFUSED

_WHY = {
    "rejected": "rejected (no tag, or one of another key, session or slot)",
    "malformed": "malformed",
    "foreign": "foreign (of another swarm or time)",
}
_PATIENCE_NS = 1_000_000_000  # of flight, before a page is told that nobody hears anybody
_LONGEST = 500  # characters of what a summary says
_ROUNDS = 2  # as many slots as this times N pass before somebody must have been heard


class Hearing:
    """Counts frames, where they arrived, and where they were taken in.

    :param agents: number of agents N.
    """

    def __init__(self, agents: int) -> None:
        self._agents = agents
        self.slots = self.sent = self.delivered = self.taken_in = 0

    def slot(self, frames: int, received: NDArray[Any]) -> None:
        """A slot is over.

        :param frames: number of frames sent in it.
        :param received: (F, N) 1: the frame arrived there.
        """
        self.slots += 1
        self.sent += frames
        self.delivered += int(np.count_nonzero(received))

    def take_in(self, mask: NDArray[Any]) -> None:
        """A frame was taken in.

        :param mask: (N,) 1: by whom.
        """
        self.taken_in += int(np.count_nonzero(mask))

    def settle(self, not_taken_in: Mapping[str, int]) -> None:
        """What the agents say of what they refused, which nobody else can know if their keys differ.

        :param not_taken_in: number of messages and frames kept out by the agents, by reason.
        """
        self.taken_in = max(0, min(self.taken_in, self.delivered - not_taken_in.get(REFUSED, 0)))

    def problem(self, not_taken_in: Mapping[str, int] | None = None) -> str:
        """Why nobody heard anybody, or why most frames were of no use; empty: neither is so.

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
        return f"{start}: {kept_out}{_reasons(not_taken_in or {})}"


class Unheard:
    """What a page is told of it: once, and again when the kind of the problem changes.

    :param slot_ns: ns, length of a slot.
    """

    def __init__(self, slot_ns: int) -> None:
        self._first, self._told = _PATIENCE_NS // slot_ns, ""

    def news(self, slot: int, problem: str) -> str:
        """The problem if it has to be told now; otherwise empty.

        :param slot: the slot that starts.
        :param problem: of :meth:`Hearing.problem`.
        """
        kind = problem.partition(":")[0]
        if slot < self._first or kind == self._told:
            return ""
        self._told = kind
        return problem


def of_datagrams(agents: int, slots: int, sent: int, heard: int, not_taken_in: Mapping[str, int]) -> Hearing:
    """What agents on a network say of all the frames that reached them.

    :param agents: number of agents that were there.
    :param slots: slots that one of them has flown.
    :param sent: number of datagrams that they have sent.
    :param heard: number of datagrams that they have taken in.
    :param not_taken_in: number of those that they have not, by reason.
    """
    found = Hearing(agents)
    found.slots, found.sent, found.taken_in = slots, sent, heard
    found.delivered = heard + sum(not_taken_in.get(name, 0) for name in _WHY)
    return found


def recorded_problem(bag: str | Path) -> str:
    """What the summary of a flight says of it; empty if there is none beside the bag.

    :param bag: its file, in the flight's directory ``bag``.
    """
    try:
        found = json.loads((Path(bag).resolve().parent.parent / "summary.json").read_text(encoding="utf-8"))
        said = found.get("unheard")
    except (OSError, ValueError, AttributeError):
        return ""
    return said[:_LONGEST] if isinstance(said, str) else ""


def sentence(problem: str) -> str:
    """A problem as a sentence; empty: none."""
    return f"{problem[:1].upper()}{problem[1:]}." if problem else ""


def _reasons(not_taken_in: Mapping[str, int]) -> str:
    counts = {name: not_taken_in.get(name, not_taken_in.get(f"frame {name}", 0)) for name in _WHY}
    known: Iterable[str] = (f"{count} {_WHY[name]}" for name, count in counts.items() if count)
    text = ", ".join(known)
    return f"; the agents' processes count {text}" if text else ""
