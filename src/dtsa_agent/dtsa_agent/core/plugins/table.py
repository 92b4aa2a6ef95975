"""What a plug-in sees of its agent: the table of one observer."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.swarm import Swarm


class Table:
    """What one observer knows; arrays are read-only windows on its table and are always up to date.

    Positions are m, velocities m/s, frame map, with shape (3, N); agent ``id`` is column ``id - 1``.
    """

    def __init__(self, swarm: Swarm, row: int) -> None:
        self._swarm, self._row = weakref.proxy(swarm), row  # a swarm has its tables: no cycle
        self.agent = int(swarm.observer[row]) + 1  # id of the observer, 0: one that hears everything
        self.config = swarm.config
        self.scenario = swarm.scenario
        self.sent_position = _window(swarm.sent_position[row])  # last heard (own: last sent) state
        self.sent_velocity = _window(swarm.sent_velocity[row])
        self.sent_intent = _window(swarm.sent_intent[row])  # commanded velocity, zero unless frames carry it
        self.sent_slot = _window(swarm.sent_slot[row])  # (N,) slot of that state, -1: never heard
        self.last_turn = _window(swarm.last_turn[row])  # (N,) slot of the last turn; h = slot - 1 - last_turn
        self.in_ap = _window(swarm.in_ap[row])  # (N,) A_p
        self.estimate_position = _window(swarm.estimate_position[row])  # as the estimator last filled them
        self.estimate_velocity = _window(swarm.estimate_velocity[row])
        here = row < len(swarm.ids)
        self.own_position = _window(swarm.position[:, row]) if here else None  # (3,) own true state
        self.own_velocity = _window(swarm.velocity[:, row]) if here else None
        self.goal = _window(swarm.goal[:, row]) if here else None

    def observation(self, slot: int) -> NDArray[np.float32]:
        """What the agent has heard before a slot and its own state, as numbers for learning (docs/how-to/learning.md).

        :raises ValueError: for the table of an agent that is elsewhere.
        """
        observed: NDArray[np.float32] = self._swarm.observations(slot, self._row, self._row + 1)[0]
        return observed


def _window(array: NDArray[Any]) -> NDArray[Any]:
    window: NDArray[Any] = array.view()
    window.flags.writeable = False
    return window
