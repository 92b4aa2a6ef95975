"""Clocks of the agents: an offset and a constant drift; in integer nanoseconds."""

from __future__ import annotations

from dataclasses import dataclass

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Settings, setting

from .draws import CLOCK, generator

_PPB = 1_000_000_000


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
    """

    offset_ns: int = 0
    drift_ppb: int = 0

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
            )
        )
    return tuple(clocks)
