"""Transmission messages as agents write them, and the channel reads them, in every slot of a flight in lockstep."""

from __future__ import annotations

from array import array
from typing import NamedTuple

from .cdr import SECOND, Message

_TRANSMISSION = Message({
    "run": "I", "slot": "I", "agent": "*H", "length": "*B", "data": "*B", "offset_ns": "*q", "chosen": "*H",
    "reason": "*B", "digest": "*I", "score": "*d", "steps": "B", "track": "*d", "velocity": "*d", "command": "*d",
    "goal": "*d",
})  # fmt: skip


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


def pack_transmission(fields: TransmissionFields, steps: int) -> bytes:
    """The message as CDR.

    :param fields: what it says.
    :param steps: control instants in a slot.
    """
    time_ns, run, slot, agent, length, data, chosen, reason, digest, score, *motion = fields
    decided = (chosen, reason, digest, score)
    return _TRANSMISSION.pack(time_ns, (run, slot, agent.tobytes(), length, data, b"", *decided, steps, *motion))


def read_transmission(data: bytes, steps: int) -> TransmissionFields | None:
    """What a message says; None if it is not laid out as agents write it in lockstep.

    :param data: the message as CDR.
    :param steps: control instants in a slot.
    """
    found = _TRANSMISSION.read(data)
    if found is None:
        return None
    (seconds, ns, run, slot, agent, lengths, frames, offsets, chosen, reason, digest, score, told_steps, track,
     velocity, command, goal) = found  # fmt: skip
    n = len(lengths)
    told = told_steps, len(agent), len(offsets), len(chosen), len(reason), len(digest), len(score)
    if told != (steps, 2 * n, 0, 2 * n, n, 4 * n, 8 * n) or len(goal) not in (0, 24 * n) or not n:
        return None
    if (len(track), len(velocity), len(command)) != (24 * n * steps, 24 * n, 24 * n):
        return None
    return TransmissionFields(
        seconds * SECOND + ns, run, slot, array("H", agent), lengths, frames,
        chosen, reason, digest, score, track, velocity, command, goal,
    )  # fmt: skip
