"""Ages and errors of agents that have tables of their own, and what an agent can tell by itself."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Swarm
from dtsa_agent.core.plugins import Table

Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]


def moves(swarm: Swarm) -> Mask:
    """Which agents are under way: (N,), present and further than r_min from where they fly to."""
    away = swarm.goal - swarm.position
    far = (away * away).sum(axis=0) > swarm.config.r_min**2
    return np.asarray(far & (swarm.present > 0))


def has_arrived(table: Table, r_min: float) -> bool:
    """Whether an agent is where it flies to: what it can tell by itself. ``r_min``: m, closer it has arrived."""
    assert table.own_position is not None
    assert table.goal is not None
    return math.dist(table.own_position, table.goal) <= r_min


def counts(swarm: Swarm) -> Mask:
    """Which pairs count: (N, N), observer by agent: the agent moves, or the observer still takes it for a mover."""
    there = swarm.present > 0
    pairs = (swarm.in_ap > 0) | moves(swarm)[None, :]
    pairs &= there[:, None] & there[None, :]
    np.fill_diagonal(pairs, False)
    return np.asarray(pairs)


def ages(swarm: Swarm, slot: int) -> Floats:
    """Ages at the start of a slot: (N, N) slots, observer by agent; 0: heard in the slot that has just ended.

    An agent that was never heard counts as heard before slot 0.
    """
    return (slot - 1 - swarm.sent_slot).astype(np.float64)


def squared_errors(swarm: Swarm, slot: int) -> Floats:
    """Squared errors of all estimates at the start of a slot: (N, N) m^2, observer by agent."""
    swarm.estimate(slot)
    off = swarm.estimate_position - swarm.position[None]
    return np.asarray((off * off).sum(axis=1))


def error_about_self(swarm: Swarm, slot: int) -> Floats:
    """How far each agent is from where its last frame, moved on, puts it: (N,) m. Each can tell that by itself."""
    n = np.arange(swarm.config.agents)
    age_s = (slot - swarm.sent_slot[n, n]) * swarm.config.slot_s
    moved = swarm.sent_position[n, :, n].T + swarm.sent_velocity[n, :, n].T * age_s
    off = swarm.position - moved
    error = np.sqrt((off * off).sum(axis=0))
    return np.where(swarm.sent_slot[n, n] < 0, np.inf, error)


def whittle_index(age: Floats, loss: float) -> Floats:
    """What a transmission is worth at an age: the price at which waiting for a slot more costs as much, slots.

    For one link whose age costs 1 a slot: p h (h + 2 / p - 1) / 2 with p = 1 - loss (Kadota and others, arXiv
    1801.01803).

    :param age: slots, h, 1: heard in the slot that has just ended.
    :param loss: probability that a frame is lost, below 1.
    """
    arrives = 1.0 - loss
    return np.asarray(0.5 * arrives * age * (age + 2.0 / arrives - 1.0))
