"""The radio frame: fields and bytes. The codec itself is ``_kernel/frame.c``, the only one there is."""

from __future__ import annotations

from dataclasses import dataclass

from . import _kernel
from .errors import LocalProtocolError, RemoteProtocolError
from .registry import PROFILES

PROFILE_PAPER = PROFILES.index("paper")  # id, c_r, slot, position, velocity: 19 bytes
PROFILE_PAPER_INTENT = PROFILES.index("paper-intent")  # the same and the commanded velocity: 23 bytes
PROFILE_EXTENDED = PROFILES.index("extended")  # 56 bytes

TAG_LENGTH = 4  # bytes of authentication after a frame, and after what plug-ins append to it

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


def encode_frame(frame: Frame) -> bytes:
    """The bytes of a frame.

    :param frame: its fields; positions beyond +-65.5 m and velocities beyond +-20.4 m/s saturate.
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
    )
    if not data:
        raise LocalProtocolError(f"not encodable: {frame}")
    return data


def decode_frame(data: bytes) -> Frame:
    """The fields of a frame that all profiles have.

    :param data: the bytes heard.
    :raises RemoteProtocolError: if they are no frame: sealed ones are opened first.
    """
    fields = _kernel.decode(data)
    if isinstance(fields, int):
        raise RemoteProtocolError(f"{_FAULTS[fields]} ({len(data)} bytes)")
    profile, sender, slot, c_r, position, velocity, intent = fields
    return Frame(sender, slot, c_r, position, velocity, intent if profile == PROFILE_PAPER_INTENT else None)
