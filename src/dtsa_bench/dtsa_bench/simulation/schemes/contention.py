"""Schemes in which agents contend for a slot, with help that real radios would have to provide."""

from __future__ import annotations

import numpy as np

from dtsa_agent.core import Swarm, SwarmConfig

from .knowledge import ages, error_about_self, moves

#: Of threshold ALOHA: age threshold over n and rate times n that give the least age for many agents.
THRESHOLD, RATE = 2.2, 4.69


class ThresholdAloha:
    """Threshold ALOHA: silent while one's own age is below 2.2 n, then sends with probability 4.69 / n.

    n is the number of agents under way. Sources: arXiv 2007.09197 and 2105.05129, where n sources send to one receiver
    that acknowledges; the mean age tends to 1.4169 n. Here all receive: an agent's age is that at the receiver that
    knows least, and acknowledgements are perfect and cost no air. It begins with ages that are spread at random: if all
    begin to contend together, collisions keep up that state for long. Options: ``threshold-aloha.threshold`` and
    ``threshold-aloha.rate``.
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
    """Contention by dominance: who is furthest from where the others must suppose it sends (CAN, WiDom).

    Each agent knows what it last sent, so it can tell how wrong those are who heard that. In a real slot these errors
    are compared bit by bit before the frame: a sent bit dominates over silence, who hears one it did not send gives up.
    That costs one turn-round of the radio a bit, 8 to 12 times 0.13 ms, for which slots have to leave room. Lost frames
    are not noticed.
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
