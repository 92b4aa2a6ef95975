"""Extended frames by the encoder in C: the product decodes them only, agents encode theirs in C."""

from __future__ import annotations

from typing import Any

from dtsa_agent.core import Frame, LocalProtocolError
from dtsa_agent.core.frame import EXTENT_M, FRAME_MAX, PROFILE_EXTENDED, ExtendedFrame, position_step
from dtsa_agent.core.kernel import ffi, lib

NEAR = range(1, lib.RELAY_REACH + 1)  # slots ahead that a relay speaks of
FAR = range(lib.RELAY_REACH + 1, lib.FAR_REACH + 1)  # ... and that are handed on to one agent


def encode_extended(frame: ExtendedFrame, extent_m: float = EXTENT_M) -> bytes:
    """The 56 bytes of an extended frame; LocalProtocolError: a field is out of range, or the sections do not fit."""
    out = ffi.new("uint8_t[]", FRAME_MAX)
    try:
        length = lib.extended_encode(ffi.new("extended_frame *", fields_of(frame)), position_step(extent_m), out)
    except (OverflowError, IndexError, TypeError, ValueError) as error:
        raise LocalProtocolError(f"not encodable: {frame} ({error})") from error
    if not length:
        raise LocalProtocolError(f"not encodable: {frame}")
    return bytes(ffi.buffer(out, length))


def fields_of(frame: ExtendedFrame) -> dict[str, Any]:
    gossip = [{"id": g.agent, "age": g.age, "c_r": g.moving, "p": g.position, "v": g.velocity} for g in frame.gossip]
    return {
        "own": own_fields(frame.own), "c_s": frame.c_s, "leaving": frame.leaving, "probation": frame.probation,
        "gossip_count": len(gossip), "gossip": gossip, "lease_count": len(frame.leases), "leases": frame.leases,
        "relay_mask": mask_of(tuple(ahead for ahead, _ in frame.relay), NEAR),
        "relay_ids": bytes(lessee for _, lessee in frame.relay), "far_id": frame.far_lessee,
        "far_mask": mask_of(frame.far, FAR).to_bytes(lib.FAR_BYTES, "little"),
    }  # fmt: skip


def own_fields(own: Frame) -> dict[str, Any]:
    return {
        "profile": PROFILE_EXTENDED, "sender": own.sender, "slot": own.slot & 0xFFFFFFFF, "c_r": own.c_r,
        "p": own.position, "v": own.velocity, "c": own.intent or (0.0, 0.0, 0.0),
    }  # fmt: skip


def mask_of(ahead: tuple[int, ...], reach: range) -> int:
    """A mask with a bit for each of the slots ahead; ValueError: they do not ascend, or are out of reach."""
    if any(slots not in reach for slots in ahead) or list(ahead) != sorted(set(ahead)):
        raise ValueError(f"slots ahead {ahead}")
    return sum(1 << (slots - reach.start) for slots in ahead)
