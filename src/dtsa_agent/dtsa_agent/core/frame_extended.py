"""The extended frame: fields and bytes. Codec: ``libdtsa/frame_extended.c``, specified in ``reference``."""

from __future__ import annotations

import struct

from .compiled import MISSING
from .compiled import kernel as _kernel
from .errors import LocalProtocolError, RemoteProtocolError
from .frame import (
    _FAULTS,
    EXTENT_M,
    PROFILE_EXTENDED,
    RECORD,
    Frame,
    decode_record,
    encode_record,
    position_step,
    record_of,
)
from .reference import frame_extended as plain
from .reference.frame import EXTENDED_HEAD, EXTENDED_LENGTH
from .reference.frame_extended import OPEN, ExtendedFrame, Gossip

HEAD_LENGTH = EXTENDED_HEAD  # bytes of the sender's own state: enough for who hears only the beginning of a frame

__all__ = [
    "EXTENDED_LENGTH", "HEAD_LENGTH", "OPEN", "ExtendedFrame", "Gossip", "decode_extended", "decode_head",
    "encode_extended",
]  # fmt: skip

# The structure of libdtsa/frame.h after the sender's own fields: c_s, leaving, probation, numbers of gossip and leases,
# mask of the relay; three entries of gossip (id, age, c_r, position, velocity); leases; the relay's lessees.
_REST = struct.Struct("=5iI" + 3 * "3i4x6d" + "33s8s7x")
_ENTRY = 9  # values of one entry
if not MISSING and RECORD.size + _REST.size != _kernel.EXTENDED_RECORD:
    raise ImportError("the compiled kernel is of another version; build dtsa_agent again")


def _rest_of(frame: ExtendedFrame) -> bytes:
    """What an extended frame says of others, as the kernel's structure; none if it does not fit."""
    mask, lessees = 0, [lessee for _, lessee in frame.relay]
    for ahead, _ in frame.relay:
        if not 1 <= ahead <= 24 or mask >> (ahead - 1):
            return b""
        mask |= 1 << (ahead - 1)
    if len(lessees) > 8 or not all(0 < lessee < 256 for lessee in lessees) or len(frame.gossip) > 3:
        return b""
    entries: list[float] = []
    for g in frame.gossip:
        entries += (g.agent, g.age, int(g.moving), *g.position, *g.velocity)
    entries += [0] * (3 * _ENTRY - len(entries))
    numbers = (frame.c_s, frame.leaving, frame.probation, len(frame.gossip), len(frame.leases), mask)
    return _REST.pack(*numbers, *entries, frame.leases, bytes(lessees))


def encode_extended(frame: ExtendedFrame, extent_m: float = EXTENT_M) -> bytes:
    """The bytes of an extended frame.

    :param frame: its fields; positions beyond the extent (gossip: half of it) and velocities beyond +-20.4 m/s (gossip:
        +-10.2 m/s) saturate.
    :param extent_m: largest coordinate that fits, m, as the swarm has agreed.
    :returns: 56 bytes.
    :raises LocalProtocolError: if a field is out of range, or the sections do not fit.
    """
    if MISSING:
        return plain.encode_extended(frame, position_step(extent_m))
    try:
        rest = _rest_of(frame)
    except struct.error as error:
        raise LocalProtocolError(f"not encodable: {frame} ({error})") from error
    data = encode_record(record_of(frame.own, PROFILE_EXTENDED) + rest, extent_m) if rest else b""
    if not data:
        raise LocalProtocolError(f"not encodable: {frame}")
    return data


def decode_extended(data: bytes, extent_m: float = EXTENT_M) -> ExtendedFrame:
    """The fields of an extended frame.

    :param data: the bytes heard, without a tag.
    :param extent_m: largest coordinate that fits, m, as the swarm has agreed.
    :raises RemoteProtocolError: if they are no frame of profile ``extended``.
    """
    if MISSING:
        return plain.decode_extended(data, position_step(extent_m))
    record = decode_record(data, extent_m, extended=True)
    _, sender, slot, c_r, *v = RECORD.unpack_from(record)
    c_s, leaving, probation, gossips, given, mask, *rest = _REST.unpack_from(record, RECORD.size)
    gossip = []
    for at in range(0, gossips * _ENTRY, _ENTRY):
        agent, age, moving, *state = rest[at : at + _ENTRY]
        gossip.append(Gossip(agent, age, bool(moving), (state[0], state[1], state[2]), (state[3], state[4], state[5])))
    leases, relayed = rest[-2:]
    relay = tuple(zip((d for d in range(1, 25) if mask >> (d - 1) & 1), relayed, strict=False))
    own = Frame(sender, slot, c_r, (v[0], v[1], v[2]), (v[3], v[4], v[5]), (v[6], v[7], v[8]))
    return ExtendedFrame(own, c_s, bool(leaving), bool(probation), tuple(gossip), leases[:given], relay)


def decode_head(data: bytes, extent_m: float = EXTENT_M) -> Frame:
    """The sender's own state from the beginning of an extended frame.

    For listeners that get the beginning of a frame alone. It holds the whole state of the sender; what that says about
    others is lost, and the frame cannot be authenticated.

    :param data: 23 bytes or more.
    :param extent_m: largest coordinate that fits, m, as the swarm has agreed.
    :raises RemoteProtocolError: if they are not the beginning of an extended frame.
    """
    if len(data) < HEAD_LENGTH:
        raise RemoteProtocolError(f"{_FAULTS[-1]} ({len(data)} bytes)")
    head = bytearray(data[:HEAD_LENGTH])
    head[3] &= 0x03  # no sections
    return decode_extended(bytes(head) + bytes(EXTENDED_LENGTH - HEAD_LENGTH), extent_m).own
