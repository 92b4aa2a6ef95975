"""Slotted ALOHA by the age of incorrect information: who is not known as it is may send."""

from __future__ import annotations

import numpy as np

from dtsa_agent.core import ConfigError, Swarm, SwarmConfig

from .knowledge import moves, squared_errors


class ThresholdAoii:
    """Threshold policy on the age of incorrect information (AoII): from some age on an agent sends at random.

    The AoII of an agent is for how many slots in a row somebody has been wrong about it: by more than a distance, or
    about whether it is under way. From ``threshold`` slots on it sends with a probability, below it is silent. The
    setting is that of arXiv 2301.10987: slotted ALOHA, collisions, and every agent knows its own AoII, as perfect
    acknowledgements would tell it. There one gateway receives; here the receiver counts that has been wrong longest.
    That source starts from this policy and then refines it by a dual method, which is not here.

    Options: ``threshold-aoii.error_m`` (0.05), ``threshold-aoii.threshold`` (1 slot) and ``threshold-aoii.rate`` (1.0:
    the probability is rate / n, at most 1, with n agents under way). These values are assumptions.

    :raises ConfigError: for a negative distance, or a rate or a threshold that would let nobody send.
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
