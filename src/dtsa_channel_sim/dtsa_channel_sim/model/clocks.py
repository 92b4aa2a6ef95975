"""Clocks of the agents: an offset, a constant drift, jitter of single events; in integer nanoseconds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Settings, setting

from .draws import CLOCK, generator

_PPB = 1_000_000_000
_BLOCK = 1024


@dataclass(frozen=True, slots=True, repr=False)
class ClockConfig(Settings):
    """How far the agents' clocks are from the channel's.

    :raises ConfigError: when a setting is not usable.
    """

    offset_ns: int = setting(0, "largest offset of a clock at the start", unit="ns", minimum=0, maximum=10**15)
    drift_ppm: float = setting(0.0, "largest drift of a clock, either way", unit="ppm", minimum=0.0, maximum=1000.0)
    jitter_ns: float = setting(0.0, "standard deviation of an event's time", unit="ns", minimum=0.0, maximum=1e9)
    seed: int = setting(0, "seed of all clocks", minimum=0, maximum=2**63 - 1)


@dataclass(frozen=True, slots=True)
class AgentClock:
    """One agent's clock: local = channel + offset + channel * drift.

    :param offset_ns: ns, what the clock shows at the channel's time 0.
    :param drift_ppb: ppb (parts per billion) by which it runs fast.
    :param jitter_ns: ns, standard deviation of the time of a single event.
    :param seed: seed of the jitter.
    :param agent: id of the agent.
    """

    offset_ns: int = 0
    drift_ppb: int = 0
    jitter_ns: float = 0.0
    seed: int = 0
    agent: int = 1

    def __post_init__(self) -> None:
        if not -_PPB < self.drift_ppb < _PPB:
            raise ConfigError("drift_ppb", self.drift_ppb, "a whole number between -1e9 and 1e9")

    def to_local(self, channel_ns: int) -> int:
        """Return what the clock shows at a time of the channel's clock, both in ns.

        :param channel_ns: ns.
        """
        return channel_ns + self.offset_ns + channel_ns * self.drift_ppb // _PPB

    def to_channel(self, local_ns: int) -> int:
        """Return the first ns of the channel's time at which the clock shows a local time, or has passed it.

        The exact inverse as far as there is one: a fast clock skips some readings, a slow one shows some
        twice.

        :param local_ns: ns.
        """
        # to_local(c) >= l  <=>  c (1e9 + drift) >= (l - offset) 1e9, because floor(x) >= n <=> x >= n.
        return -(-(local_ns - self.offset_ns) * _PPB // (_PPB + self.drift_ppb))

    def jitter(self, event: int) -> int:
        """Return the deviation of one event's time, ns: normal, cut off at four standard deviations.

        :param event: number of the event (a slot, a turn), 0 or more; the same event has the same jitter,
            always.
        """
        if not self.jitter_ns:
            return 0
        block = _normal_block(self.seed, self.agent, event // _BLOCK)
        return round(self.jitter_ns * block[event % _BLOCK])


def make_clocks(config: ClockConfig, agents: int) -> tuple[AgentClock, ...]:
    """Return the clocks of the agents 1 to N: offset and drift uniform within limits, by seed and agent.

    :param config: the limits.
    :param agents: number of agents N.
    """
    clocks = []
    for agent in range(1, agents + 1):
        offset, drift = generator(config.seed, CLOCK, agent).uniform(-1.0, 1.0, size=2)
        clocks.append(
            AgentClock(
                offset_ns=round(offset * config.offset_ns),
                drift_ppb=round(drift * config.drift_ppm * 1000.0),
                jitter_ns=config.jitter_ns,
                seed=config.seed,
                agent=agent,
            )
        )
    return tuple(clocks)


@lru_cache(maxsize=1024)
def _normal_block(seed: int, agent: int, block: int) -> tuple[float, ...]:
    """Return standard normal numbers of the events of one block, cut off at 4."""
    numbers = generator(seed, CLOCK, agent, block + 1).standard_normal(_BLOCK)
    return tuple(np.clip(numbers, -4.0, 4.0).tolist())
