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

from dtsa_agent.core.frame import decode_frame
from dtsa_agent.core.registry import ESTIMATORS, POLICIES, REASONS, Registry
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.flight_models import AVOIDERS
from dtsa_agent.core.settings.scenario import Scenario
from dtsa_agent.core.swarm import Bytes, SlotOutcome, Swarm

from .guard import Guarded
from .kinds import Table

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
    """Whether agents of such a swarm may share one table for as long as all hear the same."""
    return config.policy_row.may_share and not uses_plugins(config)


def make_swarm(
    config: SwarmConfig,
    scenario: Scenario | None = None,
    local: Sequence[int] | None = None,
    shared_table: bool = False,
    observers: Sequence[int] | None = None,
) -> Swarm:
    """A :class:`Swarm`, a :class:`PluginSwarm` if the configuration names plug-ins; parameters are those of ``Swarm``.

    With plug-ins every agent has a table of its own.

    :raises ConfigError: for ids and plug-ins that do not exist.
    """
    if not uses_plugins(config):
        return Swarm(config, scenario, local, shared_table, observers)
    return PluginSwarm(config, scenario, local, False, observers)


class PluginSwarm(Swarm):
    """A swarm some of whose parts are Python objects from other packages. Every observer has its own instances.

    Its kernel leaves to this class what is not built in; parameters are those of :class:`Swarm`.
    """

    all_in_c = False

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self._ids = [int(index) + 1 for index in self.observer]
        self.tables = [Table(self, row) for row in range(len(self._ids))]  # what each observer knows
        self._outcome = np.zeros(len(self._ids), dtype=np.uint8)  # SlotOutcome of the present slot, collisions apart
        self._appended: dict[int, bytes] = {}  # in this slot, by position in ids
        self._own_bytes = self.config.own_bytes
        self._make_parts()

    def _make_parts(self) -> None:
        everybody = self.config.policy_row.needs_everybody and bool(self.ids)
        self._genie = self._guarded(POLICIES, 0) if everybody else None
        #: The parts of each observer; empty if they are built in, or one policy looks into all agents.
        self.policies, self.estimators, self.avoiders = (self._instances(r, self._ids) for r in _REGISTRIES)
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
        """Note the parts of each observer that may say something, with the size of it, in the frame's order."""
        policy, estimator = self.config.policy_row, self.config.estimator_row
        parts = ((self.policies, policy.own_bytes), (self.estimators, estimator.own_bytes))
        self._speakers = [
            [(instances[row], size) for instances, size in parts if instances] for row in range(len(self._ids))
        ]
        self._listen_to_outcome = any(hasattr(part, "slot_over") for row in self._speakers for part, _ in row)

    def decide(self, slot: int) -> None:
        if self._genie is not None:
            senders = self._genie.sending(self._genie.senders(self, slot), slot, self.config.agents)
            self.chosen[:], self.sends[:] = senders[0] if senders else 0, 0
            for agent in senders:
                self.sends[agent - 1] = self.present[agent - 1] > 0
        elif self.policies:
            self.estimate(slot)  # the control instants and the metrics leave others, which depend on what flies it
            for index, agent in enumerate(self.ids):
                policy = self.policies[index]
                chosen = policy.chosen(policy.choose(self.tables[index], slot), slot, self.config.agents)
                self.chosen[index], self.sends[index] = chosen, chosen == agent and self.present[index]
        else:
            super().decide(slot)
            return
        self.reason[:], self.score[:] = _PLUGIN_REASON, 0.0
        self.digest[:] = self.table_hash[: len(self.ids)]

    def begin(self, slot: int) -> tuple[int, ...]:
        self.decide(slot)
        return self.emit(slot)

    def emit(self, slot: int) -> tuple[int, ...]:
        senders = super().emit(slot)
        if self._own_bytes:
            self._appended = {index: b"".join(self._own_data(index, slot)) for index in senders}
        return senders

    def _own_data(self, index: int, slot: int) -> Iterator[bytes]:
        for part, size in self._speakers[index]:
            if size:
                yield part.checked_bytes(part.say(self.tables[index], slot), size)

    def frame(self, local_index: int) -> bytes:
        data = self._encoded(local_index)
        return self._sealed(data + self._appended[local_index] if data and self._own_bytes else data)

    def _receive(self, slot: int, frame: bytes, mask: Bytes | None) -> bool:
        end = max(0, len(frame) - self._own_bytes)
        if not super()._receive(slot, frame[:end], mask):
            return False
        if not (self._own_bytes or self._listen_to_outcome):
            return True
        sender = decode_frame(frame[:end]).sender
        for row, agent in enumerate(self._ids):
            if agent == sender or (mask is not None and not mask[row]):
                continue
            self._outcome[row] = SlotOutcome.FRAME
            at = end
            for part, size in self._speakers[row]:
                if size:
                    part.heard(self.tables[row], slot, sender, frame[at : at + size])
                at += size
        return True

    def estimate(self, slot: int, step: int = 0) -> None:
        if not self.estimators:
            super().estimate(slot, step)
            return
        for estimator, table, position, velocity in zip(
            self.estimators, self.tables, self.estimate_position, self.estimate_velocity, strict=True
        ):
            estimator.estimate(table, slot, step, position, velocity)
            estimator.estimated(position, velocity, slot=slot)

    def end(self, slot: int, collided: Bytes | None = None) -> None:
        super().end(slot, collided)
        if self._listen_to_outcome:
            self._report_outcome(slot, collided)
        if self.estimators:
            self.estimate(slot + 1)  # what the metrics compare with the truth

    def _report_outcome(self, slot: int, collided: Bytes | None) -> None:
        self._outcome[np.flatnonzero(self.sends & (self.frame_length > 0))] = SlotOutcome.FRAME
        for row, table in enumerate(self.tables):
            outcome = SlotOutcome(int(self._outcome[row]))
            if collided is not None and collided[row] and outcome == SlotOutcome.SILENCE:
                outcome = SlotOutcome.COLLISION
            for part, _ in self._speakers[row]:
                if hasattr(part, "slot_over"):
                    part.slot_over(table, slot, outcome)
        self._outcome[:] = SlotOutcome.SILENCE

    def reset(self) -> None:
        super().reset()
        self._outcome[:] = SlotOutcome.SILENCE
        self._make_parts()

    def restart(self, local_index: int) -> None:
        super().restart(local_index)
        for registry, parts in zip(_REGISTRIES, (self.policies, self.estimators, self.avoiders), strict=True):
            parts[local_index : local_index + 1] = self._instances(registry, [self.ids[local_index]])
        self._list_speakers()

    def steer(self, slot: int, step: int, estimate: bool = True) -> None:
        if estimate and self.estimators:
            self.estimate(slot, step)
        super().steer(slot, step, estimate and not self.estimators)
        for index, avoider in enumerate(self.avoiders[: len(self.ids)]):
            if self.active[index] and self.present[index]:
                self.command[:, index] = avoider.commanded(avoider.command(self.tables[index], slot, step), slot)

    def fly(self, slot: int) -> None:
        if not (self.estimators or self.avoiders):
            super().fly(slot)
            return
        for step in range(self.config.steps):
            self.steer(slot, step)
            self.move(step)

    def with_own_tables(self, slot: int) -> Swarm:
        """Not for these.

        :raises ValueError: always: agents have tables of their own already.
        """
        raise ValueError("with_own_tables: agents with plug-ins have tables of their own already")
