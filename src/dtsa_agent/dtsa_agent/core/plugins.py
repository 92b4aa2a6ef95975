"""Policies, estimators and avoiders from other packages, found by entry point. See docs/bench.md.

A package announces them in its metadata::

    [project.entry-points."dtsa.policies"]
    reverse = "my_package:Reverse"

and then ``policy="reverse"`` works everywhere: in `simulate`, `sweep` and in the nodes. What is announced is
a factory; it is called once for every observer, as ``factory(config, agent)`` (agent: its id, 0 for tables
that hear everything).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from .abstract_swarm import AbstractSwarm, Bytes, SwarmWrapper
from .config import SwarmConfig
from .errors import LocalProtocolError
from .flight_models import AVOIDERS
from .registry import ESTIMATORS, POLICIES, REASONS, Registry
from .scenario import Scenario
from .swarm import Swarm

Array = NDArray[np.float64]

_PLUGIN_REASON = REASONS.index("plugin")


class View:
    """What one observer knows; arrays are read-only windows on its table and are always up to date.

    Positions are m, velocities m/s, frame map, with shape (3, N); agent ``id`` is column ``id - 1``.
    """

    __slots__ = (
        "agent",
        "config",
        "estimate_position",
        "estimate_velocity",
        "goal",
        "in_ap",
        "last_turn",
        "own_position",
        "own_velocity",
        "scenario",
        "sent_intent",
        "sent_position",
        "sent_slot",
        "sent_velocity",
    )

    def __init__(self, swarm: AbstractSwarm, view: int) -> None:
        self.agent = int(swarm.observer[view]) + 1  # id of the observer, 0: one that hears everything
        self.config = swarm.config
        self.scenario = swarm.scenario
        self.sent_position = _window(swarm.sent_position[view])  # last heard (own: last sent) state
        self.sent_velocity = _window(swarm.sent_velocity[view])
        self.sent_intent = _window(swarm.sent_intent[view])  # commanded velocity, zero unless frames carry it
        self.sent_slot = _window(swarm.sent_slot[view])  # (N,) slot of that state, -1: never heard
        self.last_turn = _window(swarm.last_turn[view])  # (N,) slot of the last turn; h = slot - 1 - last_turn
        self.in_ap = _window(swarm.in_ap[view])  # (N,) A_p
        self.estimate_position = _window(swarm.estimate_position[view])  # as the estimator last filled them
        self.estimate_velocity = _window(swarm.estimate_velocity[view])
        here = view < len(swarm.ids)
        self.own_position = _window(swarm.position[:, view]) if here else None  # (3,) own true state
        self.own_velocity = _window(swarm.velocity[:, view]) if here else None
        self.goal = _window(swarm.goal[:, view]) if here else None


class Policy(Protocol):
    """Who sends next."""

    def choose(self, view: View, slot: int) -> int:
        """The id that this observer takes for the sender of a slot, 0: nobody. It sends if that is its own."""


class Estimator(Protocol):
    """Where the others are by now. ``needs_intent = True`` makes frames carry the commanded velocity."""

    needs_intent: ClassVar[bool] = False

    def estimate(self, view: View, slot: int, step: int, position: Array, velocity: Array) -> None:
        """Writes the estimates for control instant ``step`` of a slot into (3, N) arrays, m and m/s."""


class Avoider(Protocol):
    """Where to fly. ``model`` names the built-in flight model whose vehicle and spacing are used."""

    model: ClassVar[str] = "orca"

    def command(self, view: View, slot: int, step: int) -> Sequence[float]:
        """Commanded velocity, (3,), m/s, frame map; the estimates in ``view`` are those of this instant."""


_REGISTRIES: tuple[Registry[Any], ...] = (POLICIES, ESTIMATORS, AVOIDERS)


def uses_plugins(config: SwarmConfig) -> bool:
    """Whether a configuration names anything that is not built in."""
    return any(getattr(config, registry.kind) not in registry.rows for registry in _REGISTRIES)


def shareable(config: SwarmConfig) -> bool:
    """Whether agents of such a swarm may share one table for as long as all hear the same.

    :param config: the swarm's settings.
    """
    return config.policy_row.may_share and not uses_plugins(config)


def make_swarm(
    config: SwarmConfig,
    scenario: Scenario | None = None,
    local: Sequence[int] | None = None,
    shared_view: bool = False,
    observers: Sequence[int] | None = None,
) -> AbstractSwarm:
    """A :class:`Swarm`, in a :class:`PluginSwarm` if the configuration names plug-ins.

    Parameters are those of ``Swarm``; with plug-ins every agent has a table of its own.

    :raises ConfigError: for ids and plug-ins that do not exist.
    """
    if not uses_plugins(config):
        return Swarm(config, scenario, local, shared_view, observers)
    return PluginSwarm(Swarm(config, scenario, local, False, observers))


class PluginSwarm(SwarmWrapper):
    """A swarm some of whose parts are Python objects from other packages. Every observer has its own instances.

    :param inner: the swarm; its kernel leaves to this class what is not built in.
    """

    def __init__(self, inner: AbstractSwarm) -> None:
        super().__init__(inner)
        ids = [int(index) + 1 for index in self.observer]
        self._views = [View(self, view) for view in range(len(ids))]
        self._policies, self._estimators, self._avoiders = (self._instances(r, ids) for r in _REGISTRIES)

    def _instances(self, registry: Registry[Any], ids: list[int]) -> list[Any]:
        name = getattr(self.config, registry.kind)
        if name in registry.rows:
            return []
        factory = registry.factory(name)
        return [factory(self.config, agent) for agent in ids]

    def decide(self, slot: int) -> None:
        if not self._policies:
            self.inner.decide(slot)
            return
        for index, agent in enumerate(self.ids):
            chosen = self._policies[index].choose(self._views[index], slot)
            if not 0 <= chosen <= self.config.agents:
                raise LocalProtocolError(
                    f"policy {self.config.policy}: chose agent {chosen} in slot {slot}; "
                    f"allowed: 0 (nobody) to {self.config.agents}"
                )
            self.chosen[index] = chosen
            self.sends[index] = chosen == agent and self.present[index]
        self.reason[:] = _PLUGIN_REASON
        self.score[:] = 0.0
        self.digest[:] = self.table_hash[: len(self.ids)]

    def begin(self, slot: int) -> tuple[int, ...]:
        self.decide(slot)
        return self.inner.emit(slot)

    def estimate(self, slot: int, step: int = 0) -> None:
        if not self._estimators:
            self.inner.estimate(slot, step)
            return
        for index, view in enumerate(self._views):
            position, velocity = self.estimate_position[index], self.estimate_velocity[index]
            self._estimators[index].estimate(view, slot, step, position, velocity)

    def end(self, slot: int, collided: Bytes | None = None) -> None:
        self.inner.end(slot, collided)
        if self._estimators:
            self.estimate(slot + 1)  # what the metrics compare with the truth

    def steer(self, slot: int, step: int, estimate: bool = True) -> None:
        if estimate and self._estimators:
            self.estimate(slot, step)
        self.inner.steer(slot, step, estimate and not self._estimators)
        for index, avoider in enumerate(self._avoiders):
            if index < len(self.ids) and self.active[index] and self.present[index]:
                self.command[:, index] = avoider.command(self._views[index], slot, step)

    def fly(self, slot: int) -> None:
        if not (self._estimators or self._avoiders):
            self.inner.fly(slot)
            return
        for step in range(self.config.steps):
            self.steer(slot, step)
            self.inner.move(step)


def _window(array: NDArray[Any]) -> NDArray[Any]:
    window: NDArray[Any] = array.view()
    window.flags.writeable = False
    return window
