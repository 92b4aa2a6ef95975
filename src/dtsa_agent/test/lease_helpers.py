"""Swarms of policy ``lease``, and a channel for them, for the tests of its rules."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from frame_helpers import encode_extended

from dtsa_agent.core import Scenario, Swarm, SwarmConfig
from dtsa_agent.core.frame import ExtendedFrame, decode_extended
from dtsa_agent.core.reference.lease import Memory
from dtsa_agent.core.reference.stepper import ReferenceSwarm
from dtsa_agent.core.reference.table import Rules

FAR = 1e6  # m, a goal that nobody reaches
STATEMENTS = pytest.mark.parametrize("statement", [Swarm, ReferenceSwarm], ids=["C", "Python"])


def still(agents: int) -> Scenario:
    places = np.round(np.random.default_rng(agents).uniform(-6, 6, (3, agents)), 3)
    return Scenario(places, places.copy(), np.zeros(agents, dtype=np.bool_), goals_known=False)


def make(
    agents: int = 12, movers: int = 6, local: list[int] | None = None, statement: Any = Swarm, **settings: Any
) -> Swarm:
    """Agents that stand still; the first ``movers`` ids have something to say."""
    config = SwarmConfig(agents=agents, **{"policy": "lease", "avoider": "none", **settings})
    swarm: Swarm = statement(config, still(agents), local=local)
    swarm.active[:] = 0
    swarm.goal[0, np.array(swarm.ids) <= movers] = FAR
    return swarm


class Air:
    """A channel for a swarm: draws who receives what; keeps what was sent."""

    def __init__(self, swarm: Swarm, loss: float = 0.0, flying: bool = False) -> None:
        self.swarm, self.loss, self.flying = swarm, loss, flying
        self.random = np.random.default_rng(1)
        self.slot = 0
        self.sent: list[tuple[int, ...]] = []  # ids by slot
        self.frames: dict[int, ExtendedFrame] = {}  # those that were alone in their slot
        self.chosen: list[list[int]] = []  # by slot: whom each expects
        self.also: list[Callable[[int, bytes, np.ndarray], object]] = []

    def run(
        self, slots: int, jam: bool = False, deaf: dict[int, set[int]] | None = None,
        changed: Callable[[int, ExtendedFrame], ExtendedFrame] = lambda slot, frame: frame,
    ) -> Air:  # fmt: skip
        """Let slots pass; deaf: ids that each does not hear, by id; changed: makes another frame of a slot's."""
        swarm = self.swarm
        for slot in range(self.slot, self.slot + slots):
            if self.flying:
                swarm.scenario.advance(slot, swarm)
            senders = swarm.begin(slot)
            self.sent.append(tuple(swarm.ids[k] for k in senders))
            self.chosen.append(swarm.chosen.tolist())
            mask = (self.random.random(len(swarm.ids)) >= self.loss).astype(np.uint8)
            frame = swarm.frame(senders[0]) if len(senders) == 1 else b""
            if self.flying:
                swarm.fly(slot)
            if frame:
                mask &= [self.sent[slot][0] not in (deaf or {}).get(k, ()) for k in swarm.ids]
                self.frames[slot] = decode_extended(frame)
                if not jam:
                    data = encode_extended(changed(slot, self.frames[slot]))
                    assert swarm.hear(slot, data, mask)
                    for hear in self.also:
                        hear(slot, data, mask)
            swarm.end(slot)
        self.slot += slots
        return self

    def own(self, agent: int, first: int) -> list[int]:
        return [slot for slot in range(first, self.slot) if self.sent[slot] == (agent,)]

    def leases(self, first: int, last: int) -> int:
        return sum(sum(b > 0 for b in self.frames[t].leases) for t in range(first, last) if t in self.frames)


def is_anchor(slot: int, agents: int, every: int = 3) -> bool:
    return Memory(Rules(agents=agents, slot_s=0.01, anchor_every=every)).is_anchor(slot)
