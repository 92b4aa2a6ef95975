"""The radio frame, byte by byte: profiles ``paper`` and ``paper-intent``, and the head of ``extended`` ones.

Little-endian; the layout is docs/reference/protocol.md's table::

    0      version (high nibble), profile (low nibble)
    1-2    sender's id
    3      c_r
    4-7    slot in which the state was sampled
    8-13   position, 3 x 16 bits, in steps that the swarm agrees on (2 mm)
    14-18  velocity, 3 x 12 bits, 1 cm/s, 4 bits zero          (profile paper, 19 bytes)
    14-22  velocity and commanded velocity, 6 x 12 bits, 1 cm/s (profile paper with intent, 23 bytes)
"""

from __future__ import annotations

from hashlib import blake2s

from dtsa_agent.core.errors import LocalProtocolError, RemoteProtocolError
from dtsa_agent.core.frame import Frame

from .arithmetic import ZERO, quantise, signed

VERSION = 1
PROFILE_PAPER, PROFILE_PAPER_INTENT, PROFILE_EXTENDED = 0, 1, 2
EXTENDED_HEAD, EXTENDED_LENGTH = 23, 56  # bytes
EXTENDED_SENDER_MAX = 254
FRAME_MAX = 60  # bytes, a Crazyflie's peer-to-peer packet
LENGTHS = {PROFILE_PAPER: 19, PROFILE_PAPER_INTENT: 23, PROFILE_EXTENDED: EXTENDED_LENGTH}  # bytes
VELOCITY_STEP = 0.01  # m/s

WRONG_LENGTH = "wrong length"
WRONG_HEADER = "unknown version or profile"
WRONG_FIELD = "field out of range"


class Refused(RemoteProtocolError):
    """Bytes that are no frame."""

    def __init__(self, fault: str, data: bytes) -> None:
        super().__init__(f"{fault} ({len(data)} bytes)")


def encode(frame: Frame, position_step: float, profile: int | None = None) -> bytes:
    """The bytes of a frame; of profile ``extended`` its first 23.

    :param profile: default: ``paper``, or ``paper-intent`` for a frame with an intent.
    :raises LocalProtocolError: if a field is not a number or an id is out of range.
    """
    if profile is None:
        profile = PROFILE_PAPER if frame.intent is None else PROFILE_PAPER_INTENT
    intent = frame.intent or ZERO
    most = EXTENDED_SENDER_MAX if profile == PROFILE_EXTENDED else 65535
    numbers = (*frame.position, *frame.velocity, *intent)
    if not (1 <= frame.sender <= most and 0 <= frame.c_r <= 255) or any(x != x for x in numbers):
        raise LocalProtocolError(f"not encodable: {frame}")
    c_r = int(frame.c_r != 0) if profile == PROFILE_EXTENDED else frame.c_r
    head = bytes([VERSION << 4 | profile]) + frame.sender.to_bytes(2, "little") + bytes([c_r])
    slot = (frame.slot & 0xFFFFFFFF).to_bytes(4, "little")
    steps = [quantise(x, position_step, 16) for x in frame.position]
    position = b"".join(q.to_bytes(2, "little", signed=True) for q in steps)
    speeds = frame.velocity if profile == PROFILE_PAPER else (*frame.velocity, *intent)
    return head + slot + position + _pack_speeds(speeds)


def _pack_speeds(speeds: tuple[float, ...]) -> bytes:
    """Velocities in 12 bits each, the first in the lowest bits."""
    word = 0
    for at, speed in enumerate(speeds):
        word |= (quantise(speed, VELOCITY_STEP, 12) & 0xFFF) << 12 * at
    return word.to_bytes((12 * len(speeds) + 7) // 8, "little")


def decode(data: bytes, position_step: float) -> Frame:
    """The fields of a frame of any profile that all profiles have.

    :raises Refused: if they are no frame.
    """
    if len(data) < 1:
        raise Refused(WRONG_LENGTH, data)
    profile = data[0] & 0xF
    if data[0] >> 4 != VERSION or profile not in LENGTHS:
        raise Refused(WRONG_HEADER, data)
    if len(data) != LENGTHS[profile]:
        raise Refused(WRONG_LENGTH, data)
    extended = profile == PROFILE_EXTENDED
    sender = data[1] if extended else int.from_bytes(data[1:3], "little")
    if not sender or (extended and sender > EXTENDED_SENDER_MAX):
        raise Refused(WRONG_FIELD, data)
    c_r = data[3] & 1 if extended else data[3]
    slot = int.from_bytes(data[4:8], "little")
    x, y, z = (signed(int.from_bytes(data[at : at + 2], "little"), 16) * position_step for at in (8, 10, 12))
    word = int.from_bytes(data[14:19] if profile == PROFILE_PAPER else data[14:23], "little")
    speeds = [signed(word >> 12 * at, 12) * VELOCITY_STEP for at in range(6)]
    if profile == PROFILE_PAPER and word >> 36:
        raise Refused(WRONG_FIELD, data)
    intent = None if profile == PROFILE_PAPER else (speeds[3], speeds[4], speeds[5])
    return Frame(sender, slot, c_r, (x, y, z), (speeds[0], speeds[1], speeds[2]), intent)


def tag(key: bytes, session: int, slot: int, data: bytes) -> bytes:
    """The 4 bytes that follow a frame where frames are authenticated (docs/how-to/security.md).

    A truncated code over session, slot and frame: BLAKE2s with a key. The slot is the one in which it is sent, not what
    the frame says; by the person tags of other software, or of another version of this one, are none of ours.
    """
    covered = session.to_bytes(8, "little") + slot.to_bytes(8, "little") + data
    return blake2s(covered, key=key, digest_size=4, person=b"dtsa v1").digest()
