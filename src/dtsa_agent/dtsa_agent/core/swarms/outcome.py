"""What one receiver can tell of a slot that is over."""

from __future__ import annotations

from enum import IntEnum


class SlotOutcome(IntEnum):
    """Outcome of a slot, as one receiver knows it. Who sends hears nothing else: its own frame counts as FRAME."""

    SILENCE = 0  # nothing was heard; a receiver that cannot tell takes a collision for silence
    FRAME = 1  # a frame of this swarm and this time was heard or sent
    COLLISION = 2  # something was heard that was no frame
