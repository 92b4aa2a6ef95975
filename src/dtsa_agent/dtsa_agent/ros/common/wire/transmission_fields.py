"""Transmission messages as agents write them, and the channel reads them, in every slot of a flight in lockstep."""

from __future__ import annotations

import struct
from array import array
from functools import lru_cache
from typing import NamedTuple

from .cdr import FRAME, REPRESENTATION, Layout
from .stamps import SECOND

_AT_COUNT = struct.Struct("<28xI")  # the number of agents


class TransmissionFields(NamedTuple):
    """What a dtsa_msgs/Transmission says, under the names that the fields have there; sequences as their bytes.

    A sequence is as long as the agents are many; ``goal`` may be empty.
    """

    time_ns: int  # the header's stamp
    run: int
    slot: int
    agent: array[int]
    length: bytes
    data: bytes
    chosen: bytes
    reason: bytes
    digest: bytes
    score: bytes
    track: bytes
    velocity: bytes
    command: bytes
    goal: bytes


class TransmissionLayout:
    """Where the fields of a transmission message lie.

    :param agents: number of its agents n.
    :param steps: control instants in a slot.
    """

    def __init__(self, agents: int, steps: int) -> None:
        n, track = agents, 3 * steps * agents
        self._goal = 3 * n
        head = Layout().header().numbers("II").sequence(n, 2).sequence(n, 1).numbers("I")
        self._head, self._fixed = head.struct(), (REPRESENTATION, *FRAME, n, n)
        self._tails = {start: _tail(start, n, track) for start in (0, 4)}
        self._counts = 0, n, n, n, n, steps, track, 3 * n, 3 * n

    def pack(self, fields: TransmissionFields) -> bytes:
        """The message as CDR.

        :param fields: what it says.
        """
        f = fields
        representation, length, frame, n, _ = self._fixed
        seconds, ns = divmod(f.time_ns, SECOND)
        head = self._head.pack(
            representation, seconds, ns, length, frame, f.run, f.slot, n, f.agent.tobytes(), n, f.length, len(f.data)
        )
        start = len(head) + len(f.data)
        gap = -start % 4
        no_offsets, _, _, _, _, steps, track, v, c = self._counts
        tail = self._tails[(start + gap - 4) % 8].pack(
            no_offsets, n, f.chosen, n, f.reason, n, f.digest, n, f.score, steps,
            track, f.track, v, f.velocity, c, f.command, len(f.goal) // 8,
        )  # fmt: skip
        if not f.goal:
            return b"".join((head, f.data, bytes(gap), tail))
        end = start + gap + len(tail)
        return b"".join((head, f.data, bytes(gap), tail, bytes((4 - end) % 8), f.goal))

    def unpack(self, data: bytes) -> TransmissionFields | None:
        """What a message says; None if it is not laid out like this.

        :param data: the message as CDR.
        """
        try:
            head = self._head.unpack_from(data)
            representation, seconds, ns, length, frame, run, slot, n, agent, m, lengths, size = head
            start = self._head.size + size
            frames = data[self._head.size : start]
            start += -start % 4
            tail = self._tails[(start - 4) % 8]
            rest = tail.unpack_from(data, start)
        except struct.error:
            return None
        offsets, n2, chosen, n3, reason, n4, digest, n5, score, steps, t, track, v, velocity, c, command, goals = rest
        if (representation, length, frame, n, m) != self._fixed:
            return None
        if (offsets, n2, n3, n4, n5, steps, t, v, c) != self._counts:
            return None
        goal = b""
        if goals:
            end = start + tail.size
            end += (4 - end) % 8
            goal = data[end : end + 8 * goals]
            if goals != self._goal or len(goal) != 8 * goals:
                return None
        return TransmissionFields(
            seconds * SECOND + ns, run, slot, array("H", agent), lengths, frames,
            chosen, reason, digest, score, track, velocity, command, goal,
        )  # fmt: skip


def _tail(start: int, n: int, track: int) -> struct.Struct:
    """All that follows the frames, up to the number of the goals' coordinates."""
    tail = Layout(start).numbers("I").sequence(n, 2).sequence(n, 1).sequence(n, 4).sequence(n, 8).numbers("B")
    return tail.sequence(track, 8).sequence(3 * n, 8).sequence(3 * n, 8).numbers("I").struct()


@lru_cache(512)
def transmission_layout(agents: int, steps: int) -> TransmissionLayout:
    """The layout of messages of a number of agents.

    :param agents: the number, 1 or more.
    :param steps: control instants in a slot.
    """
    return TransmissionLayout(agents, steps)


def read_transmission(data: bytes, most: int, steps: int) -> TransmissionFields | None:
    """What a message says; None if it is not laid out as agents write it in lockstep.

    :param data: the message as CDR.
    :param most: number of agents that it can be of at most.
    :param steps: control instants in a slot.
    """
    if len(data) < _AT_COUNT.size:
        return None
    (count,) = _AT_COUNT.unpack_from(data)
    return transmission_layout(count, steps).unpack(data) if 0 < count <= most else None
