"""Slot messages as agents read them in every slot."""

from __future__ import annotations

import struct
from array import array
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

from dtsa_msgs.msg import Slot
from rclpy.serialization import deserialize_message

from .cdr import FRAME, REPRESENTATION, Layout, sequence_at
from .stamps import SECOND, ns_of

_MOST = 254  # senders of a message that a struct reads
_head = Layout().header().numbers("IIBII")
_HEAD, _HEAD_END = _head.struct(), _head.end


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
    try:
        representation, seconds, ns, *frame, run, slot, phase, heard_slot, count = _HEAD.unpack_from(data)
        if representation != REPRESENTATION or tuple(frame) != FRAME or count > _MOST:
            return None
        senders = _senders(count)
        sender, lengths, length = senders.unpack_from(data, _HEAD.size)
        end = _HEAD.size + senders.size
        frames, at = sequence_at(data, end + -end % 4)
        received, _ = sequence_at(data, at)
    except struct.error:
        return None
    if lengths != count:
        return None
    return SlotFields(seconds * SECOND + ns, run, slot, phase, heard_slot, array("H", sender), length, frames, received)


@lru_cache(_MOST + 1)
def _senders(count: int) -> struct.Struct:
    """Senders and lengths of frames."""
    return Layout(_HEAD_END).elements(count, 2).sequence(count, 1).struct()


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
