"""Whom the agents of a merged flight knew, and how long ago they had heard each other themselves.

Mean ages leave out whom an observer never heard, and count what it was told of an agent by way of others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dtsa_agent.air.record import SlotRecord
from dtsa_agent.core import Swarm, SwarmConfig


def all_known_after(config: SwarmConfig) -> int:
    """Slots after which each agent that is there can be known to all that hear it: (M + 2) N."""
    return (config.heard_every + 2) * config.agents


class KnownPairs:
    """Pairs of two agents that are there: which of them knew each other, and the oldest frame heard."""

    def __init__(self, config: SwarmConfig, observers: Sequence[int]) -> None:
        self._slot_ms, self._fresh = config.slot_ms, all_known_after(config)
        self._row = {agent: row for row, agent in enumerate(observers)}
        self._heard: dict[tuple[int, int], int] = {}  # slot of the newest frame, by observer and sender
        self._first = 0
        self._pairs = self._known = self._age_max = 0
        self._oldest: tuple[int, int] | None = None

    def hear(self, observer: int, record: SlotRecord) -> None:
        """Takes in what an agent heard in a slot."""
        for one in (*record.before, *record.heard):
            pair = observer, one.sender
            self._heard[pair] = max(one.slot, self._heard.get(pair, one.slot))

    def begin(self, slot: int) -> None:
        """Results count from a slot on; who was never heard is as old as they are."""
        self._first = slot

    def follow(self, slot: int, here: Sequence[int], tables: Swarm) -> None:
        """Takes in the end of a slot."""
        for observer in here:
            sent = tables.sent_slot[self._row[observer]].tolist()
            for other in here:
                if other == observer:
                    continue
                self._pairs += 1
                self._known += sent[other - 1] >= max(0, slot - self._fresh)
                age = slot - self._heard.get((observer, other), self._first - 1)
                if age > self._age_max or self._oldest is None:
                    self._age_max, self._oldest = age, (observer, other)

    def summary(self) -> dict[str, Any]:
        """Plain values; None where no two were there."""
        return {
            "pairs_known_share": self._known / self._pairs if self._pairs else None,
            "heard_age_max_slots": self._age_max if self._oldest else None,
            "heard_age_max_ms": self._age_max * self._slot_ms if self._oldest else None,
            "heard_age_max_pair": list(self._oldest) if self._oldest else None,
        }
