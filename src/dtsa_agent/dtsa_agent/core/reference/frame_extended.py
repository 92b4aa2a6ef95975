"""The extended frame: the paper's state, and three sections about others.

The layout is docs/reference/protocol.md's table::

0      version (high nibble), profile 2 (low nibble)
1      sender's id, 1..254
2      c_s, 0..253; 255: the sender leaves with this frame
3      bit 0: c_r is not 0; bit 1: in probation; bits 2-3, 4-5, 6-7: kinds of the three sections
4-22   slot, position, velocity, commanded velocity as in profile paper with intent
23-33, 34-44, 45-55   sections: leases first, then a relay, what is handed on far ahead, then gossip
"""

from __future__ import annotations

from dtsa_agent.core.errors import LocalProtocolError
from dtsa_agent.core.frame import ExtendedFrame, Gossip

from .arithmetic import Vector, quantise, signed
from .frame import (
    EXTENDED_HEAD,
    EXTENDED_SENDER_MAX,
    PROFILE_EXTENDED,
    WRONG_FIELD,
    WRONG_HEADER,
    Refused,
    decode,
    encode,
)

SECTIONS, SECTION_BYTES = 3, 11
KIND_GOSSIP, KIND_LEASES, KIND_RELAY, KIND_FAR = 0, 1, 2, 3
RELAY_IDS, RELAY_REACH = 8, 24  # lessees in a relay; slots ahead that it speaks of
FAR_REACH = RELAY_REACH + 8 * (SECTION_BYTES - 1)  # slots ahead of turns that are handed on to one agent
GOSSIP_AGE_MAX = 127  # slots
LEASE_ROOM = 2 * SECTION_BYTES  # turns that one frame can give away
C_S_MAX, LEAVING = 253, 255
OPEN = 255  # lessee of a turn that is open to all who wake
VELOCITY_STEP = 0.02  # m/s, of gossip


def gossip_fits(position: Vector, velocity: Vector, position_step: float) -> bool:
    """Whether gossip can say a state without saturating: it has two bits less than the own state."""
    far = ((1 << 13) - 2) * (2.0 * position_step)
    fast = ((1 << 9) - 2) * VELOCITY_STEP
    return all(abs(x) <= far for x in position) and all(abs(x) <= fast for x in velocity)


def encode_extended(frame: ExtendedFrame, position_step: float) -> bytes:
    """The bytes of an extended frame.

    :raises LocalProtocolError: if a field is out of range, or the sections do not fit.
    """
    if not _is_encodable(frame):
        raise LocalProtocolError(f"not encodable: {frame}")
    head = bytearray(encode(frame.own, position_step, PROFILE_EXTENDED))
    sections: list[tuple[int, bytes]] = []
    for first in range(0, len(frame.leases), SECTION_BYTES):
        sections.append((KIND_LEASES, frame.leases[first : first + SECTION_BYTES]))
    if frame.relay:
        sections.append((KIND_RELAY, _pack_relay(frame.relay)))
    if frame.far:
        sections.append((KIND_FAR, _pack_far(frame.far, frame.far_lessee)))
    for entry in frame.gossip:
        sections.append((KIND_GOSSIP, _pack_gossip(entry, 2.0 * position_step)))
    if len(sections) > SECTIONS:
        raise LocalProtocolError(f"not encodable: {frame}")
    head[2] = LEAVING if frame.leaving else frame.c_s
    head[3] |= frame.probation << 1
    for place, (kind, _) in enumerate(sections):
        head[3] |= kind << (2 + 2 * place)
    body = b"".join(data.ljust(SECTION_BYTES, b"\0") for _, data in sections)
    return bytes(head) + body.ljust(SECTIONS * SECTION_BYTES, b"\0")


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


def _pack_relay(relay: tuple[tuple[int, int], ...]) -> bytes:
    mask = 0
    for slots, _ in relay:
        mask |= 1 << (slots - 1)
    return mask.to_bytes(3, "little") + bytes(lessee for _, lessee in relay)


def _pack_far(far: tuple[int, ...], lessee: int) -> bytes:
    mask = sum(1 << (slots - RELAY_REACH - 1) for slots in far)
    return bytes([lessee]) + mask.to_bytes(SECTION_BYTES - 1, "little")


def _pack_gossip(entry: Gossip, step: float) -> bytes:
    word = 0
    for axis in range(3):
        word |= (quantise(entry.position[axis], step, 14) & 0x3FFF) << 14 * axis
        word |= (quantise(entry.velocity[axis], VELOCITY_STEP, 10) & 0x3FF) << (42 + 10 * axis)
    return bytes([entry.agent, entry.age << 1 | entry.moving]) + word.to_bytes(9, "little")


def decode_extended(data: bytes, position_step: float) -> ExtendedFrame:
    """The fields of an extended frame.

    :raises Refused: if they are no frame of profile ``extended``.
    """
    own = decode(data, position_step)
    if data[0] & 0xF != PROFILE_EXTENDED:
        raise Refused(WRONG_HEADER, data)
    leaving = data[2] == LEAVING
    if not leaving and data[2] > C_S_MAX:
        raise Refused(WRONG_FIELD, data)
    gossip: list[Gossip] = []
    relays: list[tuple[tuple[int, int], ...]] = []
    leases = b""
    far: tuple[int, ...] = ()
    far_lessee = 0
    for place in range(SECTIONS):
        section = data[EXTENDED_HEAD + place * SECTION_BYTES :][:SECTION_BYTES]
        kind = data[3] >> (2 + 2 * place) & 3
        if kind == KIND_LEASES:
            leases += section
        elif kind == KIND_RELAY and not relays:
            relays.append(_unpack_relay(section, data))
        elif kind == KIND_FAR and not far:
            far, far_lessee = _unpack_far(section, data)
        elif kind == KIND_GOSSIP:
            gossip += _unpack_gossip(section, 2.0 * position_step, data)
        else:
            raise Refused(WRONG_FIELD, data)
    probation = bool(data[3] >> 1 & 1)
    c_s = 0 if leaving else data[2]
    relay = relays[0] if relays else ()
    return ExtendedFrame(own, c_s, leaving, probation, tuple(gossip), leases, relay, far, far_lessee)


def _unpack_relay(section: bytes, data: bytes) -> tuple[tuple[int, int], ...]:
    mask = int.from_bytes(section[:3], "little")
    ahead = [d + 1 for d in range(RELAY_REACH) if mask >> d & 1]
    lessees = section[3:]
    if len(ahead) > RELAY_IDS or 0 in lessees[: len(ahead)] or any(lessees[len(ahead) :]):
        raise Refused(WRONG_FIELD, data)
    return tuple(zip(ahead, lessees, strict=False))


def _unpack_far(section: bytes, data: bytes) -> tuple[tuple[int, ...], int]:
    mask = int.from_bytes(section[1:], "little")
    if not mask or not 1 <= section[0] <= EXTENDED_SENDER_MAX:
        raise Refused(WRONG_FIELD, data)
    return tuple(d for d in range(RELAY_REACH + 1, FAR_REACH + 1) if mask >> (d - RELAY_REACH - 1) & 1), section[0]


def _unpack_gossip(section: bytes, step: float, data: bytes) -> list[Gossip]:
    agent, age, moving = section[0], section[1] >> 1, bool(section[1] & 1)
    if not agent:
        if any(section):
            raise Refused(WRONG_FIELD, data)
        return []
    if agent > EXTENDED_SENDER_MAX or age == 0:
        raise Refused(WRONG_FIELD, data)
    word = int.from_bytes(section[2:], "little")
    x, y, z = (signed(word >> 14 * axis, 14) * step for axis in range(3))
    vx, vy, vz = (signed(word >> (42 + 10 * axis), 10) * VELOCITY_STEP for axis in range(3))
    return [Gossip(agent, age, moving, (x, y, z), (vx, vy, vz))]
