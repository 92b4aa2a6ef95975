"""Reports as agents write them, and the channel reads them, ten times a second each in real time."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from dtsa_msgs.msg import Report
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message

from .cdr import SECOND, Message
from .stamps import ns_of

_REPORT = Message({
    "run": "I", "agent": "*H", "slot": "*I", "offset_ns": "*q", "length": "*B", "chosen": "*H", "reason": "*B",
    "digest": "*I", "score": "*d", "steps": "B", "track": "*d", "velocity": "*d", "command": "*d", "goal": "*d",
    "heard_sender": "*H", "heard_slot": "*I", "heard_in": "*I", "heard_ns": "*q", "heard_by": "*B",
})  # fmt: skip


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
    told = {**sequences, "run": run, "steps": steps}
    return _REPORT.pack(time_ns, [told[name] for name in _REPORT.fields])


def read_report(data: bytes) -> ReportFields:
    """What a message says. Whether its fields fit together is not looked at.

    :param data: the message as CDR.
    :raises Exception: of any kind, as rclpy does, if it is none.
    """
    found = _read_usual(data)
    return _fields(deserialize_message(data, Report)) if found is None else found


def _fields(message: Report) -> ReportFields:
    told = (getattr(message, name) for name in _REPORT.fields)
    return _made(ns_of(message.header.stamp), told)


def _read_usual(data: bytes) -> ReportFields | None:
    """What a message says; None if it is not laid out as agents write it."""
    found = _REPORT.read(data)
    if found is None:
        return None
    seconds, ns, *told = found
    return _made(seconds * SECOND + ns, told)


def _made(time_ns: int, told: Iterable[Any]) -> ReportFields:
    """Fields in the message's order as a tuple, sequences as arrays."""
    run, agent, *rest = told
    arrays = (value if isinstance(value, int) else np.frombuffer(value, kind)
              for value, kind in zip(rest, _REPORT.kinds[2:], strict=True))  # fmt: skip
    return ReportFields(time_ns, run, array("H", bytes(agent)), *arrays)
