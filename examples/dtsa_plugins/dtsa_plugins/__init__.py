"""A policy, an estimator and an avoider. See docs/reference/plug-ins.md.

Everything here is a pure function of what the observer knows: no clock, no global random numbers. That is
what makes nodes and simulator agree, and flights repeatable.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dtsa import SwarmConfig, Table

Array = NDArray[np.float64]


class LeastKnown:
    """Policy: next is whoever may have strayed furthest from where all believe it to be (age times speed)."""

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        self.agents = config.agents
        self.every = 10  # each tenth slot is TDMA's, so that no agent is forgotten

    def choose(self, table: Table, slot: int) -> int:
        """Return the id of the agent expected to send in a slot, 0: none."""
        if slot < self.agents or slot % self.every == 0 or not table.in_ap.any():
            return slot // (1 if slot < self.agents else self.every) % self.agents + 1
        speed = np.sqrt((table.sent_velocity**2).sum(axis=0)) + 0.1
        stray = np.where(table.in_ap == 1, (slot - table.sent_slot) * speed, -1.0)
        return int(np.argmax(stray)) + 1


class Damped:
    """Estimator: an agent keeps its velocity at first and is believed to have come to rest after about a second."""

    options = ("rest_s",)

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        self.slot_s = config.slot_s
        self.control_s = config.slot_s / config.steps
        self.rest_s = config.options.get("damped.rest_s", 1.0)

    def estimate(self, table: Table, slot: int, step: int, position: Array, velocity: Array) -> None:
        """Writes positions (m) and velocities (m/s), (3, N)."""
        age = np.where(table.sent_slot < 0, 0.0, (slot - table.sent_slot) * self.slot_s + step * self.control_s)
        left = 1.0 / (1.0 + age / self.rest_s)  # no exp: its last bit depends on the machine
        velocity[:] = table.sent_velocity * left
        position[:] = table.sent_position + table.sent_velocity * age * (1.0 + left) / 2.0


class GiveWay:
    """Avoider: flies straight to its goal, and pushes off from whoever is near, to its right.

    It is here to be read, not to be flown: it knows nothing of speeds and crashes sooner than ``orca``.
    """

    model = "potential"  # its vehicle, its spacing

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        self.index = agent - 1
        self.reach = 1.2  # m

    def command(self, table: Table, slot: int, step: int) -> tuple[float, float, float]:
        """Commanded velocity, m/s, frame map."""
        away = table.goal - table.own_position
        distance = math.sqrt(float(away @ away))
        wish = away * min(2.0, 1.0 / max(distance, 1e-9))
        gap = table.own_position[:, None] - table.estimate_position
        length = np.sqrt((gap * gap).sum(axis=0))
        near = (length < self.reach) & (np.arange(len(length)) != self.index)
        for k in np.flatnonzero(near):
            push = 0.6 * (self.reach / max(float(length[k]), 0.05) - 1.0)
            x, y, z = gap[:, k] / max(float(length[k]), 1e-9)
            wish = wish + push * np.array([x + 0.5 * y, y - 0.5 * x, z])
        speed = math.sqrt(float(wish @ wish))
        return tuple(float(c) for c in wish / max(1.0, speed))  # at most 1 m/s
