"""Slot messages as agents read them in every slot."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import NamedTuple

from dtsa_msgs.msg import Slot
from rclpy.serialization import deserialize_message

from .cdr import SECOND, Message
from .stamps import ns_of

_SLOT = Message({
    "run": "I", "slot": "I", "phase": "B", "heard_slot": "I",
    "sender": "*H", "length": "*B", "data": "*B", "received": "*B",
})  # fmt: skip


class SlotFields(NamedTuple):
    """What a dtsa_msgs/Slot says, under the names that the fields have there."""

    time_ns: int  # the header's stamp
    run: int
    slot: int
    phase: int
    heard_slot: int
    sender: Sequence[int]
    length: bytes
    data: bytes
    received: bytes


def read_slot(data: bytes) -> SlotFields:
    """The fields of a slot message.

    :param data: the message as CDR.
    :raises Exception: as rclpy does, if it is none.
    """
    return _read_usual(data) or _fields(deserialize_message(data, Slot))


def _read_usual(data: bytes) -> SlotFields | None:
    """Reads a message that is laid out as channels write it; None: it is not."""
    found = _SLOT.read(data)
    if found is None:
        return None
    seconds, ns, run, slot, phase, heard_slot, sender, length, frames, received = found
    if len(sender) != 2 * len(length):
        return None
    return SlotFields(seconds * SECOND + ns, run, slot, phase, heard_slot, array("H", sender), length, frames, received)


def _fields(message: Slot) -> SlotFields:
    return SlotFields(
        ns_of(message.header.stamp),
        message.run,
        message.slot,
        message.phase,
        message.heard_slot,
        message.sender,
        message.length.tobytes(),
        message.data.tobytes(),
        message.received.tobytes(),
    )
