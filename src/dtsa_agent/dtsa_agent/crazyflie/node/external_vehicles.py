"""Agents whose vehicles fly elsewhere: protocol, estimator and avoider as ever, commands in place of motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.swarm import Swarm

HOLD_GAIN = 1.0  # 1/s, for agents that hover: real air does not leave them where they are
HOLD_MPS = 0.3
SPREAD_M = 0.45  # horizontally: closer than this nobody comes to rest, since all land straight down
NOWHERE_M = 1e-3
PUSH_M = 0.3  # farther than this at once nobody makes way


class ExternalVehicles:
    """Vehicles that agents steer and somebody else flies.

    :param swarms: the agents, in one or several swarms; positions and velocities are written into them from outside.
    :param every: slots between two commands.
    :param send: takes the place of a swarm and its agents' commanded velocities, m/s, frame map.
    """

    def __init__(self, swarms: Sequence[Swarm], every: int, send: Callable[[int, NDArray[np.float64]], None]) -> None:
        self._swarms, self._every, self._send = swarms, every, send
        ends = np.cumsum([len(swarm.ids) for swarm in swarms]).tolist()
        self._columns = [slice(end - len(swarm.ids), end) for swarm, end in zip(swarms, ends, strict=True)]
        self._stopping = False

    def place(self, position: NDArray[np.float64]) -> None:
        """Takes in where the vehicles are, (3, L) m, frame map."""
        for swarm, columns in zip(self._swarms, self._columns, strict=True):
            swarm.position[:] = swarm.track[:] = position[:, columns]

    def stop_here(self) -> None:
        """From now on nobody flies to its goal: all come to rest, and nobody above another one.

        They keep out of each other's way as before.
        """
        self._stopping = True

    def fly(self, slot: int, index: int = 0) -> None:
        """Sends the commands of a slot to the vehicles of a swarm."""
        if slot % self._every:
            return
        swarm = self._swarms[index]
        goal = swarm.goal.copy()  # the protocol still counts with it
        if self._stopping:
            swarm.goal[:] = swarm.position + self._way()[:, self._columns[index]]
        swarm.steer(slot, 0)
        swarm.goal[:] = goal
        still = swarm.active == 0
        if still.any():
            away = (swarm.scenario.start[:, swarm.local] - swarm.position)[:, still]
            swarm.command[:, still] = np.clip(HOLD_GAIN * away, -HOLD_MPS, HOLD_MPS)
        self._send(index, swarm.command)

    def _way(self) -> NDArray[np.float64]:
        """Where each goes to make way for those that are near horizontally, at whatever height, (3, L) m."""
        position = np.concatenate([swarm.position for swarm in self._swarms], axis=1)
        apart = position[:2, :, None] - position[:2, None, :]
        distance = np.linalg.norm(apart, axis=0)
        index = np.arange(distance.shape[0])
        above = (distance < NOWHERE_M) & (index[:, None] != index)  # one right above the other: by their numbers
        apart[0] += np.where(above, np.sign(index[:, None] - index) * NOWHERE_M, 0.0)
        distance = np.maximum(np.linalg.norm(apart, axis=0), NOWHERE_M)
        way = np.zeros_like(position)
        way[:2] = (apart / distance * np.maximum(SPREAD_M - distance, 0.0)).sum(axis=2)
        return way * np.minimum(1.0, PUSH_M / np.maximum(np.linalg.norm(way, axis=0), NOWHERE_M))
