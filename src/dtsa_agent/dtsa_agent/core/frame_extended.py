"""The extended frame: fields and bytes. The codec is ``_kernel/frame_extended.c``; layout in docs/protocol.md."""

from __future__ import annotations

from dataclasses import dataclass

from . import _kernel
from .errors import LocalProtocolError, RemoteProtocolError
from .frame import _FAULTS, EXTENT_M, Frame, Vector, position_step

EXTENDED_LENGTH = _kernel.EXTENDED_LENGTH  # bytes, and 4 more for the tag of an authenticated frame
HEAD_LENGTH = (
    _kernel.EXTENDED_HEAD
)  # bytes that hold the sender's own state: enough for who hears only the beginning of a frame
OPEN = _kernel.LEASE_OPEN  # lessee of a turn that is open to all who wake


@dataclass(frozen=True, slots=True)
class Gossip:
    """What the sender of a frame last heard of somebody else."""

    agent: int  # id, 1 .. 254
    age: int  # slots since the state was sampled, 1 .. 127
    moving: bool  # its c_r was not 0
    position: Vector  # m, frame map; 4 mm on the air at the default extent
    velocity: Vector  # m/s, frame map; 2 cm/s on the air


@dataclass(frozen=True, slots=True)
class ExtendedFrame:
    """What one agent says in one slot (profile ``extended``).

    ``own.c_r`` is 0 or 1 on the air. Gossip, a section of 11 leases and the relay take one of three places each.
    """

    own: Frame
    c_s: int = 0  # consecutive ids before the sender that it thinks dead, 0 .. 253
    leaving: bool = False  # the sender leaves with this frame; c_s does not count
    probation: bool = False  # the sender uses its anchors only
    gossip: tuple[Gossip, ...] = ()
    leases: bytes = b""  # a byte a turn: 0 none, id of the lessee, OPEN
    relay: tuple[tuple[int, int], ...] = ()  # (slots ahead, 1 .. 24, ascending; lessee), at most 8


def encode_extended(frame: ExtendedFrame, extent_m: float = EXTENT_M) -> bytes:
    """The bytes of an extended frame.

    :param frame: its fields; positions beyond the extent (gossip: half of it) and velocities beyond +-20.4 m/s (gossip:
        +-10.2 m/s) saturate.
    :param extent_m: largest coordinate that fits, m, as the swarm has agreed.
    :returns: 56 bytes.
    :raises LocalProtocolError: if a field is out of range, or the sections do not fit.
    """
    own = frame.own
    data: bytes = _kernel.encode_extended(
        own.sender, own.slot & 0xFFFFFFFF, own.c_r, own.position, own.velocity, own.intent or (0.0, 0.0, 0.0),
        frame.c_s, frame.leaving, frame.probation,
        tuple((g.agent, g.age, int(g.moving), g.position, g.velocity) for g in frame.gossip), frame.leases, frame.relay,
        position_step(extent_m),
    )  # fmt: skip
    if not data:
        raise LocalProtocolError(f"not encodable: {frame}")
    return data


def decode_extended(data: bytes, extent_m: float = EXTENT_M) -> ExtendedFrame:
    """The fields of an extended frame.

    :param data: the bytes heard, without a tag.
    :param extent_m: largest coordinate that fits, m, as the swarm has agreed.
    :raises RemoteProtocolError: if they are no frame of profile ``extended``.
    """
    fields = _kernel.decode_extended(data, position_step(extent_m))
    if isinstance(fields, int):
        raise RemoteProtocolError(f"{_FAULTS[fields]} ({len(data)} bytes)")
    own = Frame(
        fields["sender"], fields["slot"], fields["c_r"], fields["position"], fields["velocity"], fields["intent"]
    )
    gossip = tuple(Gossip(agent, age, bool(c_r), p, v) for agent, age, c_r, p, v in fields["gossip"])
    return ExtendedFrame(
        own, fields["c_s"], fields["leaving"], fields["probation"], gossip, fields["leases"], tuple(fields["relay"])
    )


def decode_head(data: bytes, extent_m: float = EXTENT_M) -> Frame:
    """The sender's own state from the beginning of an extended frame.

    A ground radio that listens to a Crazyflie's peer-to-peer traffic hears about 30 bytes of a frame. They hold the
    whole state of the sender; what it says about others is lost, and the frame cannot be authenticated.

    :param data: 23 bytes or more.
    :param extent_m: largest coordinate that fits, m, as the swarm has agreed.
    :raises RemoteProtocolError: if they are not the beginning of an extended frame.
    """
    if len(data) < HEAD_LENGTH:
        raise RemoteProtocolError(f"{_FAULTS[-1]} ({len(data)} bytes)")
    head = bytearray(data[:HEAD_LENGTH])
    head[3] &= 0x03  # no sections
    return decode_extended(bytes(head) + bytes(EXTENDED_LENGTH - HEAD_LENGTH), extent_m).own
