"""Schemes in which agents contend for a slot, by chance, by dominance or by listening: what such radios could gain."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import ConfigError, Swarm, SwarmConfig

from .knowledge import ages, error_about_self, moves, squared_errors

#: Of threshold ALOHA: age threshold over n and rate times n that give the least age for many agents.
THRESHOLD, RATE = 2.2, 4.69


class ThresholdAloha:
    """Threshold ALOHA: silent while its own age is below 2.2 n, then it sends with probability 4.69 / n; n agents move.

    arXiv 2007.09197 and 2105.05129 have one receiver that acknowledges. Here an agent's age is that at the receiver
    that knows least, and acknowledgements are perfect. Ages are spread at random at first: agents that all begin to
    contend at once do so for long. Options: ``threshold-aloha.threshold`` and ``threshold-aloha.rate``.
    """

    options = ("threshold", "rate")

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        del agent
        self._threshold = config.options.get("threshold-aloha.threshold", THRESHOLD)
        self._rate = config.options.get("threshold-aloha.rate", RATE)
        self._random = np.random.default_rng([config.seed, 20070])
        self._head_start = self._random.random(config.agents)  # ages at the beginning, in thresholds

    def senders(self, swarm: Swarm, slot: int) -> list[int]:
        """Ids of all whose draw says so; several collide."""
        draws = self._random.random(swarm.config.agents)
        under_way = moves(swarm)
        n = int(np.count_nonzero(under_way))
        if not n:
            return [slot % swarm.config.agents + 1]
        age = ages(swarm, slot)
        np.fill_diagonal(age, 0.0)
        never = swarm.sent_slot.min(axis=0) < 0
        oldest = age.max(axis=0) + np.where(never, self._head_start * self._threshold * n, 0.0)
        ready = under_way & (oldest + 1 >= self._threshold * n) & (draws < self._rate / n)
        return [int(k) + 1 for k in np.flatnonzero(ready)]


class Dominance:
    """Contention by dominance: the agent farthest from where its last frame, moved on, puts it (CAN, WiDom).

    In a real slot these errors are compared bit by bit before the frame, where a sent bit dominates over silence: 8 to
    12 turn-rounds of the radio, 0.13 ms each, for which slots have to leave room. Lost frames are not noticed.
    """

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        del config, agent

    def senders(self, swarm: Swarm, slot: int) -> list[int]:
        """One id: equal errors go by the longest silence, as an id and a counter would follow in the bits."""
        n = np.arange(swarm.config.agents)
        error = np.where(swarm.present > 0, error_about_self(swarm, slot), -1.0)
        waiting = moves(swarm) != (swarm.in_ap[n, n] > 0)  # has set out, or arrived, and not said so yet
        error = np.where(waiting & (swarm.present > 0), np.inf, error)
        worst = np.flatnonzero(error >= error.max())
        silent = slot - swarm.sent_slot[worst, worst]
        return [int(worst[silent.argmax()]) + 1]


class Sense:
    """Radios that listen inside a slot: its owner first where it has something unexpected to send, else movers by rank.

    The owner begins at once if it has set out and not announced that, and in one of ``sense.rounds`` (15) rounds. Else
    each mover waits for as many guard times as its rank, and gives up when it senses a frame. Rank 1 has the mover
    whose last turn is longest ago; ranks above ``sense.ranks`` (4) do not try. Turns are sensed, also where the frame
    is lost. Where tables differ in who moves, two may have the same rank, and collide. All sense each other.
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


class ThresholdAoii:
    """Slotted ALOHA by the age of incorrect information (AoII), for how many slots in a row some agent has been wrong.

    Wrong: by more than ``threshold-aoii.error_m`` (0.05), or about whether the agent is under way. From
    ``threshold-aoii.threshold`` (1 slot) on it sends with probability ``threshold-aoii.rate`` (1.0) / n, n agents under
    way. arXiv 2301.10987 has one gateway and refines this policy by a dual method; every agent knows its own AoII.
    """

    options = ("error_m", "rate", "threshold")

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        del agent
        self._error = config.options.get("threshold-aoii.error_m", 0.05)
        self._threshold = config.options.get("threshold-aoii.threshold", 1.0)
        self._rate = config.options.get("threshold-aoii.rate", 1.0)
        for name, value, low in (("error_m", self._error, 0.0), ("threshold", self._threshold, 1.0)):
            if not value >= low:
                raise ConfigError(f"threshold-aoii.{name}", value, f"at least {low:g}")
        if not self._rate > 0.0:
            raise ConfigError("threshold-aoii.rate", self._rate, "above 0")
        self._random = np.random.default_rng([config.seed, 2301])
        #: (N,) slots for which somebody has been wrong about each agent.
        self.age = np.zeros(config.agents, dtype=np.int64)

    def senders(self, swarm: Swarm, slot: int) -> list[int]:
        """Ids of all whose draw says so; several collide. While nobody is under way, the slot's owner under TDMA."""
        draws = self._random.random(swarm.config.agents)
        under_way, there = moves(swarm), swarm.present > 0
        wrong = (squared_errors(swarm, slot) > self._error**2) | ((swarm.in_ap > 0) != under_way[None, :])
        wrong &= there[:, None] & there[None, :]
        np.fill_diagonal(wrong, False)
        self.age = np.where(wrong.any(axis=0), self.age + 1, 0)
        n = int(np.count_nonzero(under_way))
        if not n and not wrong.any():
            return [slot % swarm.config.agents + 1]
        ready = (self.age >= self._threshold) & (draws < self._rate / max(1, n))
        return [int(k) + 1 for k in np.flatnonzero(ready)]
