"""What differs between an expected and a recorded field, in words: slot, agent, both values, and why."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import REASONS, RemoteProtocolError, decode_frame
from dtsa_agent.core.frame import EXTENDED_LENGTH, EXTENT_M, LENGTHS, TAG_LENGTH, ExtendedFrame, decode_extended
from dtsa_bench.log.arrays import FlightArrays
from dtsa_bench.log.replay import DecisionDifference

from .result import Difference, Mismatch

WHY = {
    "known": "every agent answers every slot once",
    "length": "frames have the length of their profile, and only chosen agents send",
    "frame": "the codec's bytes of the sender's state",
    "received": "the channel's draw from its seed for this slot",
    "lost": "the channel's draw from its seed for this slot",
    "collided": "two frames in one slot destroy each other",
    "outcome": "the number of senders decides",
    "chosen": "what the policy gives from what the agent heard",
    "reason": "what the policy gives from what the agent heard",
    "digest": "the agent's table after all that it heard",
    "score": "priority value g of the chosen (eq:permission_d_p_ang)",
    "track": "the vehicle model under the agent's own commands",
    "velocity": "the vehicle model under the agent's own commands",
    "command": "the avoider, from own state and estimates (eq:estimate)",
    "goal": "the scenario",
}


def first_difference(
    name: str, expected: NDArray[Any], recorded: NDArray[Any], first: int, log: FlightArrays
) -> tuple[int, Mismatch]:
    """The first difference of arrays that have a row a slot, to the bit; the last axis is that of agents."""
    size = expected.dtype.itemsize
    pairs = [
        np.ascontiguousarray(values).view(np.uint8).reshape(*values.shape, size) for values in (expected, recorded)
    ]
    place = tuple(int(index[0]) for index in np.nonzero((pairs[0] != pairs[1]).any(axis=-1)))
    values = expected[place].item(), recorded[place].item()
    row = first + place[0]
    agent = place[-1] + 1 if len(place) > 1 else None
    shown = [repr(value) for value in values]
    why = WHY.get(name, "it follows from the agents' records")
    if name == "reason":
        shown = [_reason_text(code) for code in values]
    if name == "chosen":
        code = int(log.reason[row, place[-1]])
        why = f"{why}; reason: {REASONS[code] if code < len(REASONS) else code}"
    return row, Mismatch(Difference(name, *shown, why, row, agent))


def decision_difference(found: DecisionDifference, log: FlightArrays, why: str) -> Mismatch:
    """A decision of a replayed agent that is not as recorded."""
    values: list[Any] = [found.expected, found.recorded]
    if found.field == "frame":
        shown = [describe_frame(data, log.config.swarm.extent_m) if data else "none" for data in values]
    else:
        shown = [_reason_text(code) if found.field == "reason" else repr(code) for code in values]
    return Mismatch(Difference(found.field, *shown, why, found.slot, found.agent))


def _reason_text(code: int) -> str:
    return f"{code} ({REASONS[code] if code < len(REASONS) else 'no reason'})"


def frame_difference(expected: dict[int, bytes], recorded: dict[int, bytes], row: int, extent_m: float) -> Mismatch:
    """The first frame of a slot that is not as expected; frames by the sender's id."""
    sender = next(agent for agent in sorted({*expected, *recorded}) if expected.get(agent) != recorded.get(agent))
    shown = [
        describe_frame(frames[sender], extent_m) if sender in frames else "none" for frames in (expected, recorded)
    ]
    return Mismatch(Difference("frame", *shown, WHY["frame"], row, sender))


def describe_frame(data: bytes, extent_m: float = EXTENT_M) -> str:
    """A frame in words, sealed or not."""
    why = ""
    whole = LENGTHS.get(data[0] & 15, 0) if data else 0
    for length, seal in ((len(data), ""), (len(data) - TAG_LENGTH, ", sealed"), (whole, ", and more")):
        try:
            frame = decode_frame(data[:length], extent_m)
            more = _extension(decode_extended(data[:length], extent_m)) if length == EXTENDED_LENGTH else ""
        except RemoteProtocolError as error:
            why = why or str(error)
            continue
        place = ", ".join(f"{x:.3f}" for x in frame.position)
        return f"{data.hex()} (cf{frame.sender}, slot {frame.slot}, c_r {frame.c_r}, at {place} m{more}{seal})"
    return f"{data.hex()} (no frame: {why})"


def _extension(frame: ExtendedFrame) -> str:
    """What an extended frame says beyond its sender's state."""
    words = [f"c_s {frame.c_s}"] if frame.c_s else []
    words += ["leaving"] if frame.leaving else []
    words += ["on probation"] if frame.probation else []
    words += [f"state of cf{item.agent}, {item.age} slots old" for item in frame.gossip]
    words += [f"leases {frame.leases.hex(' ')}"] if any(frame.leases) else []
    words += [f"relays {', '.join(f'+{ahead}: {lessee}' for ahead, lessee in frame.relay)}"] if frame.relay else []
    words += [f"hands on to {frame.far_lessee}: {', '.join(f'+{ahead}' for ahead in frame.far)}"] if frame.far else []
    return "".join(f", {word}" for word in words)
