"""Turns two different messages into the first field, agent and value that differ, and why the expected one is right."""

from __future__ import annotations

from typing import Any

import numpy as np

from dtsa_agent.core import REASONS, RemoteProtocolError, decode_frame
from dtsa_agent.core.frame import EXTENDED_LENGTH, EXTENT_M, LENGTHS, TAG_LENGTH, ExtendedFrame, decode_extended
from dtsa_bench.recordings.bag.errors import BagError
from dtsa_bench.recordings.bag.reader import Bag, Message
from dtsa_bench.recordings.bag.run import extent_of

from .result import Difference

WHY = {
    "stamp": "slots start one slot length after the other",
    "slot": "slots come one after the other",
    "agent": "each process answers for the same agents in every slot",
    "sender": "a slot message carries the frames that somebody received in the slot before",
    "heard_slot": "what is heard was sent in the slot before",
    "length": "frames have the length of their profile, and only chosen agents send",
    "data": "the codec's bytes of the sender's state",
    "received": "the channel's draw from its seed for this slot",
    "lost": "the channel's draw from its seed for this slot",
    "collided": "two frames in one slot destroy each other",
    "outcome": "who sent decides",
    "chosen": "what the policy gives from what the agent heard",
    "digest": "the agent's table after all that it heard",
    "score": "priority value g of the chosen (eq:permission_d_p_ang)",
    "track": "the vehicle model under the agent's own commands",
    "velocity": "the vehicle model under the agent's own commands",
    "command": "the avoider, from own state and estimates (eq:estimate)",
    "goal": "the scenario",
    "steps": "control instants in a slot",
}
_PLANES = ("track", "velocity", "command", "goal")


def short(value: Any) -> str:
    """A value in a few words."""
    if isinstance(value, np.ndarray):
        return short(value.tolist()) if value.size <= 8 else f"{value.size} values"
    if isinstance(value, float):
        return repr(value)
    text = str(value)
    return text if len(text) <= 120 else text[:117] + "..."


def differing(bag: Bag, recorded: Message, expected: bytes, slot: int) -> Difference:
    """The first difference between a recorded message and the expected bytes."""
    kind = recorded.topic.rsplit("/", 1)[-1]
    agent = int(recorded.topic.split("/")[1][2:]) if kind == "odom" else None
    right = bag.decode(recorded._replace(data=expected))
    try:
        wrong = bag.decode(recorded)
    except BagError as error:
        return Difference(kind, f"a valid {recorded.type}", "bytes that are none", str(error), slot, agent)
    names = [name for name in vars_of(right) if not name.startswith("__")]
    for name in names:
        a, b = getattr(right, name), getattr(wrong, name)
        if same(a, b):
            continue
        if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
            return _in_array(f"{kind}.{name}", name, a, b, right, slot, extent_of(bag.config))
        return Difference(
            f"{kind}.{name}",
            short(_plain(a)),
            short(_plain(b)),
            WHY.get(name, "rebuilt from the run"),
            slot,
            agent,
        )
    at = next((i for i, (a, b) in enumerate(zip(expected, recorded.data, strict=False)) if a != b), len(expected))
    return Difference(
        f"{kind}, byte {at}",
        f"{len(expected)} bytes of CDR",
        f"{len(recorded.data)} bytes, not the same",
        "fields are equal but padding or length is not",
        slot,
        agent,
    )


def vars_of(message: Any) -> list[str]:
    """Names of a message's fields, in order."""
    return list(message.__dataclass_fields__)


def same(a: Any, b: Any) -> bool:
    """Whether two decoded values are equal to the bit."""
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.shape == b.shape and a.tobytes() == b.tobytes()
    if hasattr(a, "__dataclass_fields__"):
        return all(same(getattr(a, name), getattr(b, name)) for name in vars_of(a) if not name.startswith("__"))
    return bool(a == b)


def _plain(value: Any) -> Any:
    if hasattr(value, "sec"):
        return f"{value.sec}.{value.nanosec:09d} s"
    if hasattr(value, "__dataclass_fields__"):
        return {name: _plain(getattr(value, name)) for name in vars_of(value) if not name.startswith("__")}
    return value


def _in_array(
    what: str, name: str, a: np.ndarray, b: np.ndarray, message: Any, slot: int, extent_m: float
) -> Difference:
    why = WHY.get(name, "rebuilt from the run")
    if name == "data":
        return _in_frames(what, a, b, message, slot, why, extent_m)
    if a.shape != b.shape:
        return Difference(what, short(a), short(b), why, slot)
    index = int(np.flatnonzero(a.view(np.uint8).reshape(a.size, -1) != b.view(np.uint8).reshape(b.size, -1))[0])
    index //= a.itemsize
    ids = getattr(message, "agent", None)
    agent = None
    if ids is not None and len(ids):
        agent = int(ids[index % len(ids)]) if name in _PLANES or len(a) == len(ids) else None
    if name == "reason" or name == "reason_index":
        codes = message.reason
        reason = REASONS[codes[index]] if codes[index] < len(REASONS) else str(codes[index])
        return Difference(what, f"{a[index]} ({reason})", str(b[index]), why, slot, agent)
    if name == "chosen":
        codes = message.reason
        why = f"{why}; reason: {REASONS[codes[index]]}"
    return Difference(what, short(a[index].item()), short(b[index].item()), why, slot, agent)


def _in_frames(
    what: str, a: np.ndarray, b: np.ndarray, message: Any, slot: int, why: str, extent_m: float
) -> Difference:
    ids = message.agent if hasattr(message, "agent") else message.sender
    at = 0
    for agent, length in zip(ids, message.length, strict=False):
        right, wrong = a[at : at + length].tobytes(), b[at : at + length].tobytes()
        at += int(length)
        if right != wrong:
            return Difference(what, _frame(right, extent_m), _frame(wrong, extent_m), why, slot, int(agent))
    return Difference(what, f"{a.size} bytes", f"{b.size} bytes", why, slot)


def _frame(data: bytes, extent_m: float = EXTENT_M) -> str:
    """A frame in words, sealed or not."""
    why = ""
    whole = LENGTHS.get(data[0] & 15, 0) if data else 0
    for length, seal in ((len(data), ""), (len(data) - TAG_LENGTH, ", sealed"), (whole, ", and more")):
        try:
            frame = decode_frame(data[:length], extent_m)
            more = _more(decode_extended(data[:length], extent_m)) if length == EXTENDED_LENGTH else ""
        except RemoteProtocolError as error:
            why = why or str(error)
            continue
        place = ", ".join(f"{x:.3f}" for x in frame.position)
        return f"{data.hex()} (cf{frame.sender}, slot {frame.slot}, c_r {frame.c_r}, at {place} m{more}{seal})"
    return f"{data.hex()} (no frame: {why})"


def _more(frame: ExtendedFrame) -> str:
    """What an extended frame says beyond its sender's state."""
    words = [f"c_s {frame.c_s}"] if frame.c_s else []
    words += ["leaving"] if frame.leaving else []
    words += ["on probation"] if frame.probation else []
    words += [f"state of cf{item.agent}, {item.age} slots old" for item in frame.gossip]
    words += [f"leases {frame.leases.hex(' ')}"] if any(frame.leases) else []
    words += [f"relays {', '.join(f'+{ahead}: {lessee}' for ahead, lessee in frame.relay)}"] if frame.relay else []
    words += [f"hands on to {frame.far_lessee}: {', '.join(f'+{ahead}' for ahead in frame.far)}"] if frame.far else []
    return "".join(f", {word}" for word in words)
