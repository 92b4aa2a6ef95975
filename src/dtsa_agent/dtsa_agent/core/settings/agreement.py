"""The settings that all agents of a flight must share."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from .config import SwarmConfig


def agreed_settings(config: SwarmConfig, mode: str) -> dict[str, Any]:
    """The settings that all processes of a flight must share, as plain values.

    :param config: the swarm's settings.
    :param mode: lockstep, realtime, or udp: over a network.
    """
    values = {**config.to_dict(), "steps": config.steps, "mode": mode}
    return dict(json.loads(json.dumps(values, sort_keys=True, default=str)))


def settings_hash(settings: Mapping[str, Any]) -> int:
    """A number of 64 bits that two sets of settings share only if they are equal.

    :param settings: plain values.
    """
    import hashlib  # brings OpenSSL along: 0.6 MB that an agent in flight does without

    text = json.dumps(settings, sort_keys=True, separators=(",", ":"))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little")
