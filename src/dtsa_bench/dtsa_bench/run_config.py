"""One run: the swarm, its channel and what ends it. `simulate`, `fly`, `sweep` and `verify` all start from this."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from dtsa_agent.core.config import SwarmConfig
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings import Settings, setting
from dtsa_channel_sim import ChannelConfig, ClockConfig

SECTIONS = ("swarm", "channel", "limits", "mode", "clocks", "align")
LOCKSTEP, REALTIME = MODES = ("lockstep", "realtime")


@dataclass(frozen=True, slots=True)
class RunLimits(Settings):
    """What ends a run, and what counts as a crash."""

    timeout_s: float = setting(
        60.0,
        "a run that is not complete by then ends and is counted apart",
        unit="s",
        minimum=0.01,
        maximum=86400,
    )
    tail_s: float = setting(1.0, "a complete run flies on for this long", unit="s", minimum=0, maximum=3600)
    collision_m: float = setting(0.2, "two agents closer than this have crashed", unit="m", minimum=0, maximum=10)
    stop_on_crash: bool = setting(True, "a crash ends the run, as in the paper")


@dataclass(frozen=True, slots=True)
class RunConfig:
    """Everything that decides what happens in a run. Equal configurations give equal flights, bit for bit."""

    swarm: SwarmConfig = field(default_factory=SwarmConfig)
    channel: ChannelConfig | None = None  # None: loss-free, made from ``swarm``
    limits: RunLimits = field(default_factory=RunLimits)
    mode: str = LOCKSTEP  # REALTIME: every agent on its own clock
    clocks: ClockConfig = field(default_factory=ClockConfig)  # real time only
    align: bool = True  # real time only: agents align their clocks by what they hear

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ConfigError("mode", self.mode, ", ".join(MODES))
        if self.channel is None:
            channel = ChannelConfig(agents=self.swarm.agents, slot_ns=self.swarm.slot_ns, seed=self.swarm.seed)
            object.__setattr__(self, "channel", channel)
        channel = self.air
        for name, there, here in (
            ("agents", channel.agents, self.swarm.agents),
            ("slot_ns", channel.slot_ns, self.swarm.slot_ns),
        ):
            if there != here:
                raise ConfigError(f"channel.{name}", there, f"{here}, as in the swarm")

    @property
    def air(self) -> ChannelConfig:
        """The channel's settings."""
        assert self.channel is not None
        return self.channel

    def to_dict(self) -> dict[str, Any]:
        """Plain values, in sections; :meth:`from_dict` reads them back."""
        limits = {spec.name: getattr(self.limits, spec.name) for spec in dataclasses.fields(self.limits)}
        result = {"swarm": self.swarm.to_dict(), "channel": self.air.to_dict(), "limits": limits}
        if self.mode != LOCKSTEP:
            result.update(mode=self.mode, clocks=self.clocks.to_dict(), align=self.align)
        return result

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> RunConfig:
        """Builds a run from plain values in sections.

        :raises ConfigError: naming what is not allowed.
        """
        for name in values:
            if name not in SECTIONS:
                raise ConfigError(name, values[name], f"one of the sections {', '.join(SECTIONS)}")
        channel = values.get("channel")
        return cls(
            SwarmConfig.from_dict(values.get("swarm", {})),
            None if channel is None else ChannelConfig.from_dict(channel),
            RunLimits(**values.get("limits", {})),
        )
