"""The radio frame, bit by bit. The tables of its bytes: docs/reference/protocol.md#frames.

Little-endian. Profile paper has 19 bytes, with intent 23; profile extended has these 23, with other bytes 1 to 3, and
three sections about others, leases first, then a relay, what is handed on far ahead, then gossip: 56.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from hashlib import blake2s

from dtsa_agent.core.errors import LocalProtocolError, RemoteProtocolError
from dtsa_agent.core.frame import ExtendedFrame, Frame, Gossip

from .arithmetic import ZERO, Vector, quantise, signed

VERSION = 1
PROFILE_PAPER, PROFILE_PAPER_INTENT, PROFILE_EXTENDED = 0, 1, 2
EXTENDED_HEAD, EXTENDED_LENGTH = 23, 56  # bytes
EXTENDED_SENDER_MAX = 254
LENGTHS = {PROFILE_PAPER: 19, PROFILE_PAPER_INTENT: 23, PROFILE_EXTENDED: EXTENDED_LENGTH}  # bytes
TAG_LENGTH = 4
VELOCITY_STEP, GOSSIP_VELOCITY_STEP = 0.01, 0.02  # m/s
OWN_BITS = (4, 4, 16, 8, 32, *[16] * 3, *[12] * 6)
GOSSIP_BITS = (8, 1, 7, *[14] * 3, *[10] * 3)

SECTIONS, SECTION_BYTES = 3, 11
KIND_GOSSIP, KIND_LEASES, KIND_RELAY, KIND_FAR = 0, 1, 2, 3
RELAY_IDS, RELAY_REACH = 8, 24  # lessees in a relay; slots ahead that it speaks of
FAR_REACH = RELAY_REACH + 8 * (SECTION_BYTES - 1)  # slots ahead of turns that are handed on to one agent
GOSSIP_AGE_MAX = 127  # slots
LEASE_ROOM = 2 * SECTION_BYTES  # turns that one frame can give away
C_S_MAX, LEAVING = 253, 255
MOVES, PROBATION = 1, 2  # bits of byte 3
OPEN = 255  # lessee of a turn that is open to all who wake

WRONG_LENGTH = "wrong length"
WRONG_HEADER = "unknown version or profile"
WRONG_FIELD = "field out of range"


class Refused(RemoteProtocolError):
    """Bytes that are no frame."""

    def __init__(self, fault: str, data: bytes) -> None:
        super().__init__(f"{fault} ({len(data)} bytes)")


def pack(values: Iterable[int], bits: Iterable[int]) -> bytes:
    """Whole numbers of so many bits each, the first in the lowest bits."""
    word = place = 0
    for value, size in zip(values, bits, strict=False):
        word |= (value & (1 << size) - 1) << place
        place += size
    return word.to_bytes((place + 7) // 8, "little")


def unpack(data: bytes, bits: Iterable[int]) -> list[int]:
    """Return the whole numbers that :func:`pack` has written, without signs; 0 beyond the end of the data."""
    word, values = int.from_bytes(data, "little"), []
    for size in bits:
        values.append(word & (1 << size) - 1)
        word >>= size
    return values


def scaled_vectors(steps: Sequence[int], bits: int, step: float) -> list[Vector]:
    """Vectors from whole steps, three numbers of some bits each."""
    values = [signed(value, bits) * step for value in steps]
    return list(zip(values[0::3], values[1::3], values[2::3], strict=True))


def encode(frame: Frame, position_step: float, profile: int | None = None) -> bytes:
    """The bytes of a frame; of profile ``extended`` its first 23.

    :param profile: default: ``paper``, or ``paper-intent`` for a frame with an intent.
    :raises LocalProtocolError: if a field is not a number or an id is out of range.
    """
    if profile is None:
        profile = PROFILE_PAPER if frame.intent is None else PROFILE_PAPER_INTENT
    speeds = (*frame.velocity, *(frame.intent or ZERO))
    most = EXTENDED_SENDER_MAX if profile == PROFILE_EXTENDED else 65535
    is_number = all(x == x for x in (*frame.position, *speeds))
    if not (1 <= frame.sender <= most and 0 <= frame.c_r <= 255 and is_number):
        raise LocalProtocolError(f"not encodable: {frame}")
    c_r = MOVES * (frame.c_r != 0) if profile == PROFILE_EXTENDED else frame.c_r
    state = [quantise(x, position_step, 16) for x in frame.position]
    state += [quantise(x, VELOCITY_STEP, 12) for x in (frame.velocity if profile == PROFILE_PAPER else speeds)]
    return pack((profile, VERSION, frame.sender, c_r, frame.slot, *state), OWN_BITS)


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
    _, _, sender, c_r, slot, *steps = unpack(data, OWN_BITS)
    if profile == PROFILE_EXTENDED:
        sender, c_r = data[1], data[3] & MOVES
        if sender > EXTENDED_SENDER_MAX:
            raise Refused(WRONG_FIELD, data)
    if not sender or (profile == PROFILE_PAPER and any(steps[6:])):
        raise Refused(WRONG_FIELD, data)
    (position,) = scaled_vectors(steps[:3], 16, position_step)
    velocity, intent = scaled_vectors(steps[3:], 12, VELOCITY_STEP)
    return Frame(sender, slot, c_r, position, velocity, None if profile == PROFILE_PAPER else intent)


def condition_of(data: bytes) -> tuple[bool, bool, bool]:
    """Whether a frame's sender leaves, rests, is on probation; extended frames alone say the first and the last."""
    if data[0] & 0xF != PROFILE_EXTENDED:
        return False, not data[3], False
    return data[2] == LEAVING, not data[3] & MOVES, bool(data[3] & PROBATION)


def tag(key: bytes, session: int, slot: int, data: bytes) -> bytes:
    """The 4 bytes that follow a frame where frames are authenticated (docs/how-to/security.md).

    A truncated code over session, slot and frame: BLAKE2s with a key. The slot is the one in which it is sent, not what
    the frame says; by the person tags of other software, or of another version of this one, are none of ours.
    """
    covered = session.to_bytes(8, "little") + slot.to_bytes(8, "little") + data
    return blake2s(covered, key=key, digest_size=TAG_LENGTH, person=b"dtsa v1").digest()


def gossip_fits(position: Vector, velocity: Vector, position_step: float) -> bool:
    """Whether gossip can say a state without saturating: it has two bits less than the own state."""
    far = ((1 << 13) - 2) * (2.0 * position_step)
    fast = ((1 << 9) - 2) * GOSSIP_VELOCITY_STEP
    return all(abs(x) <= far for x in position) and all(abs(x) <= fast for x in velocity)


def encode_extended(frame: ExtendedFrame, position_step: float) -> bytes:
    """The bytes of an extended frame.

    :raises LocalProtocolError: if a field is out of range, or the sections do not fit.
    """
    if not _is_encodable(frame):
        raise LocalProtocolError(f"not encodable: {frame}")
    head = bytearray(encode(frame.own, position_step, PROFILE_EXTENDED))
    parts = range(0, len(frame.leases), SECTION_BYTES)
    sections = [(KIND_LEASES, frame.leases[first : first + SECTION_BYTES]) for first in parts]
    if frame.relay:
        near = mask_of([ahead for ahead, _ in frame.relay], 0)
        lessees = [lessee for _, lessee in frame.relay]
        sections.append((KIND_RELAY, pack((near, *lessees), (RELAY_REACH, *[8] * RELAY_IDS))))
    if frame.far:
        far = mask_of(frame.far, RELAY_REACH)
        sections.append((KIND_FAR, pack((frame.far_lessee, far), (8, FAR_REACH - RELAY_REACH))))
    for entry in frame.gossip:
        place = [quantise(x, 2.0 * position_step, 14) for x in entry.position]
        speed = [quantise(x, GOSSIP_VELOCITY_STEP, 10) for x in entry.velocity]
        sections.append((KIND_GOSSIP, pack((entry.agent, entry.moving, entry.age, *place, *speed), GOSSIP_BITS)))
    if len(sections) > SECTIONS:
        raise LocalProtocolError(f"not encodable: {frame}")
    head[2] = LEAVING if frame.leaving else frame.c_s
    head[3] |= PROBATION * frame.probation
    for place_at, (kind, _) in enumerate(sections):
        head[3] |= kind << (2 + 2 * place_at)
    body = b"".join(data.ljust(SECTION_BYTES, b"\0") for _, data in sections)
    return (bytes(head) + body).ljust(EXTENDED_LENGTH, b"\0")


def mask_of(ahead: Sequence[int], after: int) -> int:
    """A bit for each of some slots ahead, the lowest for the one after ``after``."""
    return sum(1 << (slots - after - 1) for slots in ahead)


def slots_of(mask: int, after: int) -> tuple[int, ...]:
    """The slots ahead that :func:`mask_of` has written."""
    return tuple(after + 1 + bit for bit in range(mask.bit_length()) if mask >> bit & 1)


def _is_encodable(frame: ExtendedFrame) -> bool:
    ahead = [slots for slots, _ in frame.relay]
    return (
        0 <= frame.c_s <= C_S_MAX
        and len(frame.leases) <= SECTIONS * SECTION_BYTES
        and len(frame.relay) <= RELAY_IDS
        and ahead == sorted(set(ahead))
        and list(frame.far) == sorted(set(frame.far))
        and all(RELAY_REACH < slots <= FAR_REACH for slots in frame.far)
        and bool(frame.far) == bool(frame.far_lessee)
        and 0 <= frame.far_lessee <= EXTENDED_SENDER_MAX
        and all(1 <= slots <= RELAY_REACH and 1 <= lessee <= 255 for slots, lessee in frame.relay)
        and all(1 <= g.agent <= EXTENDED_SENDER_MAX and 1 <= g.age <= GOSSIP_AGE_MAX for g in frame.gossip)
        and all(x == x for g in frame.gossip for x in (*g.position, *g.velocity))
    )


def decode_extended(data: bytes, position_step: float) -> ExtendedFrame:
    """The fields of an extended frame.

    :raises Refused: if they are no frame of profile ``extended``.
    """
    own = decode(data, position_step)
    if data[0] & 0xF != PROFILE_EXTENDED:
        raise Refused(WRONG_HEADER, data)
    leaving, _, probation = condition_of(data)
    is_valid = leaving or data[2] <= C_S_MAX
    gossip: list[Gossip] = []
    leases, far_lessee = b"", 0
    relay: tuple[tuple[int, int], ...] = ()
    far: tuple[int, ...] = ()
    kinds = unpack(data[3:4], (2, 2, 2, 2))[1:]
    if max(kinds.count(KIND_RELAY), kinds.count(KIND_FAR)) > 1:
        raise Refused(WRONG_FIELD, data)
    for place, kind in enumerate(kinds):
        section = data[EXTENDED_HEAD + place * SECTION_BYTES :][:SECTION_BYTES]
        if kind == KIND_LEASES:
            leases += section
        elif kind == KIND_RELAY:
            ahead, ids = slots_of(int.from_bytes(section[:3], "little"), 0), section[3:]
            relay = tuple(zip(ahead, ids, strict=False))
            is_valid &= len(ahead) <= RELAY_IDS and all(ids[: len(ahead)]) and not any(ids[len(ahead) :])
        elif kind == KIND_FAR:
            far_lessee, far = section[0], slots_of(int.from_bytes(section[1:], "little"), RELAY_REACH)
            is_valid &= bool(far) and 1 <= far_lessee <= EXTENDED_SENDER_MAX
        elif any(section):
            agent, moving, age, *steps = unpack(section, GOSSIP_BITS)
            is_valid &= 1 <= agent <= EXTENDED_SENDER_MAX and age > 0
            (position,) = scaled_vectors(steps[:3], 14, 2.0 * position_step)
            (velocity,) = scaled_vectors(steps[3:], 10, GOSSIP_VELOCITY_STEP)
            gossip.append(Gossip(agent, age, bool(moving), position, velocity))
    if not is_valid:
        raise Refused(WRONG_FIELD, data)
    c_s = 0 if leaving else data[2]
    return ExtendedFrame(own, c_s, leaving, probation, tuple(gossip), leases, relay, far, far_lessee)
