"""Swarms of policy ``lease`` for the tests of its rules."""

from __future__ import annotations

import numpy as np

from dtsa_agent.core import Scenario
from dtsa_agent.core.reference.lease.memory import Memory
from dtsa_agent.core.reference.rules import Rules

FAR = 1e6  # m, a goal that nobody reaches


def still(agents: int) -> Scenario:
    """Agents that stay where they are."""
    places = np.round(np.random.default_rng(agents).uniform(-6, 6, (3, agents)), 3)
    return Scenario(places, places.copy(), np.zeros(agents, dtype=np.bool_), goals_known=False)


def is_anchor(slot: int, agents: int, every: int = 5) -> bool:
    """Whether a slot is an anchor of its owner."""
    return Memory(Rules(agents=agents, slot_s=0.01, anchor_every=every)).is_anchor(slot)
