"""Reports as agents write them, and the channel reads them, ten times a second each in real time."""

from __future__ import annotations

import struct
from array import array
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from dtsa_msgs.msg import Report
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message

from .cdr import FRAME, REPRESENTATION
from .stamps import SECOND, ns_of

_HEAD = struct.Struct("<4siII4sI")  # representation, header in frame map, run
_COUNT = struct.Struct("<I")
_BODY = len(REPRESENTATION)  # alignment counts from here
_BEFORE = {  # the sequences before and behind the number of control instants, in the message's order
    "agent": np.uint16, "slot": np.uint32, "offset_ns": np.int64, "length": np.uint8, "chosen": np.uint16,
    "reason": np.uint8, "digest": np.uint32, "score": np.float64,
}  # fmt: skip
_BEHIND = {
    "track": np.float64, "velocity": np.float64, "command": np.float64, "goal": np.float64, "heard_sender": np.uint16,
    "heard_slot": np.uint32, "heard_in": np.uint32, "heard_ns": np.int64, "heard_by": np.uint8,
}  # fmt: skip
_SIZE = {name: np.dtype(kind).itemsize for name, kind in (_BEFORE | _BEHIND).items()}


class ReportFields(NamedTuple):
    """What a dtsa_msgs/Report says, under the names that the fields have there; sequences as flat arrays."""

    time_ns: int  # the header's stamp
    run: int
    agent: array[int]
    slot: NDArray[np.uint32]
    offset_ns: NDArray[np.int64]
    length: NDArray[np.uint8]
    chosen: NDArray[np.uint16]
    reason: NDArray[np.uint8]
    digest: NDArray[np.uint32]
    score: NDArray[np.float64]
    steps: int
    track: NDArray[np.float64]
    velocity: NDArray[np.float64]
    command: NDArray[np.float64]
    goal: NDArray[np.float64]
    heard_sender: NDArray[np.uint16]
    heard_slot: NDArray[np.uint32]
    heard_in: NDArray[np.uint32]
    heard_ns: NDArray[np.int64]
    heard_by: NDArray[np.uint8]


def pack_report(time_ns: int, run: int, steps: int, sequences: Mapping[str, bytes]) -> bytes:
    """A dtsa_msgs/Report as CDR.

    :param time_ns: ns, the header's stamp.
    :param run: the run's id.
    :param steps: control instants in a slot.
    :param sequences: the other fields, as their elements' bytes.
    """
    data = bytearray(_HEAD.pack(REPRESENTATION, *divmod(time_ns, SECOND), *FRAME, run))
    for name in _BEFORE:
        _append(data, sequences[name], _SIZE[name])
    data.append(steps)
    for name in _BEHIND:
        _append(data, sequences[name], _SIZE[name])
    return bytes(data)


def _append(data: bytearray, elements: bytes, size: int) -> None:
    data += bytes(-(len(data) - _BODY) % _COUNT.size) + _COUNT.pack(len(elements) // size)
    if elements:
        data += bytes(-(len(data) - _BODY) % size) + elements


def read_report(data: bytes) -> ReportFields:
    """What a message says. Whether its fields fit together is not looked at.

    :param data: the message as CDR.
    :raises Exception: of any kind, as rclpy does, if it is none.
    """
    found = _read_usual(data)
    return _fields(deserialize_message(data, Report)) if found is None else found


def _fields(message: Report) -> ReportFields:
    kinds = {name: kind for name, kind in (_BEFORE | _BEHIND).items() if name != "agent"}
    arrays = {name: np.frombuffer(getattr(message, name), kind) for name, kind in kinds.items()}
    return ReportFields(ns_of(message.header.stamp), message.run, message.agent, steps=message.steps, **arrays)


def _read_usual(data: bytes) -> ReportFields | None:
    """What a message says; None if it is not laid out as agents write it."""
    found: dict[str, Any] = {}
    try:
        representation, seconds, ns, length, frame, run = _HEAD.unpack_from(data)
        at = _read(data, _HEAD.size, _BEFORE, found)
        steps = data[at]
        at = _read(data, at + 1, _BEHIND, found)
    except (struct.error, ValueError, IndexError):
        return None
    if (representation, length, frame) != (REPRESENTATION, *FRAME) or not at <= len(data) <= at + _BODY:
        return None
    found["agent"] = array("H", found["agent"].tobytes())
    return ReportFields(seconds * SECOND + ns, run, steps=steps, **found)


def _read(data: bytes, at: int, kinds: Mapping[str, Any], found: dict[str, Any]) -> int:
    """Reads sequences from a place on, and says where they end."""
    for name, kind in kinds.items():
        at += -(at - _BODY) % _COUNT.size
        (count,) = _COUNT.unpack_from(data, at)
        at += _COUNT.size
        size = _SIZE[name]
        if count:
            at += -(at - _BODY) % size
        found[name] = np.frombuffer(data, kind, count, at) if count else np.zeros(0, kind)
        at += count * size
    return at
