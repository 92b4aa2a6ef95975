"""The end of agents that get a signal: each says in its own turns that it leaves, and is gone then."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.frame import decode_extended
from dtsa_agent.core.swarm import PRESENT_LEAVING, Swarm


class Leaving:
    """The agents of one process, which leave together.

    :param swarm: the agents.
    """

    def __init__(self, swarm: Swarm) -> None:
        self._swarm = swarm
        self._by: int | None = None  # slot: all have left then at the latest; None: nobody leaves
        self._signals = 0  # when it began
        self._gone: NDArray[np.bool_] = np.zeros(len(swarm.ids), dtype=np.bool_)  # has said on the air that it leaves

    @property
    def begun(self) -> bool:
        """Whether the agents leave."""
        return self._by is not None

    def begin(self, signals: int, slot: int) -> bool:
        """From now on the agents leave; False: their policy has no way to say so.

        :param signals: number of signals that have come so far.
        :param slot: number of the present slot.
        """
        config = self._swarm.config
        if not config.policy_row.says_leaving:
            return False
        self._signals, self._by = signals, slot + (config.main_every + 1) * config.agents
        for index in range(len(self._swarm.ids)):
            self._swarm.leave(index)
        return True

    def goes_on(self, signals: int, slot: int) -> bool:
        """Whether somebody still has to say it; not after another signal, nor for ever.

        :param signals: number of signals that have come so far.
        :param slot: number of the present slot.
        """
        in_time = signals == self._signals and self._by is not None and slot <= self._by
        return in_time and bool((self._swarm.present == PRESENT_LEAVING).any())

    def mark(self) -> None:
        """Before a slot is decided: those that have not said it yet shall say it in their next frame."""
        if self.begun:
            self._swarm.present[~self._gone] = PRESENT_LEAVING

    def sent(self, index: int, data: bytes) -> None:
        """A frame was sent; takes note if it says that its agent leaves.

        :param index: position of the agent.
        :param data: the frame, sealed or not.
        """
        if self._swarm.present[index] == PRESENT_LEAVING:
            config = self._swarm.config
            frame = decode_extended(config.protocol_part(data, sealed=True), config.extent_m)
            self._gone[index] = frame.leaving
