"""The extended frame: fields and bytes. Codec: ``_kernel/frame_extended.c``, specified in ``reference``."""

from __future__ import annotations

from .compiled import MISSING
from .compiled import kernel as _kernel
from .errors import LocalProtocolError, RemoteProtocolError
from .frame import _FAULTS, EXTENT_M, Frame, position_step
from .reference import frame_extended as plain
from .reference.frame import EXTENDED_HEAD, EXTENDED_LENGTH
from .reference.frame_extended import OPEN, ExtendedFrame, Gossip

HEAD_LENGTH = EXTENDED_HEAD  # bytes of the sender's own state: enough for who hears only the beginning of a frame

__all__ = [
    "EXTENDED_LENGTH", "HEAD_LENGTH", "OPEN", "ExtendedFrame", "Gossip", "decode_extended", "decode_head",
    "encode_extended",
]  # fmt: skip


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
    if MISSING:
        return plain.decode_extended(data, position_step(extent_m))
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
