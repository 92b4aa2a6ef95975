"""Clocks of the agents: an offset and a constant drift each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from dtsa_agent.core.settings.declaration import Settings, setting

from .draws import CLOCK, generator


@dataclass(frozen=True, slots=True, repr=False)
class ClockConfig(Settings):
    """How far the agents' clocks are from the channel's.

    :raises ConfigError: when a setting is not usable.
    """

    offset_ns: int = setting(0, "largest offset of a clock at the start", unit="ns", minimum=0, maximum=10**15)
    drift_ppm: float = setting(0.0, "largest drift of a clock, either way", unit="ppm", minimum=0.0, maximum=1000.0)
    jitter_ns: float = setting(0.0, "standard deviation of an event's time", unit="ns", minimum=0.0, maximum=1e9)
    seed: int = setting(0, "seed of all clocks", minimum=0, maximum=2**63 - 1)


class AgentClock(NamedTuple):
    """One agent's clock: local = channel + offset + channel * drift."""

    offset_ns: int  # what the clock shows at the channel's time 0
    drift_ppb: int  # parts per billion by which it runs fast


def make_clocks(config: ClockConfig, agents: int) -> tuple[AgentClock, ...]:
    """Return the clocks of the agents 1 to N: offset and drift uniform within limits, by seed and agent."""
    clocks = []
    for agent in range(1, agents + 1):
        offset, drift = generator(config.seed, CLOCK, agent).uniform(-1.0, 1.0, size=2)
        clocks.append(AgentClock(round(offset * config.offset_ns), round(drift * config.drift_ppm * 1000.0)))
    return tuple(clocks)
