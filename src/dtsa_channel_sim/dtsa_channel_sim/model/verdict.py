"""What the channel says about one slot."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

#: Outcomes: nobody sent; one frame, or several that disturbed nobody; frames destroyed each other somewhere.
IDLE, SUCCESS, COLLISION = range(3)
OUTCOMES = ("idle", "success", "collision")  # their names


class Verdict(NamedTuple):
    """Who sent in a slot, and who received what.

    The outcome speaks of disturbed frames only: a single frame that every receiver lost to noise or to a
    jammer is a SUCCESS with ``lost`` counting all of them.
    """

    outcome: int  # IDLE, SUCCESS or COLLISION, the numbers of dtsa_msgs/SlotRecord
    senders: tuple[int, ...]  # ids of all agents that sent, in the order given
    received: NDArray[np.bool_] | None  # (F, N) frame f reached agent column + 1; None: all but the sender have all
    lost: tuple[int, ...] | None  # per frame: receivers in reach that lost it to noise or jamming; None: none
    collided: tuple[int, ...] | None  # per frame: receivers where it collided or that were sending; None: none

    @classmethod
    def of(cls, senders: Sequence[int], receptions: Sequence[Any]) -> Verdict:
        """Return the verdict on the frames of a slot.

        :param senders: ids of the agents that sent, one a frame.
        :param receptions: what became of each frame: ``received`` (N,), ``lost`` and ``collided`` receivers.
        """
        if not senders:
            return cls(IDLE, (), None, None, None)
        lost = tuple(reception.lost for reception in receptions)
        collided = tuple(reception.collided for reception in receptions)
        received = np.array([reception.received for reception in receptions])
        return cls(COLLISION if any(collided) else SUCCESS, tuple(senders), received, lost, collided)

    def mask(self, agents: int) -> NDArray[np.bool_]:
        """Return ``received`` written out, (F, N), also where it is None.

        :param agents: N, their number.
        """
        if self.received is not None:
            return self.received
        mask = np.ones((len(self.senders), agents), dtype=np.bool_)
        for row, sender in enumerate(self.senders):
            mask[row, sender - 1] = False
        return mask
