"""What the agents' reports say about slots that are not over yet, in real time."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.ros.common.graph.names import named
from dtsa_agent.ros.common.wire.checks import FARTHEST_M, RANGE, SIZES, SLOT, Unusable, check_ids
from dtsa_agent.ros.common.wire.report_fields import ReportFields

from .answers import Answers, TakenIn

_LONGEST = 2000  # slots in one report
_MOST_HEARD = 20_000  # frames taken in, in one report
_FARTHEST_OFF_NS = 60_000_000_000  # no agent's slot is farther from the channel's
_FLOATS = ("score", "track", "velocity", "command", "goal")
_DECIDED = ("chosen", "reason", "digest", "score")
_MOTION = ("track", "velocity", "command", "goal")


class Delivered(NamedTuple):
    """A frame that was sent to its receivers."""

    data: bytes
    arrival_ns: int
    received: NDArray[np.bool_]  # (N,)


class Accounts:
    """One account a slot, filled by reports; frames are kept for ``keep`` slots, for agents that report late."""

    def __init__(self, agents: int, steps: int, keep: int) -> None:
        self.agents, self._steps, self._keep = agents, steps, keep
        self.missed = 0  # entries of reports that came too late to count
        self._open: dict[int, Answers] = {}
        self._closed = -1
        self._delivered: dict[tuple[int, int], Delivered] = {}  # by slot and sender
        self._taken_in: dict[int, dict[tuple[int, int], TakenIn]] = {}
        self._places: dict[bytes, slice | NDArray[np.intp]] = {}

    def __getitem__(self, slot: int) -> Answers:
        """The account of a slot that is not closed."""
        book = self._open.get(slot)
        if book is None:
            book = self._open[slot] = Answers(self.agents, self._steps)
        return book

    def silent(self, slot: int) -> list[int] | None:
        """Ids of the agents that have not reported for a slot; None: nobody has."""
        book = self._open.get(slot)
        return None if book is None else book.silent

    def last_place(self, agent: int) -> NDArray[np.float64] | None:
        """Where an agent has reported to be last, (3,) m; None: in no slot yet."""
        reported = [slot for slot, book in self._open.items() if book.answered[agent - 1]]
        return self._open[max(reported)].position[:, agent - 1] if reported else None

    def deliver(self, slot: int, sender: int, delivered: Delivered) -> None:
        """A frame has been sent to its receivers."""
        self._delivered[slot, sender] = delivered

    def add(self, message: ReportFields, latest: int) -> int:
        """Add a report; return its last slot that is still open, -1: none. No slot after ``latest`` can have begun.

        :raises Unusable: if its fields do not fit together.
        """
        at, count = self._where(message.agent), len(message.agent)
        _check(message, count, self._steps)
        slots = message.slot.tolist()
        last = max(slots[-1] if slots else 0, max(message.heard_in.tolist(), default=0))
        if last > latest:
            raise Unusable(SLOT, f"{named(message.agent)} reported slot {last}, which has not begun")
        fields = {name: getattr(message, name) for name in _DECIDED}
        motion = [getattr(message, name).reshape(len(slots), -1) for name in _MOTION] if slots else []
        newest = -1
        for row, slot in enumerate(slots):
            if slot <= self._closed:
                self.missed += count
                continue
            book = self[slot]
            if book.answered[at].any():
                continue  # told twice
            part = slice(row * count, (row + 1) * count)
            decided = {name: values[part] for name, values in fields.items()}
            book.put(at, count, message.offset_ns[part], [planes[row] for planes in motion], **decided)
            newest = slot
        self._take_in(message, at, count)
        return newest

    def _take_in(self, message: ReportFields, at: slice | NDArray[np.intp], count: int) -> None:
        """What some agents have taken in, by the slot in which they did; what was not delivered to them is left out."""
        if not len(message.heard_sender):
            return
        width = -(-count // 8)
        rows = message.heard_by.reshape(-1, width)
        masks = np.unpackbits(rows, axis=1, count=count, bitorder="little").astype(np.bool_)
        told = (message.heard_slot, message.heard_sender, message.heard_in, message.heard_ns)
        for slot, sender, here, at_ns, mask in zip(*(column.tolist() for column in told), masks, strict=True):
            found = self._delivered.get((slot, sender))
            if found is None:
                continue
            entries = self._taken_in.setdefault(max(here, self._closed + 1), {})
            taken = entries.get((slot, sender))
            if taken is None:
                nobody = np.full(self.agents, -1, dtype=np.int64)
                taken = entries[slot, sender] = TakenIn(slot, sender, found.data, found.arrival_ns, nobody)
            taken.at_ns[at] = np.where(mask & found.received[at], max(0, at_ns), taken.at_ns[at])

    def close(self, slot: int) -> None:
        """A slot is over: its account and what is too old is forgotten."""
        self._closed = slot
        self._open.pop(slot, None)
        self._taken_in.pop(slot, None)
        while self._delivered and (oldest := next(iter(self._delivered)))[0] < slot - self._keep:
            del self._delivered[oldest]

    def taken_in(self, slot: int) -> list[TakenIn]:
        """What agents took in during a slot, as far as they have told."""
        return list(self._taken_in.get(slot, {}).values())

    def _where(self, ids: Any) -> slice | NDArray[np.intp]:
        """Indices of a message's agents, a slice where they are consecutive."""
        key = ids.tobytes()
        known = self._places.get(key)
        if known is None:
            check_ids(ids, self.agents)
            index = np.array(ids, dtype=np.intp) - 1
            run = index[-1] - index[0] + 1 == len(index)
            known = slice(int(index[0]), int(index[-1]) + 1) if run else index
            self._places[key] = known
        return known


def _check(message: ReportFields, count: int, steps: int) -> None:
    """Whether the fields of a report fit together.

    :raises Unusable: if they do not.
    """
    entries, heard = len(message.slot) * count, len(message.heard_sender)
    planes = {"track": 3 * steps, "velocity": 3, "command": 3, "goal": 3}
    wanted = dict.fromkeys(("offset_ns", "length", *_DECIDED), entries)
    wanted |= {name: number * entries for name, number in planes.items()}
    wanted |= dict.fromkeys(("heard_slot", "heard_in", "heard_ns"), heard) | {"heard_by": heard * -(-count // 8)}
    wrong = [name for name, length in wanted.items() if len(getattr(message, name)) != length]
    who = named(message.agent)
    if message.steps != steps:
        raise Unusable(RANGE, f"{who} reported {message.steps} control instants a slot instead of {steps}")
    if wrong or not count:
        raise Unusable(SIZES, f"{who} sent a report in which {', '.join(wrong)} do not fit")
    if len(message.slot) > _LONGEST or (message.slot[1:] <= message.slot[:-1]).any():
        raise Unusable(SLOT, f"{who} reported slots that do not ascend, or too many")
    if heard > _MOST_HEARD:
        raise Unusable(SIZES, f"{who} reported {heard} frames at once")
    offsets = message.offset_ns
    if entries and not -_FARTHEST_OFF_NS <= offsets.min() <= offsets.max() <= _FARTHEST_OFF_NS:
        farthest = np.abs(offsets.astype(np.float64)).max() / 1e9
        raise Unusable(RANGE, f"{who} reported slots {farthest:.3g} s from the channel's")
    # A sum of squares is finite only if all its terms are, and small only if they are.
    for name in _FLOATS:
        values = getattr(message, name)
        with np.errstate(over="ignore"):
            size = values @ values
        if not size <= FARTHEST_M**2:
            raise Unusable(RANGE, f"{who} reported {name} that are no numbers, or beyond {FARTHEST_M:g}")
