"""Policies, estimators and avoiders from other packages, found by entry point. See docs/reference/plug-ins.md.

A package announces them in its metadata::

    [project.entry-points."dtsa.policies"]
    reverse = "my_package:Reverse"

and then ``policy="reverse"`` works everywhere: in `simulate`, `sweep` and in the nodes. What is announced is
a factory; it is called once for every observer, as ``factory(config, agent)`` (agent: its id, 0 for tables
that hear everything). What it makes is one of :mod:`.kinds`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from dtsa_agent.core.compiled import COMPILED
from dtsa_agent.core.frame import decode_frame
from dtsa_agent.core.registry import ESTIMATORS, POLICIES, REASONS, Registry
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.flight_models import AVOIDERS
from dtsa_agent.core.settings.scenario import Scenario
from dtsa_agent.core.swarms.abstract_swarm import AbstractSwarm, Bytes, SwarmWrapper
from dtsa_agent.core.swarms.outcome import SlotOutcome
from dtsa_agent.core.swarms.swarm import Swarm

from .guard import Guarded
from .table import Table

_PLUGIN_REASON = REASONS.index("plugin")


_REGISTRIES: tuple[Registry[Any], ...] = (POLICIES, ESTIMATORS, AVOIDERS)


def uses_plugins(config: SwarmConfig) -> bool:
    """Whether a configuration names anything that is not built in."""
    return bool(plug_ins_named(config))


def plug_ins_named(config: SwarmConfig) -> list[tuple[str, str]]:
    """Kind and name of each part that a configuration names and that is not built in."""
    named = ((registry, str(getattr(config, registry.kind))) for registry in _REGISTRIES)
    return [(registry.kind, name) for registry, name in named if name not in registry.rows]


def shareable(config: SwarmConfig) -> bool:
    """Whether agents of such a swarm may share one table for as long as all hear the same.

    :param config: the swarm's settings.
    """
    return config.policy_row.may_share and not uses_plugins(config)


def make_swarm(
    config: SwarmConfig,
    scenario: Scenario | None = None,
    local: Sequence[int] | None = None,
    shared_table: bool = False,
    observers: Sequence[int] | None = None,
    core: str = COMPILED,
) -> AbstractSwarm:
    """A :class:`Swarm`, in a :class:`PluginSwarm` if the configuration names plug-ins.

    Parameters are those of ``Swarm``; with plug-ins every agent has a table of its own.

    :raises ConfigError: for ids and plug-ins that do not exist.
    """
    if not uses_plugins(config):
        return Swarm(config, scenario, local, shared_table, observers, core=core)
    return PluginSwarm(Swarm(config, scenario, local, False, observers, core=core))


class PluginSwarm(SwarmWrapper):
    """A swarm some of whose parts are Python objects from other packages. Every observer has its own instances.

    :param inner: the swarm; its kernel leaves to this class what is not built in.
    """

    def __init__(self, inner: AbstractSwarm) -> None:
        super().__init__(inner)
        self._ids = [int(index) + 1 for index in self.observer]
        self._tables = [Table(self, row) for row in range(len(self._ids))]
        self._outcome = np.zeros(len(self._ids), dtype=np.uint8)  # SlotOutcome of the present slot, collisions apart
        self._said: dict[int, bytes] = {}  # in this slot, by position in ids
        self._own_bytes = self.config.own_bytes
        self._make_parts()

    def _make_parts(self) -> None:
        everybody = self.config.policy_row.needs_everybody and bool(self.ids)
        self._genie = self._guarded(POLICIES, 0) if everybody else None
        self._policies, self._estimators, self._avoiders = (self._instances(r, self._ids) for r in _REGISTRIES)
        self._list_speakers()

    def _instances(self, registry: Registry[Any], ids: list[int]) -> list[Guarded]:
        name = getattr(self.config, registry.kind)
        if name in registry.rows or getattr(registry.row(name), "needs_everybody", False):
            return []
        return [self._guarded(registry, agent) for agent in ids]

    def _guarded(self, registry: Registry[Any], agent: int) -> Guarded:
        name = getattr(self.config, registry.kind)
        return Guarded(registry.kind, name, registry.factory(name), self.config, agent)

    def _list_speakers(self) -> None:
        """Notes the parts of each observer that may say something, with the size of it, in the frame's order."""
        policy, estimator = self.config.policy_row, self.config.estimator_row
        parts = ((self._policies, policy.own_bytes), (self._estimators, estimator.own_bytes))
        self._speakers = [[(made[row], size) for made, size in parts if made] for row in range(len(self._ids))]
        self._listen_to_outcome = any(hasattr(part, "slot_over") for row in self._speakers for part, _ in row)

    @property
    def policies(self) -> list[Guarded]:
        """The policy of each observer; empty if it is built in, or one looks into all agents."""
        return self._policies

    @property
    def tables(self) -> list[Table]:
        """What each observer knows."""
        return self._tables

    def decide(self, slot: int) -> None:
        if self._genie is not None:
            self._ask_genie(self._genie, slot)
            return
        if not self._policies:
            self.inner.decide(slot)
            return
        self.estimate(slot)  # the control instants and the metrics leave others, which depend on what flies it
        for index, agent in enumerate(self.ids):
            policy = self._policies[index]
            chosen = policy.chosen(policy.choose(self._tables[index], slot), slot, self.config.agents)
            self.chosen[index] = chosen
            self.sends[index] = chosen == agent and self.present[index]
        self._note_decision()

    def _ask_genie(self, genie: Guarded, slot: int) -> None:
        senders = genie.sending(genie.senders(self, slot), slot, self.config.agents)
        self.chosen[:] = senders[0] if senders else 0
        self.sends[:] = 0
        for agent in senders:
            self.sends[agent - 1] = self.present[agent - 1] > 0
        self._note_decision()

    def _note_decision(self) -> None:
        self.reason[:] = _PLUGIN_REASON
        self.score[:] = 0.0
        self.digest[:] = self.table_hash[: len(self.ids)]

    def begin(self, slot: int) -> tuple[int, ...]:
        self.decide(slot)
        return self.emit(slot)

    def emit(self, slot: int) -> tuple[int, ...]:
        senders = self.inner.emit(slot)
        if self._own_bytes:
            self._said = {index: b"".join(self._say(index, slot)) for index in senders}
        return senders

    def _say(self, index: int, slot: int) -> Iterator[bytes]:
        for part, size in self._speakers[index]:
            if size:
                yield part.bytes_said(part.say(self._tables[index], slot), size)

    def frame(self, local_index: int) -> bytes:
        data = self.inner.frame(local_index)
        return data + self._said[local_index] if data and self._own_bytes else data

    def hear(self, slot: int, data: bytes, mask: Bytes | None = None) -> bool:
        end = max(0, len(data) - self._own_bytes)
        if not self.inner.hear(slot, data[:end], mask):
            return False
        if not (self._own_bytes or self._listen_to_outcome):
            return True
        sender = decode_frame(data[:end]).sender
        for row, agent in enumerate(self._ids):
            if agent == sender or (mask is not None and not mask[row]):
                continue
            self._outcome[row] = SlotOutcome.FRAME
            at = end
            for part, size in self._speakers[row]:
                if size:
                    part.heard(self._tables[row], slot, sender, data[at : at + size])
                at += size
        return True

    def estimate(self, slot: int, step: int = 0) -> None:
        if not self._estimators:
            self.inner.estimate(slot, step)
            return
        for index, table in enumerate(self._tables):
            position, velocity = self.estimate_position[index], self.estimate_velocity[index]
            self._estimators[index].estimate(table, slot, step, position, velocity)
            self._estimators[index].estimated(position, velocity, slot=slot)

    def end(self, slot: int, collided: Bytes | None = None) -> None:
        self.inner.end(slot, collided)
        if self._listen_to_outcome:
            self._tell_outcome(slot, collided)
        if self._estimators:
            self.estimate(slot + 1)  # what the metrics compare with the truth

    def _tell_outcome(self, slot: int, collided: Bytes | None) -> None:
        for index in np.flatnonzero(self.sends):
            if self.inner.frame(int(index)):
                self._outcome[index] = SlotOutcome.FRAME
        for row, table in enumerate(self._tables):
            outcome = SlotOutcome(int(self._outcome[row]))
            if collided is not None and collided[row] and outcome == SlotOutcome.SILENCE:
                outcome = SlotOutcome.COLLISION
            for part, _ in self._speakers[row]:
                if hasattr(part, "slot_over"):
                    part.slot_over(table, slot, outcome)
        self._outcome[:] = SlotOutcome.SILENCE

    def reset(self) -> None:
        self.inner.reset()
        self._outcome[:] = SlotOutcome.SILENCE
        self._make_parts()

    def restart(self, local_index: int) -> None:
        self.inner.restart(local_index)
        for registry, parts in zip(_REGISTRIES, (self._policies, self._estimators, self._avoiders), strict=True):
            parts[local_index : local_index + 1] = self._instances(registry, [self.ids[local_index]])
        self._list_speakers()

    def steer(self, slot: int, step: int, estimate: bool = True) -> None:
        if estimate and self._estimators:
            self.estimate(slot, step)
        self.inner.steer(slot, step, estimate and not self._estimators)
        for index, avoider in enumerate(self._avoiders):
            if index < len(self.ids) and self.active[index] and self.present[index]:
                self.command[:, index] = avoider.commanded(avoider.command(self._tables[index], slot, step), slot)

    def fly(self, slot: int) -> None:
        if not (self._estimators or self._avoiders):
            self.inner.fly(slot)
            return
        for step in range(self.config.steps):
            self.steer(slot, step)
            self.inner.move(step)


def plug_ins_of(swarm: AbstractSwarm) -> PluginSwarm | None:
    """The part of a swarm that calls plug-ins; None: all of it is built in.

    :param swarm: the swarm, however often wrapped.
    """
    while isinstance(swarm, SwarmWrapper) and not isinstance(swarm, PluginSwarm):
        swarm = swarm.inner
    return swarm if isinstance(swarm, PluginSwarm) else None
