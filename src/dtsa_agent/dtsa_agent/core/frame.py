"""The radio frame: fields and bytes. The codec itself is ``_kernel/frame.c``, the only one there is."""

from __future__ import annotations

from dataclasses import dataclass

from . import _kernel
from .errors import LocalProtocolError, RemoteProtocolError
from .registry import PROFILES

PROFILE_PAPER = PROFILES.index("paper")  # id, c_r, slot, position, velocity: 19 bytes
PROFILE_PAPER_INTENT = PROFILES.index("paper-intent")  # the same and the commanded velocity: 23 bytes
PROFILE_EXTENDED = PROFILES.index("extended")  # 56 bytes

_VERSION = 1
_HEADER_LENGTH = 8  # bytes up to the end of the slot
TAG_LENGTH = 4  # bytes of authentication after a frame, and after what plug-ins append to it

POSITION_STEP = 0.002  # m, one step of a coordinate at the default extent
EXTENT_M = 65.534  # m, default extent: 32767 steps, the largest coordinate that a frame can say

Vector = tuple[float, float, float]

_FAULTS = {-1: "wrong length", -2: "unknown version or profile", -3: "field out of range"}


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
    profile = PROFILE_PAPER if frame.intent is None else PROFILE_PAPER_INTENT
    data: bytes = _kernel.encode(
        profile,
        frame.sender,
        frame.slot & 0xFFFFFFFF,
        frame.c_r,
        frame.position,
        frame.velocity,
        frame.intent or (0.0, 0.0, 0.0),
        position_step(extent_m),
    )
    if not data:
        raise LocalProtocolError(f"not encodable: {frame}")
    return data


def named_in(data: bytes) -> tuple[int, int] | None:
    """The id of the sender and the slot (32 bits) that a frame of any profile names; None: it is none.

    :param data: the bytes, whatever follows a frame in them: bytes of plug-ins, a tag.
    """
    if len(data) < _HEADER_LENGTH or data[0] >> 4 != _VERSION or data[0] & 15 >= len(PROFILES):
        return None
    sender = data[1] if data[0] & 15 == PROFILE_EXTENDED else int.from_bytes(data[1:3], "little")
    return sender, int.from_bytes(data[4:8], "little")


def decode_frame(data: bytes, extent_m: float = EXTENT_M) -> Frame:
    """The fields of a frame that all profiles have.

    :param data: the bytes heard.
    :param extent_m: largest coordinate that fits, m, as the swarm has agreed.
    :raises RemoteProtocolError: if they are no frame: sealed ones are opened first.
    """
    fields = _kernel.decode(data, position_step(extent_m))
    if isinstance(fields, int):
        raise RemoteProtocolError(f"{_FAULTS[fields]} ({len(data)} bytes)")
    profile, sender, slot, c_r, position, velocity, intent = fields
    return Frame(sender, slot, c_r, position, velocity, intent if profile == PROFILE_PAPER_INTENT else None)
