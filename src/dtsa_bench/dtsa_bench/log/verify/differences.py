"""What differs between an expected and a recorded field, in words: slot, agent, both values, and why."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import REASONS, RemoteProtocolError, decode_frame
from dtsa_agent.core.frame import EXTENDED_LENGTH, EXTENT_M, LENGTHS, TAG_LENGTH, ExtendedFrame, decode_extended
from dtsa_bench.log.arrays import FlightArrays
from dtsa_bench.log.replay import DecisionDifference

from .result import Mismatch

_MOTION = "the vehicle model under the agent's own commands"
_CHOICE = "what the policy gives from what the agent heard"
WHY = {
    "length": "frames have the length of their profile, and only chosen agents send",
    "frame": "the codec's bytes of the sender's state",
    "received": "the channel's draw from its seed for this slot",
    "lost": "the channel's draw from its seed for this slot",
    "collided": "two frames in one slot destroy each other",
    "outcome": "the number of senders decides",
    "chosen": _CHOICE,
    "reason": _CHOICE,
    "digest": "the agent's table after all that it heard",
    "score": "priority value g of the chosen (eq:permission_d_p_ang)",
    "track": _MOTION,
    "velocity": _MOTION,
    "command": "the avoider, from own state and estimates (eq:estimate)",
    "goal": "the scenario",
}


def first_difference(log: FlightArrays, expected: Mapping[str, NDArray[Any]], why: str = "") -> Mismatch | None:
    """The difference in the earliest slot between a log and what its fields should be, to the bit; None: all is equal.

    :param expected: arrays by the log's names; they have a row a slot, `received` a row a frame.
    :param why: the reason of all differences; "": that of the field.
    """
    differences = []
    for name, right in expected.items():
        recorded = getattr(log, name)
        if right.shape != recorded.shape or right.tobytes() == recorded.tobytes():
            continue  # with other frames than expected their length differs
        bits = [np.ascontiguousarray(values).view(np.uint8).reshape(*right.shape, -1) for values in (right, recorded)]
        place = tuple(int(index[0]) for index in np.nonzero((bits[0] != bits[1]).any(axis=-1)))
        row, what, reason = place[0], name, why or WHY[name]
        if name == "received":
            row, sender = (int(values[place[0]]) for values in log.sent_frames[:2])
            what = f"received, frame of cf{sender}"
        if name == "chosen":
            reason += f"; reason: {_reason_text(int(log.reason[place]))}"
        expected_text, recorded_text = (_shown(name, values[place].item(), log) for values in (right, recorded))
        agent = place[-1] + 1 if len(place) > 1 else None
        differences.append((row, Mismatch(what, expected_text, recorded_text, reason, row, agent)))
    return min(differences, key=lambda entry: entry[0])[1] if differences else None


def decision_difference(found: DecisionDifference, log: FlightArrays, why: str) -> Mismatch:
    """A decision of a replayed agent that is not as recorded."""
    expected, recorded = (_shown(found.field, value, log) for value in (found.expected, found.recorded))
    return Mismatch(found.field, expected, recorded, why, found.slot, found.agent)


def frame_difference(expected: dict[int, bytes], recorded: dict[int, bytes], row: int, log: FlightArrays) -> Mismatch:
    """The first frame of a slot that is not as expected; frames by the sender's id."""
    sender = next(agent for agent in sorted({*expected, *recorded}) if expected.get(agent) != recorded.get(agent))
    right, other = (_shown("frame", frames.get(sender, b""), log) for frames in (expected, recorded))
    return Mismatch("frame", right, other, WHY["frame"], row, sender)


def _shown(name: str, value: Any, log: FlightArrays) -> str:
    """A value of a field in words."""
    if name == "frame":
        return describe_frame(value, log.config.swarm.extent_m) if value else "none"
    return f"{value} ({_reason_text(value)})" if name == "reason" else repr(value)


def _reason_text(code: int) -> str:
    return REASONS[code] if code < len(REASONS) else "no reason"


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
