"""What the channel says about one slot."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

#: Nobody sent.
IDLE = 0
#: One frame, or several that disturbed nobody.
SUCCESS = 1
#: Frames destroyed each other at one receiver or more.
COLLISION = 2
#: Names of the outcomes, indexed by their number.
OUTCOMES = ("idle", "success", "collision")


class Verdict(NamedTuple):
    """Who sent in a slot, and who received what.

    The outcome speaks of disturbed frames only: a single frame that every receiver lost to noise or to a
    jammer is a SUCCESS with ``lost`` counting all of them.
    """

    outcome: int
    """IDLE, SUCCESS or COLLISION, the numbers of dtsa_msgs/Reception."""
    senders: tuple[int, ...]
    """Ids of all agents that sent, in the order given."""
    received: NDArray[np.bool_] | None
    """(F, N): frame f reached the agent with id column + 1. None: everybody but the sender has all."""
    lost: tuple[int, ...] | None
    """Per frame: receivers in reach that lost it to noise or jamming. None: none."""
    collided: tuple[int, ...] | None
    """Per frame: receivers in reach where it collided or that were sending themselves. None: none."""

    def mask(self, agents: int) -> NDArray[np.bool_]:
        """Return ``received`` written out, (F, N), also where it is None.

        :param agents: number of agents N.
        """
        if self.received is not None:
            return self.received
        mask = np.ones((len(self.senders), agents), dtype=np.bool_)
        for row, sender in enumerate(self.senders):
            mask[row, sender - 1] = False
        return mask
