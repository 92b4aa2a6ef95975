"""The extended frame: fields and bytes. Codec: ``libdtsa/frame_extended.c``, specified in ``reference``."""

from __future__ import annotations

import struct

from dtsa_agent.core.reference.frame import EXTENDED_HEAD, EXTENDED_LENGTH
from dtsa_agent.core.reference.frame_extended import OPEN, ExtendedFrame, Gossip

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

HEAD_LENGTH = EXTENDED_HEAD  # bytes of the sender's own state: enough for who hears only the beginning of a frame

__all__ = [
    "EXTENDED_LENGTH", "HEAD_LENGTH", "OPEN", "ExtendedFrame", "Gossip", "decode_extended", "decode_head",
    "encode_extended",
]  # fmt: skip

# The structure of libdtsa/frame.h after the sender's own fields: c_s, leaving, probation, numbers of gossip and leases,
# mask of the relay; three entries of gossip (id, age, c_r, position, velocity); leases; the relay's lessees; the lessee
# and the mask of turns handed on far ahead.
_REST = struct.Struct("=5iI" + 3 * "3i4x6d" + "33s8sB10s4x")
_ENTRY = 9  # values of one entry
_FAR_BYTES = plain.SECTION_BYTES - 1
_NEAR = range(1, plain.RELAY_REACH + 1)  # slots ahead that a relay speaks of
_FAR = range(plain.RELAY_REACH + 1, plain.FAR_REACH + 1)  # ... and that are handed on to one agent
if not MISSING and RECORD.size + _REST.size != _kernel.EXTENDED_RECORD:
    raise ImportError("the compiled kernel is of another version; build dtsa_agent again")


def _mask_of(ahead: tuple[int, ...], reach: range) -> int:
    """A bit for each of the slots ahead; -1 if they are not ascending or not within reach."""
    if any(slots not in reach for slots in ahead) or list(ahead) != sorted(set(ahead)):
        return -1
    return sum(1 << (slots - reach.start) for slots in ahead)


def _slots_of(mask: int, reach: range) -> tuple[int, ...]:
    return tuple(slots for slots in reach if mask >> (slots - reach.start) & 1)


def _rest_of(frame: ExtendedFrame) -> bytes:
    """What an extended frame says of others, as the kernel's structure; none if it does not fit."""
    lessees = [lessee for _, lessee in frame.relay]
    mask, far = _mask_of(tuple(ahead for ahead, _ in frame.relay), _NEAR), _mask_of(frame.far, _FAR)
    if min(mask, far) < 0 or not all(0 < lessee < 256 for lessee in lessees):
        return b""
    if len(lessees) > plain.RELAY_IDS or len(frame.gossip) > plain.SECTIONS:
        return b""
    entries: list[float] = []
    for g in frame.gossip:
        entries += (g.agent, g.age, int(g.moving), *g.position, *g.velocity)
    entries += [0] * (plain.SECTIONS * _ENTRY - len(entries))
    numbers = (frame.c_s, frame.leaving, frame.probation, len(frame.gossip), len(frame.leases), mask)
    others = (frame.leases, bytes(lessees), frame.far_lessee, far.to_bytes(_FAR_BYTES, "little"))
    return _REST.pack(*numbers, *entries, *others)


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
    leases, relayed, far_lessee, far_mask = rest[-4:]
    relay = tuple(zip(_slots_of(mask, _NEAR), relayed, strict=False))
    far = _slots_of(int.from_bytes(far_mask, "little"), _FAR)
    own = Frame(sender, slot, c_r, (v[0], v[1], v[2]), (v[3], v[4], v[5]), (v[6], v[7], v[8]))
    return ExtendedFrame(
        own, c_s, bool(leaving), bool(probation), tuple(gossip), leases[:given], relay, far, far_lessee
    )


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
