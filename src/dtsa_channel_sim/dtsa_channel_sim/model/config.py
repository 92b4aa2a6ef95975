"""Settings of the channel and of the agents' clocks: described, validated once, read from YAML."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import REQUIRED, Setting, Settings, check, setting, settings_of

from .airtime import RADIOS, Airtime, airtime_of
from .draws import CLOCK, generator
from .gilbert import GilbertElliott
from .measured import MeasuredLosses, losses_of
from .schedule import Change, Timeline
from .topology import Groups, LinkLoss, Matrix, listed, parse_links, parse_matrix, parse_partition

Config = TypeVar("Config", bound="ChannelConfig")
_SLOT_MS = Setting("slot_ms", "float", None, "length of a slot", unit="ms", minimum=1e-6, maximum=1e6)


@dataclass(frozen=True, slots=True)
class AnswerLimits(Settings):
    """Wall time that agents have to answer."""

    startup_s: float = setting(
        60.0, "wall time that all agents have to answer slot 0", unit="s", minimum=0.1, maximum=86400
    )
    answer_s: float = setting(
        10.0, "wall time that all agents have to answer any later slot", unit="s", minimum=0.1, maximum=86400
    )


@dataclass(frozen=True, slots=True, repr=False)
class ChannelConfig(Settings):
    """Everything that the channel's behaviour depends on. Models and formulas: docs/reference/channel.md."""

    agents: int = setting(REQUIRED, "number of agents; their ids are 1 to this number", minimum=1, maximum=65535)
    slot_ns: int = setting(10_000_000, "length of a slot", unit="ns", minimum=1, maximum=10**12)
    seed: int = setting(0, "seed of all losses", minimum=0, maximum=2**63 - 1)
    loss: float = setting(
        0.0, "mean share of frames that a receiver loses, each receiver for itself", minimum=0.0, maximum=1.0,
        changeable=True,
    )  # fmt: skip
    burst_length: float = setting(
        0.0, "mean length of a bad phase (Gilbert-Elliott); 0: every loss is independent", unit="slots", minimum=0.0,
        maximum=1e9, changeable=True,
    )  # fmt: skip
    burst_scope: str = setting(
        "receiver", "what has bad phases: a receiver (it loses all senders) or each directed link",
        choices=("receiver", "link"),
    )  # fmt: skip
    p_good: float = setting(0.0, "loss within a good phase", minimum=0.0, maximum=1.0, changeable=True)
    p_bad: float = setting(1.0, "loss within a bad phase", minimum=0.0, maximum=1.0, changeable=True)
    losses: MeasuredLosses | str = setting(
        "", "file of losses that were measured, on top of all others: what `losses` has written", kind="file",
        custom=True,
    )  # fmt: skip
    jam: bool = setting(False, "all frames are lost", changeable=True)
    partition: Groups | str = setting(
        "", "groups that do not hear each other: [[1, 2, 3], [4, 5]]; empty: all together", kind="text",
        changeable=True, custom=True,
    )  # fmt: skip
    range_m: float = setting(
        0.0, "distance up to which a frame is received; 0: everywhere", unit="m", minimum=0.0, maximum=1e6,
        changeable=True, group="Reach and radio",
    )  # fmt: skip
    interference_factor: float = setting(
        1.0, "a frame disturbs others up to this many times range_m", minimum=1.0, maximum=100.0
    )
    capture_db: float = setting(
        0.0, "a frame this much stronger than all that overlap it is received; 0: no capture", unit="dB",
        minimum=0.0, maximum=100.0,
    )  # fmt: skip
    path_loss_exponent: float = setting(
        2.0, "power falls with this power of the distance (capture)", minimum=1.0, maximum=6.0
    )
    radio: str = setting(
        "plain", "what carries frames: plain, or a radio whose line to the flight processor takes its time",
        choices=tuple(RADIOS),
    )  # fmt: skip
    bitrate: int = setting(2_000_000, "bits on air per second", unit="bit/s", minimum=1000, maximum=10**9)
    ramp_up_ns: int = setting(130_000, "from the order to send to the first bit", unit="ns", minimum=0, maximum=10**9)
    link_delay_ns: int = setting(
        300_000, "between radio and flight processor, each way, with radio plain (arrival times in real time)",
        unit="ns", minimum=0, maximum=10**9,
    )  # fmt: skip
    loss_matrix: Matrix = setting((), "loss of each link on top of loss: row = sender, column = receiver")
    link_loss: tuple[LinkLoss, ...] = setting((), "loss of some links, laid over loss_matrix", changeable=True)
    schedule: tuple[Change, ...] = setting((), "changes at known slots")

    def __post_init__(self) -> None:
        check(self)
        object.__setattr__(self, "partition", parse_partition(self.partition, self.agents) or "")
        object.__setattr__(self, "loss_matrix", parse_matrix(self.loss_matrix, self.agents))
        object.__setattr__(self, "link_loss", parse_links(self.link_loss, self.agents))
        object.__setattr__(self, "losses", losses_of(self.losses))
        if isinstance(self.losses, MeasuredLosses):
            self.losses.check(self.agents, self.slot_ns)
            if self.burst_length:
                raise ConfigError(
                    "burst_length", self.burst_length, "0 together with losses, which have their own bursts"
                )
        if self.burst_length:
            GilbertElliott.from_means(self.loss, self.burst_length, self.p_good, self.p_bad)
        entries = enumerate(listed(self.schedule, "schedule"))
        schedule = tuple(Change.from_dict(entry, self, f"schedule[{k}]") for k, entry in entries)
        object.__setattr__(self, "schedule", schedule)
        if self.schedule:  # entries may be fine one by one and wrong together: try every state of the channel
            try:
                Timeline(self)
            except ConfigError as error:
                raise ConfigError(f"schedule: {error.field}", error.value, error.allowed) from None

    @property
    def groups(self) -> Groups:
        """The groups of the partition; empty: all together."""
        return self.partition if isinstance(self.partition, tuple) else ()

    @property
    def needs_positions(self) -> bool:
        """Whether it matters where agents are."""
        return bool(self.range_m or self.capture_db)

    @property
    def airtime(self) -> Airtime:
        """The radio's times."""
        return airtime_of(self.radio, self.bitrate, self.ramp_up_ns, self.link_delay_ns)

    @classmethod
    def from_dict(cls: type[Config], settings: Mapping[str, Any]) -> Config:
        """Return the settings, validated.

        :param settings: values by name; ``slot_ms`` may stand for ``slot_ns``.
        :raises ConfigError: when a name is unknown or a value is not allowed.
        """
        values = dict(settings)
        if "slot_ms" in values:
            if "slot_ns" in values:
                raise ConfigError("slot_ms", values["slot_ms"], "either slot_ms or slot_ns, not both")
            values["slot_ns"] = round(_SLOT_MS.check(values.pop("slot_ms")) * 1_000_000)
        return super(ChannelConfig, cls).from_dict(values)

    @classmethod
    def from_yaml(cls, path: str | Path, **overrides: Any) -> ChannelConfig:
        """Return the settings of a YAML file: a mapping of settings, or one with such a mapping under ``channel``.

        :param overrides: settings that win over the file's; those that are None are ignored.
        :raises ConfigError: when the file cannot be read or a setting is not usable.
        """
        from dtsa_agent.yaml_file import read_mapping

        settings = read_mapping(path, "channel")
        given = {name: value for name, value in overrides.items() if value is not None}
        if "slot_ns" in given or "slot_ms" in given:
            settings.pop("slot_ns", None)
            settings.pop("slot_ms", None)
        return cls.from_dict({**settings, **given})

    def changed(self, values: Mapping[str, Any]) -> ChannelConfig:
        """Return these settings with some changeable ones changed, without the schedule.

        :param values: new values by name.
        :raises ConfigError: when a setting cannot change in flight or its value is not allowed.
        """
        if not (values or self.schedule):
            return self
        for name in values:
            if name not in CHANGEABLE:
                raise ConfigError(str(name), values[name], f"a setting that may change: {', '.join(CHANGEABLE)}")
        return dataclasses.replace(self, schedule=(), **values)


#: Settings that may change while the channel runs, by the schedule or by :meth:`Channel.set`.
CHANGEABLE: tuple[str, ...] = tuple(spec.name for spec in settings_of(ChannelConfig) if spec.changeable)


@dataclass(frozen=True, slots=True, repr=False)
class ClockConfig(Settings):
    """How far the agents' clocks are from the channel's."""

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
