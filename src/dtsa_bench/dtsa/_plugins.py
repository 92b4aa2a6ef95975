"""Policies, estimators and avoiders of one's own, without a package around them."""

from __future__ import annotations

from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import ESTIMATORS, POLICIES, Registry
from dtsa_agent.core.settings.flight_models import AVOIDERS

_REGISTRIES: dict[str, Registry[Any]] = {registry.kind: registry for registry in (POLICIES, ESTIMATORS, AVOIDERS)}


def register(kind: str, name: str, factory: Any) -> None:
    """Make a policy, estimator or avoider known to this process: `simulate` and `sweep` fly it by its name.

    Worker processes and nodes do not know it: for these announce it by an entry point, see docs/reference/plug-ins.md.

    :param kind: "policy", "estimator" or "avoider".
    :param name: what the setting of that kind calls it; one that was registered before is replaced.
    :param factory: a class, or a function that makes the part of one observer: called with the configuration and the
        observer's id (0: one that hears everything). A policy has `choose(table, slot)`, which gives the id of the
        sender; an estimator `estimate(table, slot, step, position, velocity)`; an avoider `command(table, slot, step)`.

    >>> class Countdown:
    ...     def __init__(self, config, agent):
    ...         self.agents = config.agents
    ...
    ...     def choose(self, table, slot):
    ...         return self.agents - slot % self.agents
    >>> register("policy", "countdown", Countdown)

    :raises ConfigError: for a kind that does not exist, a built-in name, or a factory that cannot be called.
    """
    if kind not in _REGISTRIES:
        raise ConfigError("kind", kind, ", ".join(_REGISTRIES))
    _REGISTRIES[kind].register(name, factory)


def registered() -> dict[str, set[str]]:
    """Names that only this process knows, by kind."""
    return {kind: registry.registered for kind, registry in _REGISTRIES.items()}
