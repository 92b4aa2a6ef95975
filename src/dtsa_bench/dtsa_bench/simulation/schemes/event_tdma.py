"""Event-triggered TDMA: an agent uses its turn only if others would be wrong about it."""

from __future__ import annotations

import math

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.plugins.entry_points import Table

from .knowledge import has_arrived


class EventTdma:
    """TDMA in which the owner is silent while its last frame, moved on, is right to within some distance.

    It saves air, not time: nobody else uses the turn. After the idea of the wireless control bus, arXiv 2101.10961.
    Options: ``event-tdma.error_m`` (0.05) and ``event-tdma.rounds`` (10: the longest silence).
    """

    options = ("error_m", "rounds")
    may_join = True

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        self._agents, self._agent, self._slot_s = config.agents, agent, config.slot_s
        self._r_min = config.r_min
        self._hold = config.estimator == "hold"
        self._error = config.options.get("event-tdma.error_m", 0.05)
        self._silence = config.options.get("event-tdma.rounds", 10.0) * config.agents

    def choose(self, table: Table, slot: int) -> int:
        """The owner; who is the owner and has nothing to say, nobody."""
        owner = slot % self._agents + 1
        return owner if owner != self._agent or self._must_send(table, slot) else 0

    def _must_send(self, table: Table, slot: int) -> bool:
        own = self._agent - 1
        sent = int(table.sent_slot[own])
        if sent < 0 or slot - sent >= self._silence:
            return True
        if has_arrived(table, self._r_min) == bool(table.in_ap[own]):
            return True  # has set out, or has arrived, and not said so yet
        moved = table.sent_position[:, own]
        if not self._hold:
            moved = moved + table.sent_velocity[:, own] * ((slot - sent) * self._slot_s)
        assert table.own_position is not None
        return math.dist(table.own_position, moved) > self._error
