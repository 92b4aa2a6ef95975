"""Options of plug-ins: names with a dot, ``event-tdma.error_m``, which their owners declare."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import ESTIMATORS, POLICIES, Registry

from .flight_models import AVOIDERS

_REGISTRIES: tuple[Registry[Any], ...] = (POLICIES, ESTIMATORS, AVOIDERS)
_ACCEPTED: set[str] = set()  # of plug-ins that did not fly: to look for those takes milliseconds


def check_plug_in_options(options: Mapping[str, float], parts: Mapping[str, str]) -> None:
    """Whether there are such options. Those of plug-ins that do not fly are checked, too.

    :param options: all options; those without a dot are not looked at.
    :param parts: name of the policy, the estimator and the avoider, by kind.
    :raises ConfigError: for an option that no plug-in declares.
    """
    for key in options:
        owner = key.rpartition(".")[0]
        flying = [one for one in _REGISTRIES if parts[one.kind] == owner and owner not in one.rows]
        if not owner or (not flying and key in _ACCEPTED):
            continue
        owners = flying or [one for one in _REGISTRIES if owner in one.plug_in_names()]
        if not owners:
            names = ", ".join(sorted({name for one in _REGISTRIES for name in one.plug_in_names()}))
            raise ConfigError("options", key, f"the name of a plug-in before the dot; {names}")
        declared = {f"{owner}.{option}" for one in owners for option in _declared(owner, one.factory(owner))}
        if key not in declared:
            nothing = f"none: {owner} declares no options (class attribute options)"
            raise ConfigError("options", key, ", ".join(sorted(declared)) or nothing)
        if not flying:
            _ACCEPTED.add(key)


def _declared(name: str, factory: Any) -> Iterable[str]:
    options: Any = getattr(factory, "options", ())
    if not isinstance(options, (tuple, list, set, frozenset)) or not all(isinstance(word, str) for word in options):
        raise ConfigError(f"{name}.options", options, 'a tuple of names, as ("error_m", "rounds")')
    return options
