"""Changes of the channel's settings: entries of the schedule, and changes made while it runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Setting, settings_of

from .topology import LinkLoss, format_partition, parse_partition

_NS_PER_S = 1_000_000_000
_SLOT = Setting("slot", "int", None, "a slot", minimum=0, maximum=2**53)
_SECONDS = Setting("at_s", "float", None, "seconds after the start of slot 0", unit="s", minimum=0, maximum=1e9)

_Config = TypeVar("_Config", bound="Changing")


class Changing(Protocol):
    """Settings of a channel, which a schedule may change: :class:`.config.ChannelConfig`."""

    @property
    def agents(self) -> int:
        """Number of agents."""

    @property
    def slot_ns(self) -> int:
        """Length of a slot, ns."""

    @property
    def schedule(self) -> tuple[Change, ...]:
        """Changes at known slots."""

    def changed(self: _Config, values: Mapping[str, Any]) -> _Config:
        """These settings with some changed, without the schedule.

        :param values: names and values of changeable settings.
        """


@dataclass(frozen=True, slots=True)
class Change:
    """Settings that change at a slot: an entry of the schedule, or a change made while the channel ran.

    :param slot: first slot with the new values.
    :param values: pairs of the setting's name and its new value.
    :param until: first slot without them again; None: they stay.
    """

    slot: int
    values: tuple[tuple[str, Any], ...]
    until: int | None = None

    def __post_init__(self) -> None:
        # In one order, so that equal changes are equal objects.
        object.__setattr__(self, "values", tuple(sorted(self.values, key=lambda pair: pair[0])))

    @classmethod
    def from_dict(cls, entry: object, config: Changing, name: str) -> Change:
        """Return an entry ``{slot | at_s: ..., until | until_s: ..., loss: ..., jam: ...}``, validated.

        Seconds count from the start of slot 0; the change comes with the first slot that starts then or
        later.

        :param config: the settings it changes.
        :param name: name of the entry, for the errors.
        :raises ConfigError: naming the part that is wrong.
        """
        if isinstance(entry, Change):
            entry = entry.to_dict()
        if not isinstance(entry, Mapping):
            raise ConfigError(name, entry, "{slot: or at_s:, until:, and what changes: " + _changeable(config) + "}")
        slot = _when(entry, "slot", "at_s", config.slot_ns, name)
        until = _when(entry, "until", "until_s", config.slot_ns, name)
        if slot is None:
            raise ConfigError(f"{name}.slot", None, "a slot (slot: 100) or seconds (at_s: 1.0)")
        if until is not None and until <= slot:
            raise ConfigError(f"{name}.until", until, f"a slot after the entry's start, {slot}")
        values = {key: value for key, value in entry.items() if key not in ("slot", "at_s", "until", "until_s")}
        if not values:
            raise ConfigError(name, dict(entry), "at least one of " + _changeable(config))
        return cls(slot, tuple(_normal(config, key, value, name) for key, value in values.items()), until)

    def to_dict(self) -> dict[str, Any]:
        """Return the entry as :meth:`from_dict` reads it."""
        result: dict[str, Any] = {"slot": self.slot}
        if self.until is not None:
            result["until"] = self.until
        for name, value in self.values:
            result[name] = [link.to_dict() for link in value] if name == "link_loss" else value
        return result


def _normal(config: Changing, name: str, value: object, entry: str) -> tuple[str, Any]:
    """Return one changed setting as the configuration stores it; the combination is checked later."""
    spec = next((spec for spec in settings_of(type(config)) if spec.name == name and spec.changeable), None)
    if spec is None:
        raise ConfigError(f"{entry}.{name}", value, "a setting that may change: " + _changeable(config))
    if spec.kind in ("int", "float", "bool"):
        return name, spec.check(value, f"{entry}.{name}")
    if name == "partition":
        return name, format_partition(parse_partition(value, config.agents, f"{entry}.partition"))
    links = listed(value, f"{entry}.{name}")
    return name, tuple(LinkLoss.from_dict(e, config.agents, f"{entry}.{name}[{i}]") for i, e in enumerate(links))


def _when(entry: Mapping[str, Any], slot_key: str, time_key: str, slot_ns: int, name: str) -> int | None:
    if slot_key in entry and time_key in entry:
        raise ConfigError(f"{name}.{time_key}", entry[time_key], f"either {slot_key} or {time_key}, not both")
    if entry.get(slot_key) is not None:
        return int(_SLOT.check(entry[slot_key], f"{name}.{slot_key}"))
    if entry.get(time_key) is not None:
        seconds: float = _SECONDS.check(entry[time_key], f"{name}.{time_key}")
        return -(-round(seconds * _NS_PER_S) // slot_ns)
    return None


def listed(value: object, name: str) -> Sequence[Any]:
    """The value, if it is a list; None: an empty one.

    :param value: what the user gave.
    :param name: name of the setting, for the error.
    :raises ConfigError: if it is none.
    """
    if value is None:
        return ()
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise ConfigError(name, value, "a list of entries")
    return value


def _changeable(config: Changing) -> str:
    return ", ".join(spec.name for spec in settings_of(type(config)) if spec.changeable)
