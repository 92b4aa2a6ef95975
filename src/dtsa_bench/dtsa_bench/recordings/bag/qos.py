"""QoS profiles in the form in which Jazzy writes them into bags."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import yaml

from dtsa_agent.core.errors import ConfigError

# The middleware's "for ever" (RMW_DURATION_INFINITE), split as rosbag2 splits it.
INFINITE = {"sec": 9223372036, "nsec": 854775807}
Profile = dict[str, Any]


def profile(reliability: str = "reliable", durability: str = "volatile", depth: int = 10) -> Profile:
    """One QoS profile with all the fields that rosbag2 stores."""
    return {
        "history": "keep_last",
        "depth": depth,
        "reliability": reliability,
        "durability": durability,
        "deadline": dict(INFINITE),
        "lifespan": dict(INFINITE),
        "liveliness": "automatic",
        "liveliness_lease_duration": dict(INFINITE),
        "avoid_ros_namespace_conventions": False,
    }


NAMED: Mapping[str, Profile] = {
    "reliable": profile(),
    "best_effort": profile("best_effort"),
    "sensor_data": profile("best_effort", depth=5),
    "latched": profile("reliable", "transient_local", 1),
}


def resolve(qos: str | Profile | Sequence[Profile]) -> list[Profile]:
    """List of profiles from a name of `NAMED`, one profile or several.

    :raises ConfigError: if the name is unknown.
    """
    if isinstance(qos, str):
        if qos not in NAMED:
            raise ConfigError("qos", qos, ", ".join(NAMED))
        return [dict(NAMED[qos])]
    if isinstance(qos, Mapping):
        return [dict(qos)]
    return [dict(entry) for entry in qos]


def dump(profiles: Sequence[Profile]) -> str:
    """The YAML sequence that a channel carries as `offered_qos_profiles`."""
    return str(yaml.safe_dump(list(profiles), sort_keys=False)).rstrip("\n") if profiles else ""


def load(text: str) -> list[Profile]:
    """Profiles from a channel's `offered_qos_profiles`; an unreadable text gives none."""
    return [dict(entry) for entry in _parse(text)]


@lru_cache(maxsize=64)  # the topics of a bag share a few texts, and YAML is slow
def _parse(text: str) -> tuple[Profile, ...]:
    try:
        loaded = yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)) if text else []
    except yaml.YAMLError:
        return ()
    return tuple(entry for entry in loaded if isinstance(entry, dict)) if isinstance(loaded, list) else ()
