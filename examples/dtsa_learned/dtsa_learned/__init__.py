"""A policy whose rules can be learned: ``learned``. See README.md; it needs NumPy alone."""

from __future__ import annotations

from dtsa_agent.core import ConfigError, SwarmConfig
from dtsa_agent.core.plugins.table import Table

from .rules import learned_rules
from .turns import Turns


class Learned:
    """Policy: turns by claims that grow at learned rates; each agent computes them from its own table alone.

    Frames have to be of format ``extended``: what they gossip keeps the tables of agents alike.
    """

    may_join = True

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        if config.frame != "extended":
            raise ConfigError("frame", config.frame, "extended, with policy learned")
        self._agents, self._agent = config.agents, agent
        self._turns: Turns | None = None

    def choose(self, table: Table, slot: int) -> int:
        """Id of the sender of a slot, 0: nobody."""
        if self._turns is None:
            quiet_until = slot + 2 * self._agents if slot else 0
            self._turns = Turns([learned_rules(self._agents)], self._agents, [self._agent], quiet_until)
        sends = self._turns(slot, table.sent_slot[None, None], table.in_ap[None, None] > 0)
        plan = int(self._turns.plan[0, 0])
        return plan if plan != self._agent or sends[0, 0] else 0
