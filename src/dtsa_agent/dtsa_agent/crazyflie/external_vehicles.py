"""Agents whose vehicles fly elsewhere: protocol, estimator and avoider as ever, commands in place of motion."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.abstract_swarm import AbstractSwarm, SwarmWrapper

HOLD_GAIN = 1.0  # 1/s, for agents that hover: real air does not leave them where they are
HOLD_MPS = 0.3


class ExternalVehicles(SwarmWrapper):
    """A swarm that steers vehicles which are flown by somebody else.

    :param inner: the swarm; positions and velocities are written into it from outside.
    :param every: slots between two commands.
    :param send: takes the commanded velocities, (3, L), m/s, frame map.
    """

    def __init__(self, inner: AbstractSwarm, every: int, send: Callable[[NDArray[np.float64]], None]) -> None:
        super().__init__(inner)
        self._every, self._send = every, send
        self._hold = self.scenario.start[:, self.local].copy()  # (3, L) m, frame map
        self._stopping = False

    def place(self, position: NDArray[np.float64]) -> None:
        """Takes in where the vehicles are.

        :param position: (3, L) m, frame map.
        """
        self.position[:] = position
        self.track[:] = position

    def stop_here(self) -> None:
        """From now on nobody flies to its goal: all come to rest, and keep out of each other's way as before."""
        self._stopping = True

    def fly(self, slot: int) -> None:
        if slot % self._every:
            return
        self._steer(slot)
        still = self.active == 0
        if still.any():
            away = self._hold[:, still] - self.position[:, still]
            self.command[:, still] = np.clip(HOLD_GAIN * away, -HOLD_MPS, HOLD_MPS)
        self._send(self.command)

    def _steer(self, slot: int) -> None:
        goal = self.goal.copy()  # the protocol still counts with it
        if self._stopping:
            self.goal[:] = self.position  # nothing else to wish for than to be at rest
        self.steer(slot, 0)
        self.goal[:] = goal
