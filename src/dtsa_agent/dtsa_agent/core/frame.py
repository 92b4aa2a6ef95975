"""The radio frame: fields and bytes. The codec is ``libdtsa/frame.c``, specified in ``reference/frame.py``."""

from __future__ import annotations

import dataclasses
import struct

from dtsa_agent.core.reference.arithmetic import Vector
from dtsa_agent.core.reference.frame import Frame

from .compiled import MISSING
from .compiled import kernel as _kernel
from .errors import LocalProtocolError, RemoteProtocolError
from .reference import frame as plain
from .reference import tag
from .reference.frame_extended import LEAVING
from .registry import PROFILES

PROFILE_PAPER = PROFILES.index("paper")  # id, c_r, slot, position, velocity: 19 bytes
PROFILE_PAPER_INTENT = PROFILES.index("paper-intent")  # the same and the commanded velocity: 23 bytes
PROFILE_EXTENDED = PROFILES.index("extended")  # 56 bytes

_VERSION = 1
_HEADER_LENGTH = 8  # bytes up to the end of the slot
TAG_LENGTH = tag.LENGTH  # bytes of authentication after a frame, and after what plug-ins append to it

POSITION_STEP = 0.002  # m, one step of a coordinate at the default extent
EXTENT_M = 65.534  # m, default extent: 32767 steps, the largest coordinate that a frame can say

__all__ = [
    "EXTENT_M", "POSITION_STEP", "PROFILE_EXTENDED", "PROFILE_PAPER", "PROFILE_PAPER_INTENT", "TAG_LENGTH", "Frame",
    "Vector", "condition_in", "decode_frame", "encode_frame", "named_in", "position_step",
]  # fmt: skip

# The structure of libdtsa/frame.h: profile, sender, slot, c_r; position, velocity, intent.
RECORD = struct.Struct("=iiIi9d")
if not MISSING and RECORD.size != _kernel.FRAME_RECORD:
    raise ImportError("the compiled kernel is of another version; build dtsa_agent again")

_FAULTS = {-1: "wrong length", -2: "unknown version or profile", -3: "field out of range"}


def position_step(extent_m: float) -> float:
    """One step of a coordinate in frames, m; gossip has twice that.

    :param extent_m: the swarm's setting ``extent_m``, m.
    """
    return POSITION_STEP * (extent_m / EXTENT_M)


def encode_frame(frame: Frame, extent_m: float = EXTENT_M) -> bytes:
    """The bytes of a frame.

    :param frame: its fields; positions beyond the extent and velocities beyond +-20.4 m/s saturate.
    :param extent_m: largest coordinate that fits, m, as the swarm has agreed.
    :returns: 19 bytes, 23 with intent.
    :raises LocalProtocolError: if a field is not a number or an id is out of range.
    """
    if MISSING:
        return plain.encode(frame, position_step(extent_m))
    profile = PROFILE_PAPER if frame.intent is None else PROFILE_PAPER_INTENT
    data = encode_record(record_of(frame, profile), extent_m)
    if not data:
        raise LocalProtocolError(f"not encodable: {frame}")
    return data


def record_of(frame: Frame, profile: int) -> bytes:
    """A frame's own fields as the kernel's structure.

    :param frame: its fields.
    :param profile: number of the profile.
    :raises LocalProtocolError: if a field does not fit.
    """
    slot, intent = frame.slot & 0xFFFFFFFF, frame.intent or (0.0, 0.0, 0.0)
    try:
        return RECORD.pack(profile, frame.sender, slot, frame.c_r, *frame.position, *frame.velocity, *intent)
    except struct.error as error:
        raise LocalProtocolError(f"not encodable: {frame} ({error})") from error


def encode_record(record: bytes, extent_m: float) -> bytes:
    """The bytes of a frame from the kernel's structure; none if it is not encodable.

    :param record: the structure.
    :param extent_m: largest coordinate that fits, m.
    """
    return _kernel.encode(record, position_step(extent_m))


def decode_record(data: bytes, extent_m: float, extended: bool = False) -> bytes:
    """The kernel's structure from the bytes of a frame.

    :param data: the bytes heard.
    :param extent_m: largest coordinate that fits, m.
    :param extended: the structure of extended frames, not that of all profiles.
    :raises RemoteProtocolError: if they are no frame.
    """
    record = _kernel.decode(bytes(data), position_step(extent_m), extended)
    if isinstance(record, int):
        raise RemoteProtocolError(f"{_FAULTS[record]} ({len(data)} bytes)")
    return record


def named_in(data: bytes) -> tuple[int, int] | None:
    """The id of the sender and the slot (32 bits) that a frame of any profile names; None: it is none.

    :param data: the bytes, whatever follows a frame in them: bytes of plug-ins, a tag.
    """
    if len(data) < _HEADER_LENGTH or data[0] >> 4 != _VERSION or data[0] & 15 >= len(PROFILES):
        return None
    sender = data[1] if data[0] & 15 == PROFILE_EXTENDED else int.from_bytes(data[1:3], "little")
    return sender, int.from_bytes(data[4:8], "little")


def condition_in(data: bytes) -> tuple[bool, bool, bool]:
    """Whether the sender of a frame leaves, rests, is on probation; extended frames alone say the first and the last.

    :param data: the bytes of a frame, at least those that :func:`named_in` reads.
    """
    if data[0] & 15 != PROFILE_EXTENDED:
        return False, not data[3], False
    return data[2] == LEAVING, not data[3] & 1, bool(data[3] & 2)


def decode_frame(data: bytes, extent_m: float = EXTENT_M) -> Frame:
    """The fields of a frame that all profiles have.

    :param data: the bytes heard.
    :param extent_m: largest coordinate that fits, m, as the swarm has agreed.
    :raises RemoteProtocolError: if they are no frame: sealed ones are opened first.
    """
    if MISSING:
        heard = plain.decode(data, position_step(extent_m))
        return dataclasses.replace(heard, intent=None) if data[0] & 15 == PROFILE_EXTENDED else heard
    profile, sender, slot, c_r, *v = RECORD.unpack(decode_record(data, extent_m))
    intent = (v[6], v[7], v[8]) if profile == PROFILE_PAPER_INTENT else None
    return Frame(sender, slot, c_r, (v[0], v[1], v[2]), (v[3], v[4], v[5]), intent)
