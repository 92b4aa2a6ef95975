"""What the channel says about one slot."""

from __future__ import annotations

from typing import NamedTuple

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

    outcome: int  # IDLE, SUCCESS or COLLISION, the numbers of dtsa_msgs/Reception
    senders: tuple[int, ...]  # ids of all agents that sent, in the order given
    received: NDArray[np.bool_] | None  # (F, N) frame f reached agent column + 1; None: all but the sender have all
    lost: tuple[int, ...] | None  # per frame: receivers in reach that lost it to noise or jamming; None: none
    collided: tuple[int, ...] | None  # per frame: receivers where it collided or that were sending; None: none

    def mask(self, agents: int) -> NDArray[np.bool_]:
        """Return ``received`` written out, (F, N), also where it is None."""
        if self.received is not None:
            return self.received
        mask = np.ones((len(self.senders), agents), dtype=np.bool_)
        for row, sender in enumerate(self.senders):
            mask[row, sender - 1] = False
        return mask
