"""One run: the swarm, its channel and what ends it. `simulate`, `fly`, `sweep` and `verify` all start from this."""

from __future__ import annotations

from dataclasses import dataclass

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.declaration import Settings, check, nested, setting
from dtsa_channel_sim import ChannelConfig, ClockConfig

FROM_SWARM = ("agents", "slot_ns", "seed")  # settings of the channel that follow from the swarm's
LOCKSTEP, REALTIME = MODES = ("lockstep", "realtime")


@dataclass(frozen=True, slots=True, repr=False)
class RunLimits(Settings):
    """Limits that end a run, and the distance that counts as a crash."""

    timeout_s: float = setting(
        60.0, "a run that is not complete by then ends and is counted apart", unit="s", minimum=0.01, maximum=86400
    )
    tail_s: float = setting(1.0, "a complete run flies on for this long", unit="s", minimum=0, maximum=3600)
    collision_m: float = setting(0.2, "two agents closer than this have crashed", unit="m", minimum=0, maximum=10)
    stop_on_crash: bool = setting(True, "a crash ends the run, as in the paper")


@dataclass(frozen=True, slots=True, repr=False)
class RunConfig(Settings):
    """Everything that decides what happens in a run. Equal configurations give equal flights, bit for bit."""

    swarm: SwarmConfig = nested(SwarmConfig, "the swarm")
    channel: ChannelConfig | None = setting(
        None, "the radio channel; None: loss-free, made from the swarm's settings", section=ChannelConfig
    )
    limits: RunLimits = nested(RunLimits, "the end of a run")
    mode: str = setting(
        LOCKSTEP,
        "in lockstep all wait for each other, as fast as the machine allows; in real time each has a clock of its own",
        choices=MODES,
    )
    clocks: ClockConfig = nested(ClockConfig, "real time: the agents' clocks")
    align: bool = setting(True, "real time: agents align their clocks by what they hear")

    def __post_init__(self) -> None:
        check(self)
        if self.channel is None:
            object.__setattr__(self, "channel", ChannelConfig(**from_swarm(self.swarm)))
        for name in ("agents", "slot_ns"):
            value, right = getattr(self.air, name), getattr(self.swarm, name)
            if value != right:
                raise ConfigError(f"channel.{name}", value, f"{right}, as in the swarm")
        self._check_radio()

    def _check_radio(self) -> None:
        """Whether the radio takes the frames, and slots hold what a frame costs on its line.

        Clocks and decisions are left out. A slot that is shorter cannot work with any of them.
        """
        airtime, length, row = self.air.airtime, self.swarm.frame_length, self.swarm.policy_row
        if length > airtime.longest:
            allowed = f"a radio that takes frames of {length} bytes, not {airtime.longest} at most"
            raise ConfigError("channel.radio", self.air.radio, allowed)
        if not airtime.line.serial or row.unslotted:
            return
        shortest = airtime.shortest_slot_ns(length, guard_ns=0, needs_frame=row.needs_frame)
        if self.swarm.slot_ns < shortest:
            allowed = f"at least {shortest / 1e6:g} with radio {self.air.radio}, policy {row.name} and {length} bytes"
            raise ConfigError("slot_ms", self.swarm.slot_ms, allowed)

    @property
    def air(self) -> ChannelConfig:
        """The channel's settings."""
        assert self.channel is not None
        return self.channel


def from_swarm(swarm: SwarmConfig) -> dict[str, int]:
    """Settings of the channel that follow from the swarm's."""
    return {name: getattr(swarm, name) for name in FROM_SWARM}
