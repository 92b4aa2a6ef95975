"""Bounds: who sends is chosen with what all agents know and where all are. No real scheme can know that."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import ConfigError, Swarm, SwarmConfig

from .knowledge import ages, counts, moves, squared_errors, whittle_index


def heaviest(weight: NDArray[np.float64], slot: int) -> list[int]:
    """The id with the largest weight; where no agent has any, the slot's owner under TDMA."""
    best = int(weight.argmax())
    return [best + 1 if weight[best] > 0 else slot % len(weight) + 1]


class GenieAge:
    """The agent with the largest sum of true ages at all receivers, over pairs that count as movers.

    For one base station and equal links greedy is optimal (Kadota and others, arXiv 1801.01803); here it is no optimum.
    """

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        del config, agent

    def senders(self, swarm: Swarm, slot: int) -> list[int]:
        """One id."""
        return heaviest(np.where(counts(swarm), ages(swarm, slot), 0.0).sum(axis=0), slot)


class GenieInnovation:
    """:class:`GenieAge`, where the ages of an agent are weighed by the change of velocity in its last frame.

    An agent that brakes or swerves has sent a velocity that it will not keep, so it is heard again soon. The setting
    ``age_cap`` counts as with ``dtsa``: an agent whose mean age is so many times the number of movers goes first.
    """

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        del agent
        self._cap = config.age_cap

    def senders(self, swarm: Swarm, slot: int) -> list[int]:
        """One id."""
        pairs = counts(swarm)
        age = np.where(pairs, ages(swarm, slot), 0.0).sum(axis=0)
        mean = age / np.maximum(pairs.sum(axis=0), 1)
        if self._cap and mean.max() >= self._cap * np.count_nonzero(moves(swarm)) > 0:
            return [int(mean.argmax()) + 1]
        return heaviest(age * (0.02 + np.diagonal(swarm.innovation)), slot)


class Whittle:
    """The agent with the largest sum of Whittle's indices of the true ages at all receivers, each that of one link.

    Option: ``whittle.loss`` (0): the probability that a receiver loses a frame, which has to be known.
    """

    options = ("loss",)

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        del agent
        self._loss = config.options.get("whittle.loss", 0.0)
        if not 0.0 <= self._loss < 1.0:
            raise ConfigError("whittle.loss", self._loss, "0 to below 1")

    def senders(self, swarm: Swarm, slot: int) -> list[int]:
        """One id."""
        index = whittle_index(ages(swarm, slot) + 1.0, self._loss)
        return heaviest(np.where(counts(swarm), index, 0.0).sum(axis=0), slot)


class GenieError:
    """The agent about whose position the others err most: the largest sum of squared errors (try-once-discard).

    An agent that has just woken is waiting to be heard, and nobody errs about it yet: it comes first. Among agents
    about whom nobody errs the longest silent comes first.
    """

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        del config, agent

    def senders(self, swarm: Swarm, slot: int) -> list[int]:
        """One id."""
        pairs = counts(swarm)
        if not pairs.any():
            return [slot % swarm.config.agents + 1]
        unknown = moves(swarm) & (pairs & (swarm.in_ap == 0)).any(axis=0)
        age = np.where(pairs, ages(swarm, slot), 0.0).sum(axis=0)
        if unknown.any():
            return [int(np.where(unknown, age, -1.0).argmax()) + 1]
        error = np.where(pairs, squared_errors(swarm, slot), 0.0).sum(axis=0)
        worst = np.flatnonzero(error >= error.max())
        return [int(worst[age[worst].argmax()]) + 1]
