"""Radios that listen before they talk inside a slot: what such hardware could gain."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Swarm, SwarmConfig

from .knowledge import moves


class Sense:
    """The slot's owner first where it has something unexpected to say; else, after guard times, who moves.

    TDMA's owner begins at once if it has set out and not said so yet, and in one of ``sense.rounds`` (15) rounds,
    another one for each owner. Otherwise each agent that has said that it moves waits for as many guard times as its
    rank says, and gives up when it senses a frame; who has arrived says so in its next turn. Of those that it takes for
    movers the one whose last turn is longest ago has rank 1; who lets its turns pass has arrived; ranks above
    ``sense.ranks`` (4) do not try. Turns are sensed, also where the frame is lost: the guard times say whose it was.
    Where tables differ in who moves, two may have the same rank, and collide. No turn is given away, so nobody needs to
    hear of it, and who wakes waits N slots at most. All sense each other. A guard time is the turn-round of a radio and
    the time in which it senses, for which slots have to leave room.
    """

    options = ("rounds", "ranks")

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        del agent
        self._rounds = max(1, round(config.options.get("sense.rounds", 15.0)))
        self._ranks = config.options.get("sense.ranks", 4.0)
        self._turn = np.full(config.agents, -1, dtype=np.int64)  # slot of each one's last turn, as all have sensed it

    def senders(self, swarm: Swarm, slot: int) -> list[int]:
        """The owner's id, or those of the lowest rank: several collide."""
        chosen = self._chosen(swarm, slot)
        self._turn[chosen] = slot
        return [int(k) + 1 for k in chosen]

    def _chosen(self, swarm: Swarm, slot: int) -> NDArray[np.int64]:
        """Indices of those that send."""
        n = np.arange(swarm.config.agents)
        owner = slot % len(n)
        there, said = swarm.present > 0, swarm.in_ap[n, n] > 0
        due = self._turn[owner] < 0 or (slot // len(n) + owner) % self._rounds == 0
        if there[owner] and (due or (moves(swarm)[owner] and not said[owner])):
            return n[owner : owner + 1]
        contend = np.flatnonzero(said & there)
        if not contend.size:
            return contend
        order = self._turn * len(n) + n
        rivals = swarm.in_ap[contend] > 0
        silent = slot - self._turn[None, :] > 2 * rivals.sum(axis=1)[:, None] + 4  # has arrived: its turns came
        rank = (rivals & ~silent & (order < order[contend][:, None])).sum(axis=1) + 1
        first = int(rank.min())
        return contend[rank == first] if first <= self._ranks else contend[:0]
