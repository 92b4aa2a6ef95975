"""The radio frame: its fields, and its bytes by the codec in C. Layout: docs/reference/protocol.md."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from .errors import LocalProtocolError, RemoteProtocolError
from .kernel import ffi, lib

Vector = tuple[float, float, float]

PROFILE_PAPER: int = lib.DTSA_PROFILE_PAPER  # id, c_r, slot, position, velocity
PROFILE_PAPER_INTENT: int = lib.DTSA_PROFILE_PAPER_INTENT  # the same and the commanded velocity
PROFILE_EXTENDED: int = lib.DTSA_PROFILE_EXTENDED
_PROFILES = (PROFILE_PAPER, PROFILE_PAPER_INTENT, PROFILE_EXTENDED)
LENGTHS: dict[int, int] = {profile: lib.frame_length(profile) for profile in _PROFILES}  # bytes
EXTENDED_LENGTH = LENGTHS[PROFILE_EXTENDED]
FRAME_MAX: int = lib.DTSA_FRAME_MAX  # bytes
TAG_LENGTH: int = lib.DTSA_TAG_BYTES  # bytes of authentication after a frame, and after what plug-ins append to it
MAX_EXTENDED_AGENTS: int = lib.DTSA_EXTENDED_AGENTS_MAX  # ids have 8 bits in extended frames
OPEN: int = lib.LEASE_OPEN  # lessee of a turn that is open to all who wake

POSITION_STEP = 0.002  # m, one step of a coordinate at the default extent
EXTENT_M = 65.534  # m, default extent: 32767 steps, the largest coordinate that a frame can say

_NEAR = range(1, lib.RELAY_REACH + 1)  # slots ahead that a relay speaks of
_FAR = range(lib.RELAY_REACH + 1, lib.FAR_REACH + 1)  # ... and that are handed on to one agent
_FAULTS = {
    lib.FRAME_BAD_LENGTH: "wrong length",
    lib.FRAME_BAD_HEADER: "unknown version or profile",
    lib.FRAME_BAD_FIELD: "field out of range",
}


@dataclass(frozen=True, slots=True)
class Frame:
    """What one agent says in one slot (profile ``paper``).

    Values are those of the air after :func:`decode_frame`: quantised (2 mm, 1 cm/s) and saturated, never wrapped.
    """

    sender: int  # id, 1 .. 65535
    slot: int  # slot in which the state was sampled
    c_r: int  # transmission parameter (eq:remaining_t_slots), 0: arrived
    position: Vector  # m, frame map
    velocity: Vector  # m/s, frame map
    intent: Vector | None = None  # m/s, commanded velocity; None: not carried


@dataclass(frozen=True, slots=True)
class Gossip:
    """What the sender of a frame last heard of another agent."""

    agent: int  # id, 1 .. 254
    age: int  # slots since the state was sampled, 1 .. 127
    moving: bool  # its c_r was not 0
    position: Vector  # m, frame map; 4 mm on the air at the default extent
    velocity: Vector  # m/s, frame map; 2 cm/s on the air


@dataclass(frozen=True, slots=True)
class ExtendedFrame:
    """What one agent says in one slot (profile ``extended``).

    ``own.c_r`` is 0 or 1 on the air. Gossip, a section of 11 leases, the relay and what is handed on far ahead take one
    of three places each.
    """

    own: Frame
    c_s: int = 0  # consecutive ids before the sender that it thinks dead, 0 .. 253
    leaving: bool = False  # the sender leaves with this frame; c_s does not count
    probation: bool = False  # the sender uses its anchors only
    gossip: tuple[Gossip, ...] = ()
    leases: bytes = b""  # a byte a turn: 0 none, id of the lessee, OPEN
    relay: tuple[tuple[int, int], ...] = ()  # (slots ahead, 1 .. 24, ascending; lessee), at most 8
    far: tuple[int, ...] = ()  # slots ahead, 25 .. 104, ascending, of turns that are handed on to `far_lessee`
    far_lessee: int = 0  # id, 1 .. 254; 0: nothing is handed on far ahead


def position_step(extent_m: float) -> float:
    """One step of a coordinate in frames, m, by the swarm's setting ``extent_m``; gossip has twice that."""
    return POSITION_STEP * (extent_m / EXTENT_M)


def encode_frame(frame: Frame, extent_m: float = EXTENT_M) -> bytes:
    """The 19 bytes of a frame, 23 with intent; positions beyond the extent and velocities beyond +-20.4 m/s saturate.

    :raises LocalProtocolError: if a field is not a number or an id is out of range.
    """
    out = ffi.new("uint8_t[]", FRAME_MAX)
    try:
        length = lib.frame_encode(ffi.new("dtsa_frame *", {
            "profile": PROFILE_PAPER if frame.intent is None else PROFILE_PAPER_INTENT, "sender": frame.sender,
            "slot": frame.slot & 0xFFFFFFFF, "c_r": frame.c_r, "p": frame.position, "v": frame.velocity,
            "c": frame.intent or (0.0, 0.0, 0.0),
        }), position_step(extent_m), out)  # fmt: skip
    except (OverflowError, IndexError, TypeError, ValueError) as error:
        raise LocalProtocolError(f"not encodable: {frame} ({error})") from error
    if not length:
        raise LocalProtocolError(f"not encodable: {frame}")
    return bytes(ffi.buffer(out, length))


def decode_frame(data: bytes, extent_m: float = EXTENT_M) -> Frame:
    """The fields of a frame that all profiles have, and the intent where it is carried.

    :raises RemoteProtocolError: if the bytes are no frame: sealed ones are opened first.
    """
    return _frame_of(_decode("dtsa_frame *", lib.frame_decode, data, extent_m))


def decode_extended(data: bytes, extent_m: float = EXTENT_M) -> ExtendedFrame:
    """The fields of an extended frame.

    :raises RemoteProtocolError: if the bytes are no frame of profile ``extended``.
    """
    record = _decode("extended_frame *", lib.extended_decode, data, extent_m)
    entries = (record.gossip[k] for k in range(record.gossip_count))
    gossip = tuple(Gossip(g.id, g.age, bool(g.c_r), _vector(g.p), _vector(g.v)) for g in entries)
    far = int.from_bytes(bytes(record.far_mask), "little")
    return ExtendedFrame(
        _frame_of(record.own), record.c_s, bool(record.leaving), bool(record.probation), gossip,
        bytes(record.leases)[: record.lease_count],
        tuple(zip(_slots_of(record.relay_mask, _NEAR), record.relay_ids, strict=False)),
        _slots_of(far, _FAR), record.far_id,
    )  # fmt: skip


def _slots_of(mask: int, reach: range) -> tuple[int, ...]:
    return tuple(slots for slots in reach if mask >> (slots - reach.start) & 1)


def _decode(record_type: str, decode: Any, data: bytes, extent_m: float) -> Any:
    record = ffi.new(record_type)
    fault = decode(bytes(data), len(data), position_step(extent_m), record)
    if fault:
        raise RemoteProtocolError(f"{_FAULTS[fault]} ({len(data)} bytes)")
    return record


def _frame_of(record: Any) -> Frame:
    intent = None if record.profile == PROFILE_PAPER else _vector(record.c)
    return Frame(record.sender, record.slot, record.c_r, _vector(record.p), _vector(record.v), intent)


def _vector(numbers: Any) -> Vector:
    return numbers[0], numbers[1], numbers[2]


def named_in(data: bytes) -> tuple[int, int] | None:
    """The sender's id and the slot (32 bits) that a frame names, whatever follows it in the bytes; None: it is none."""
    if len(data) < 8 or data[0] >> 4 != lib.FRAME_VERSION or data[0] & 15 not in LENGTHS:
        return None
    sender = data[1] if data[0] & 15 == PROFILE_EXTENDED else int.from_bytes(data[1:3], "little")
    return sender, int.from_bytes(data[4:8], "little")


def condition_in(data: bytes) -> tuple[bool, bool, bool]:
    """Whether a frame's sender leaves, rests, is on probation; extended frames alone say the first and the last."""
    condition = lib.frame_condition_of(data)
    return bool(condition.leaves), bool(condition.rests), bool(condition.on_probation)
