"""What the agents did in one slot, as arrays: from the messages of all processes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isnan
from typing import Any

import numpy as np
from dtsa_msgs.msg import Transmission
from numpy.typing import NDArray

from dtsa_agent.ros.common.graph.names import named
from dtsa_agent.ros.common.wire.checks import FARTHEST_M, RANGE, SIZES, UNKNOWN, Unusable, check_frames
from dtsa_agent.ros.common.wire.packing import split_frames
from dtsa_agent.ros.common.wire.transmission_fields import TransmissionFields

Array = NDArray[np.float64]
_ONES = b"\1" * 65536  # at most so many agents have ids


@dataclass(slots=True)
class TakenIn:
    """A frame that agents took in during a slot, in real time."""

    slot: int  # as its sender counts
    sender: int  # id
    data: bytes
    arrival_ns: int  # ns, when the receivers' flight processors could have had it, from the start of slot 0
    at_ns: NDArray[np.int64]  # (N,) ns, when each agent took it in; -1: it did not

    @property
    def mask(self) -> NDArray[np.bool_]:
        """(N,) who took it in."""
        return self.at_ns >= 0


class Answers:
    """One entry for each of N agents, with S control instants (``steps``) a slot; vectors are planes of N."""

    def __init__(self, agents: int, steps: int) -> None:
        self.agents, self.steps = agents, steps
        # Vectors that lie in bytes: those of a message are put into their place as they are.
        self._answered, self._told = bytearray(agents), bytearray(agents)
        self._chosen, self._reason = bytearray(2 * agents), bytearray(agents)
        self._digest, self._score = bytearray(4 * agents), bytearray(8 * agents)
        self.answered = np.frombuffer(self._answered, dtype=np.bool_)
        self.missing = agents
        self.frames: dict[int, bytes] = {}  # by id, of those that send
        self.chosen = np.frombuffer(self._chosen, dtype=np.uint16)
        self.reason = np.frombuffer(self._reason, dtype=np.uint8)
        self.digest = np.frombuffer(self._digest, dtype=np.uint32)
        self.score = np.frombuffer(self._score)
        # All motion lies in one array, as in a message: who answers is written into it at once.
        self._motion = np.zeros((3 * steps + 9, agents))
        self.track = self._motion[:-9].reshape(steps, 3, agents)  # m, at the control instants of the slot before
        self.velocity = self._motion[-9:-6]  # m/s, now
        self.command = self._motion[-6:-3]  # m/s, now
        self.goal = self._motion[-3:]  # m
        self.offset_ns = np.zeros(agents, dtype=np.int64)  # real time: of slot or transmission
        self.taken_in: list[TakenIn] | None = None  # real time: what the agents say to have taken in during the slot
        self._goal_told = np.frombuffer(self._told, dtype=np.bool_)
        self._layouts: dict[bytes, tuple[int, slice | NDArray[np.intp]]] = {}
        # Numbers an agent in each field of a message, beside the frames' bytes.
        self._sizes = {
            "length": 1, "chosen": 1, "reason": 1, "digest": 1, "score": 1,
            "track": 3 * steps, "velocity": 3, "command": 3, "goal": 3,
        }  # fmt: skip

    @property
    def position(self) -> Array:
        """(3, N) m: true positions now, at the start of the slot that is answered."""
        return self.track[-1]

    @property
    def silent(self) -> list[int]:
        """Ids of the agents that have not answered."""
        return (np.flatnonzero(~self.answered) + 1).tolist()

    def open(self) -> None:
        """Begins a new slot."""
        self._answered[:] = bytes(self.agents)
        self.missing = self.agents
        self.frames = {}

    def add(self, message: TransmissionFields | Transmission) -> bool:
        """Add one transmission message; return False if its agents have answered already: nothing is changed then.

        :raises Unusable: if its fields do not fit together, naming the agents as far as it does.
        """
        count, at = self._where(message.agent)
        if isinstance(at, slice):
            first, last = at.start, at.stop
            if 1 in self._answered[first:last]:
                return False
        elif self.answered[at].any():
            return False
        fields = message if isinstance(message, TransmissionFields) else self._fields(message, count)
        frames: list[bytes] = []
        if fields.data or any(fields.length):
            check_frames(fields.length, fields.data)
            frames = split_frames(fields.data, fields.length)
        motion = np.frombuffer(b"".join((fields.track, fields.velocity, fields.command, fields.goal)))
        self._check_numbers(message, motion, fields)
        self._motion[: len(motion) // count, at] = motion.reshape(-1, count)
        if isinstance(at, slice):
            self._chosen[2 * first : 2 * last] = fields.chosen
            self._reason[at] = fields.reason
            self._digest[4 * first : 4 * last] = fields.digest
            self._score[8 * first : 8 * last] = fields.score
            self._answered[at] = _ONES[:count]
            if fields.goal:
                self._told[at] = _ONES[:count]
        else:
            self.chosen[at] = np.frombuffer(fields.chosen, dtype=np.uint16)
            self.reason[at] = np.frombuffer(fields.reason, dtype=np.uint8)
            self.digest[at] = np.frombuffer(fields.digest, dtype=np.uint32)
            self.score[at] = np.frombuffer(fields.score)
            self.answered[at] = True
            if fields.goal:
                self._goal_told[at] = True
        for agent, frame in zip(message.agent, frames, strict=False):
            if frame:
                self.frames[agent] = frame
        self.missing -= count
        return True

    def put(self, at: Any, count: int, offset_ns: Any, motion: Sequence[Array], **decided: Any) -> None:
        """Add what agents have reported in real time, checked: start of their slots or transmissions, motion, decision.

        Their indices are ``at``; motion is track (m), velocity, command (m/s) and goal (m), as in a report.
        """
        track, velocity, command, goal = motion
        self.track[:, :, at] = track.reshape(self.steps, 3, count)
        for mine, given in ((self.velocity, velocity), (self.command, command), (self.goal, goal)):
            mine[:, at] = given.reshape(3, count)
        for name, values in decided.items():
            getattr(self, name)[at] = values
        self.offset_ns[at] = offset_ns
        self._goal_told[at] = self.answered[at] = True
        self.missing -= count

    def _fields(self, message: Transmission, count: int) -> TransmissionFields:
        """The fields of a message, as long as its agents are many.

        :raises Unusable: if they are not.
        """
        if message.steps != self.steps:
            raise self._unusable(RANGE, message, f"{message.steps} control instants a slot instead of {self.steps}")
        for name, size in self._sizes.items():
            found, wanted = len(getattr(message, name)), size * count
            if found != wanted and (name != "goal" or found):
                raise self._unusable(SIZES, message, f"{found} numbers in {name} for {count} agents")
        told = {name: getattr(message, name).tobytes() for name in (*self._sizes, "data")}
        return TransmissionFields(0, message.run, message.slot, message.agent, **told)

    def _check_numbers(
        self, message: TransmissionFields | Transmission, motion: Array, fields: TransmissionFields
    ) -> None:
        """Whether the numbers of a message can be.

        :raises Unusable: if they cannot.
        """
        largest = max(memoryview(fields.chosen).cast("H"))
        if largest > self.agents:
            raise self._unusable(RANGE, message, f"{largest} chosen of {self.agents} agents")
        # A sum of squares is finite only if all its terms are, and small only if they are.
        if not motion.dot(motion) <= FARTHEST_M**2:
            raise self._unusable(RANGE, message, "positions, velocities or goals that are no numbers, or far away")
        if any(map(isnan, memoryview(fields.score).cast("d"))):
            raise self._unusable(RANGE, message, "scores that are no numbers")

    @staticmethod
    def _unusable(reason: str, message: Any, detail: str) -> Unusable:
        return Unusable(reason, f"{named(message.agent)} sent an unusable answer: {detail}")

    def carry(self, before: Answers) -> None:
        """Takes over from the slot before what nobody has told about this one: who is silent stays where it was."""
        gone = ~self.answered
        if gone.any():
            self.track[:, :, gone] = before.position[:, gone]
            self.digest[gone], self.chosen[gone] = before.digest[gone], 0
        # A goal is told when it changes.
        untold = ~self._goal_told
        self.goal[:, untold] = before.goal[:, untold]

    def _where(self, ids: Any) -> tuple[int, slice | NDArray[np.intp]]:
        """Number and indices of a message's agents, and a slice instead where they are consecutive."""
        key = ids.tobytes()
        known = self._layouts.get(key)
        if known is None:
            index = np.array(ids, dtype=np.intp) - 1
            if not len(index) or index[0] < 0 or index[-1] >= self.agents or (np.diff(index) <= 0).any():
                raise Unusable(
                    UNKNOWN, f"a message for agents {list(ids[:8])}; allowed: ascending ids from 1 to {self.agents}"
                )
            run = index[-1] - index[0] + 1 == len(index)
            known = len(index), slice(int(index[0]), int(index[-1]) + 1) if run else index
            self._layouts[key] = known
        return known
