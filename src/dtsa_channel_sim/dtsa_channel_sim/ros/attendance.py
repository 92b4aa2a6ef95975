"""Which agents of a run in real time are heard, which have fallen silent, and which are back."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

_NS = 1_000_000_000
LOST_AFTER_S = 2.0  # an agent that others outlast by this is lost
_RETURN_SLOTS = 10  # a report for a slot that much after its agent was given up says that the agent is back


class Attendance:
    """Keeps the ids of lost agents in ``lost``. Times are ns from the start of slot 0; agents are ids."""

    def __init__(self, agents: int, lost: set[int]) -> None:
        self._lost = lost
        self.returned: set[int] = set()  # ids of those that were lost, and report again
        self._given_up: dict[int, int] = {}  # slot in which an agent was taken for lost, by id
        self._heard_ns = np.zeros(agents, dtype=np.int64)  # when each was heard last

    def begin(self) -> None:
        """Slot 0 is near: nobody has been heard yet."""
        self._heard_ns[:] = 0

    def expect_later(self, agent: int) -> None:
        """An agent that is lost because it comes later may come from slot 0 on."""
        self._given_up[agent] = -_RETURN_SLOTS

    def lose(self, agent: int, slot: int) -> bool:
        """Note in the present slot that an agent is gone; return whether that is new."""
        if agent in self._lost:
            return False
        self._lost.add(agent)
        self.returned.discard(agent)
        self._given_up[agent] = slot
        return True

    def hear(self, agents: Iterable[int], now: int) -> None:
        """Agents were heard."""
        index = np.fromiter(agents, dtype=np.intp) - 1
        self._heard_ns[index] = np.maximum(self._heard_ns[index], now)

    def excuse(self, stalled_ns: int, until_ns: int) -> None:
        """The channel has stood still: silence until then counts for no agent."""
        self._heard_ns[:] = np.maximum(self._heard_ns + stalled_ns, until_ns)

    def back(self, slot: int, answered: NDArray[np.bool_]) -> list[int]:
        """Ids of those that were lost and have reported for a slot; they are not lost any more."""
        again = [a for a in sorted(self._lost) if answered[a - 1] and slot > self._given_up[a] + _RETURN_SLOTS]
        self._lost.difference_update(again)
        self.returned.update(again)
        return again

    def silent_too_long(self, agents: Iterable[int]) -> list[int]:
        """Which of some agents are to be taken for lost.

        They are compared with the others: if nobody is heard, it may be the channel that got no time.
        """
        newest = int(self._heard_ns.max())
        return [agent for agent in agents if newest - self._heard_ns[agent - 1] > LOST_AFTER_S * _NS]
