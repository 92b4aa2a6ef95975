"""What the agents did in one slot, as arrays: of all processes' answers in lockstep, of their reports in real time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import isnan
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.ros.common.cdr import split_frames
from dtsa_agent.ros.common.checks import FARTHEST_M, RANGE, SIZES, SLOT, BadMessage, check_frames, check_ids
from dtsa_agent.ros.common.messages import TRANSMISSION, Fields
from dtsa_agent.ros.common.names import agent_names

Array = NDArray[np.float64]
Places = slice | NDArray[np.intp]

_DECIDED = ("chosen", "reason", "digest", "score")
_MOTION = ("track", "velocity", "command", "goal")
_SEQUENCES = attrgetter("length", *_DECIDED, *_MOTION[:-1])  # the goal may be left out
_LONGEST = 2000  # slots in one report
_MOST_HEARD = 20_000  # received frames in one report
_FARTHEST_OFF_NS = 60_000_000_000  # no agent's slot is farther from the channel's


@dataclass(slots=True)
class FrameReceipt:
    """A frame that agents received during a slot, in real time."""

    slot: int  # as its sender counts
    sender: int  # id
    data: bytes
    arrival_ns: int  # ns, when the receivers' flight processors could have had it, from the start of slot 0
    at_ns: NDArray[np.int64]  # (N,) ns, when each agent received it; -1: it did not

    @property
    def mask(self) -> NDArray[np.bool_]:
        """(N,) which agents received it."""
        return self.at_ns >= 0


class Answers:
    """One entry for each of N agents, with S control instants (``steps``) a slot; vectors are planes of N."""

    def __init__(self, agents: int, steps: int) -> None:
        self.agents, self.steps = agents, steps
        self.answered = np.zeros(agents, dtype=np.bool_)
        self.missing = agents
        self.frames: dict[int, bytes] = {}  # by id, of those that send
        self.chosen = np.zeros(agents, dtype=np.uint16)
        self.reason = np.zeros(agents, dtype=np.uint8)
        self.digest = np.zeros(agents, dtype=np.uint32)
        self.score = np.zeros(agents)
        # All motion lies in one array, as in a message: an answer is written into it at once.
        self._motion = np.zeros((3 * steps + 9, agents))
        self.track = self._motion[:-9].reshape(steps, 3, agents)  # m, at the control instants of the slot before
        self.velocity = self._motion[-9:-6]  # m/s, now
        self.command = self._motion[-6:-3]  # m/s, now
        self.goal = self._motion[-3:]  # m
        self.offset_ns = np.zeros(agents, dtype=np.int64)  # real time: of slot or transmission
        #: In real time: what agents report to have received, by slot and sender; None: in lockstep.
        self.receipts: dict[tuple[int, int], FrameReceipt] | None = None
        self._goal_known = np.zeros(agents, dtype=np.bool_)
        self._lengths: dict[int, tuple[int, ...]] = {}  # of the fields of answers that fit, by number of agents

    @property
    def position(self) -> Array:
        """(3, N) m: true positions now, at the start of the slot that is answered."""
        return self.track[-1]

    @property
    def silent(self) -> list[int]:
        """Ids of the agents that have not answered."""
        return (np.flatnonzero(~self.answered) + 1).tolist()

    def open(self) -> None:
        """Begin a new slot."""
        self.answered[:] = False
        self.missing = self.agents
        self.frames = {}

    def add(self, at: Places, message: Fields) -> bool:
        """Add one transmission message; return False if its agents have answered already: nothing is changed then.

        :param at: places of its agents.
        :raises BadMessage: if its fields do not fit together, naming the agents as far as it does.
        """
        if self.answered[at].any():
            return False
        count = len(message.agent)
        lengths = (message.steps, *map(len, _SEQUENCES(message)))
        if lengths != self._lengths.get(count) or len(message.goal) not in (0, 24 * count):
            sizes = {"length": count, **sizes_of(count, self.steps)}
            if not message.goal:
                del sizes["goal"]
            _check_sizes(TRANSMISSION.arrays(message), sizes, self.steps, "an unusable answer")
            self._lengths[count] = lengths
        frames: list[bytes] = []
        if message.data or any(message.length):
            check_frames(message.length, message.data)
            frames = split_frames(message.data, message.length)
        motion = np.frombuffer(b"".join([getattr(message, name) for name in _MOTION]))
        chosen, score = np.frombuffer(message.chosen, dtype=np.uint16), np.frombuffer(message.score)
        if max(chosen.tolist()) > self.agents:
            raise _unusable(RANGE, message, f"{chosen.max()} chosen of {self.agents} agents")
        # A sum of squares is finite only if all its terms are, and small only if they are.
        if not motion.dot(motion) <= FARTHEST_M**2:
            raise _unusable(RANGE, message, "positions, velocities or goals that are no numbers, or far away")
        if any(map(isnan, score.tolist())):
            raise _unusable(RANGE, message, "scores that are no numbers")
        self._motion[: len(motion) // count, at] = motion.reshape(-1, count)
        self.chosen[at], self.score[at] = chosen, score
        self.reason[at] = np.frombuffer(message.reason, dtype=np.uint8)
        self.digest[at] = np.frombuffer(message.digest, dtype=np.uint32)
        self.answered[at] = True
        if message.goal:
            self._goal_known[at] = True
        for agent, frame in zip(message.agent, frames, strict=False):
            if frame:
                self.frames[agent] = frame
        self.missing -= count
        return True

    def add_report(self, at: Places, message: Fields, row: int) -> None:
        """Add what some agents report for one slot, a row of a report that was checked."""
        count, rows = len(message.agent), len(message.slot)
        motion = [getattr(message, name).reshape(rows, -1)[row] for name in _MOTION]
        self._motion[:, at] = np.concatenate(motion).reshape(-1, count)
        for name in (*_DECIDED, "offset_ns"):
            getattr(self, name)[at] = getattr(message, name)[row * count : (row + 1) * count]
        self._goal_known[at] = self.answered[at] = True
        self.missing -= count

    def carry(self, before: Answers) -> None:
        """Copy what this slot's messages leave out from the slot before: a silent agent stays where it was."""
        gone = ~self.answered
        if gone.any():
            self.track[:, :, gone] = before.position[:, gone]
            self.digest[gone], self.chosen[gone] = before.digest[gone], 0
        # A goal is sent when it changes.
        unknown = ~self._goal_known
        self.goal[:, unknown] = before.goal[:, unknown]


def places_of(ids: Any, agents: int) -> Places:
    """Return the indices of some agents, a slice where they are consecutive.

    :raises BadMessage: for ids that do not ascend from 1 to N.
    """
    check_ids(ids, agents)
    index = np.array(ids, dtype=np.intp) - 1
    return slice(int(index[0]), int(index[-1]) + 1) if index[-1] - index[0] + 1 == len(index) else index


def sizes_of(count: int, steps: int) -> dict[str, int]:
    """Return how many numbers a message has in each field that describes some agents in one slot."""
    motion = {"track": 3 * steps * count, **dict.fromkeys(_MOTION[1:], 3 * count)}
    return {**dict.fromkeys(_DECIDED, count), **motion}


def _check_sizes(message: Fields, sizes: Mapping[str, int], steps: int, what: str) -> None:
    """Check the number of control instants in a slot, and the lengths of arrays."""
    if message.steps != steps:
        raise _unusable(RANGE, message, f"{message.steps} control instants a slot instead of {steps}", what)
    for name, wanted in sizes.items():
        if (length := len(getattr(message, name))) != wanted:
            raise _unusable(SIZES, message, f"{length} numbers in {name} for {len(message.agent)} agents", what)


def _unusable(reason: str, message: Fields, detail: str, what: str = "an unusable answer") -> BadMessage:
    return BadMessage(reason, f"{agent_names(message.agent)} sent {what}: {detail}")


class Accounts:
    """One account a slot in real time, filled by reports.

    Frames are kept for ``keep`` slots, for agents that report late.
    """

    def __init__(self, agents: int, steps: int, keep: int) -> None:
        self.agents, self._steps, self._keep = agents, steps, keep
        self.missed = 0  # entries of reports that came too late to count
        self._open: dict[int, Answers] = {}
        self._closed = -1
        self._delivered: dict[tuple[int, int], tuple[bytes, int, NDArray[np.bool_]]] = {}  # by slot and sender

    def __getitem__(self, slot: int) -> Answers:
        """The account of a slot that is not closed."""
        book = self._open.get(slot)
        if book is None:
            book = self._open[slot] = Answers(self.agents, self._steps)
            book.receipts = {}
        return book

    def last_place(self, agent: int) -> Array | None:
        """Return the last position that an agent has reported, (3,) m; None: in no slot yet."""
        reported = [slot for slot, book in self._open.items() if book.answered[agent - 1]]
        return self._open[max(reported)].position[:, agent - 1] if reported else None

    def deliver(self, slot: int, sender: int, data: bytes, arrival_ns: int, received: NDArray[np.bool_]) -> None:
        """A frame has been sent to its receivers, (N,)."""
        self._delivered[slot, sender] = data, arrival_ns, received

    def add(self, at: Places, message: Fields, latest: int) -> int:
        """Add a report; return its last slot that is still open, -1: none. No slot after ``latest`` can have begun.

        :param at: places of its agents.
        :raises BadMessage: if its fields do not fit together.
        """
        check_report(message, self._steps)
        slots = message.slot.tolist()
        last = max(slots[-1] if slots else 0, max(message.heard_in.tolist(), default=0))
        if last > latest:
            raise BadMessage(SLOT, f"{agent_names(message.agent)} reported slot {last}, which has not begun")
        newest = -1
        for row, slot in enumerate(slots):
            if slot <= self._closed:
                self.missed += len(message.agent)
                continue
            book = self[slot]
            if not book.answered[at].any():  # else reported twice
                book.add_report(at, message, row)
                newest = slot
        for slot, sender, here, at_ns, mask in received_in(message):
            if (slot, sender) not in self._delivered:  # it was not sent to any receiver
                continue
            data, arrival_ns, received = self._delivered[slot, sender]
            receipts = self[max(here, self._closed + 1)].receipts
            assert receipts is not None
            if (slot, sender) not in receipts:
                never = np.full(self.agents, -1, dtype=np.int64)
                receipts[slot, sender] = FrameReceipt(slot, sender, data, arrival_ns, never)
            times = receipts[slot, sender].at_ns
            times[at] = np.where(mask & received[at], max(0, at_ns), times[at])
        return newest

    def close(self, slot: int) -> None:
        """A slot is over: its account and what is too old is forgotten."""
        self._closed = slot
        self._open.pop(slot, None)
        while self._delivered and (oldest := next(iter(self._delivered)))[0] < slot - self._keep:
            del self._delivered[oldest]


def received_in(message: Fields) -> Iterator[tuple[int, int, int, int, NDArray[np.bool_]]]:
    """Give the frames that the agents of a report received: slot, sender, slot here, ns, and by which of them."""
    count = len(message.agent)
    rows = message.heard_by.reshape(-1, -(-count // 8))
    masks = np.unpackbits(rows, axis=1, count=count, bitorder="little").astype(np.bool_)
    columns = (message.heard_slot, message.heard_sender, message.heard_in, message.heard_ns)
    return zip(*(column.tolist() for column in columns), masks, strict=True)


def check_report(message: Fields, steps: int) -> None:
    """Check that the fields of a report fit together.

    :raises BadMessage: if they do not.
    """
    count, slots, heard = len(message.agent), len(message.slot), len(message.heard_sender)
    sizes = {"offset_ns": count * slots, "length": count * slots, **sizes_of(count * slots, steps)}
    sizes |= dict.fromkeys(("heard_slot", "heard_in", "heard_ns"), heard) | {"heard_by": heard * -(-count // 8)}
    _check_sizes(message, sizes, steps, "an unusable report")
    if slots > _LONGEST or (message.slot[1:] <= message.slot[:-1]).any():
        raise _unusable(SLOT, message, "slots that do not ascend, or too many", "a report of")
    if heard > _MOST_HEARD:
        raise _unusable(SIZES, message, f"{heard} frames at once", "a report of")
    offsets = message.offset_ns
    if slots and not -_FARTHEST_OFF_NS <= offsets.min() <= offsets.max() <= _FARTHEST_OFF_NS:
        farthest = np.abs(offsets.astype(np.float64)).max() / 1e9
        raise _unusable(RANGE, message, f"slots {farthest:.3g} s from the channel's", "a report of")
    # A sum of squares is finite only if all its terms are, and small only if they are.
    for name in ("score", *_MOTION):
        values = getattr(message, name)
        with np.errstate(over="ignore"):
            size = values @ values
        if not size <= FARTHEST_M**2:
            raise _unusable(RANGE, message, f"{name} that are no numbers, or beyond {FARTHEST_M:g}", "a report of")
