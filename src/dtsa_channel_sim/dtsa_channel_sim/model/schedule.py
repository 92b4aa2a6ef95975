"""Changes of the channel's settings, by the schedule or while it runs, and which settings hold in which slot."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Setting, settings_of

from .topology import parse_links, parse_partition

_SLOT = Setting("slot", "int", None, "a slot", minimum=0, maximum=2**53)
_SECONDS = Setting("at_s", "float", None, "seconds after the start of slot 0", unit="s", minimum=0, maximum=1e9)
_TIMES = ("slot", "at_s", "until", "until_s")

Config: TypeAlias = Any  # a :class:`.config.ChannelConfig`, which a schedule may change


@dataclass(frozen=True, slots=True)
class Change:
    """Settings that change at a slot: an entry of the schedule, or a change made while the channel ran."""

    slot: int  # first slot with the new values
    values: tuple[tuple[str, Any], ...]  # pairs of the setting's name and its new value
    until: int | None = None  # first slot without them again; None: they stay

    def __post_init__(self) -> None:
        # In one order, so that equal changes are equal objects.
        object.__setattr__(self, "values", tuple(sorted(self.values, key=lambda pair: pair[0])))

    @classmethod
    def from_dict(cls, entry: object, config: Config, name: str) -> Change:
        """Return an entry ``{slot | at_s: ..., until | until_s: ..., loss: ..., jam: ...}`` of this name, validated.

        Seconds count from the start of slot 0; the change comes with the first slot that starts then or later.

        :raises ConfigError: naming the part that is wrong.
        """
        if isinstance(entry, Change):
            entry = entry.to_dict()
        if not isinstance(entry, Mapping):
            raise ConfigError(name, entry, "{slot: or at_s:, until:, and what changes: " + _changeable(config) + "}")
        slot = _read_slot(entry, "slot", "at_s", config.slot_ns, name)
        until = _read_slot(entry, "until", "until_s", config.slot_ns, name)
        if slot is None:
            raise ConfigError(f"{name}.slot", None, "a slot (slot: 100) or seconds (at_s: 1.0)")
        if until is not None and until <= slot:
            raise ConfigError(f"{name}.until", until, f"a slot after the entry's start, {slot}")
        values = {key: value for key, value in entry.items() if key not in _TIMES}
        if not values:
            raise ConfigError(name, dict(entry), "at least one of " + _changeable(config))
        return cls(slot, tuple(_normal(config, key, value, name) for key, value in values.items()), until)

    def to_dict(self) -> dict[str, Any]:
        """Return the entry as :meth:`from_dict` reads it."""
        until = {} if self.until is None else {"until": self.until}
        return {"slot": self.slot, **until, **{name: _plain(value) for name, value in self.values}}


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value.to_dict() if hasattr(value, "to_dict") else value


def _normal(config: Config, name: str, value: object, entry: str) -> tuple[str, Any]:
    """Return one changed setting as the configuration stores it; the combination is checked later."""
    spec = next((spec for spec in settings_of(type(config)) if spec.name == name and spec.changeable), None)
    if spec is None:
        raise ConfigError(f"{entry}.{name}", value, "a setting that may change: " + _changeable(config))
    if name == "partition":
        return name, parse_partition(value, config.agents, f"{entry}.{name}") or ""
    if name == "link_loss":
        return name, parse_links(value, config.agents, f"{entry}.{name}")
    return name, spec.check(value, f"{entry}.{name}")


def _read_slot(entry: Mapping[str, Any], slot_key: str, time_key: str, slot_ns: int, name: str) -> int | None:
    if slot_key in entry and time_key in entry:
        raise ConfigError(f"{name}.{time_key}", entry[time_key], f"either {slot_key} or {time_key}, not both")
    if entry.get(slot_key) is not None:
        return int(_SLOT.check(entry[slot_key], f"{name}.{slot_key}"))
    if entry.get(time_key) is not None:
        seconds: float = _SECONDS.check(entry[time_key], f"{name}.{time_key}")
        return -(-round(seconds * 1e9) // slot_ns)
    return None


def _changeable(config: Config) -> str:
    return ", ".join(spec.name for spec in settings_of(type(config)) if spec.changeable)


@dataclass(frozen=True, slots=True)
class Epoch:
    """Slots with the same settings: from ``first`` up to, not including, ``end``; None: it lasts."""

    first: int
    end: int | None
    config: Config


class Timeline:
    """Settings by slot, a pure function of the configuration and of the changes.

    Entries of the schedule may overlap: the one that began last counts (of two that begin together, the later
    in the list), and when it ends, what would have held without it. A change in flight holds from its slot
    until the next change of the same setting, scheduled or not.

    :param config: the settings with their schedule.
    :raises ConfigError: when some slot would have settings that do not go together.
    """

    __slots__ = ("_base", "_changes", "_configs", "_slots")

    def __init__(self, config: Config) -> None:
        self._base = config.changed({})
        self._changes: list[Change] = []  # by slot, ascending
        self._slots: list[int] = [0]  # slots at which settings change, ascending
        self._configs: list[Config] = [self._base]
        for change in scheduled_changes(config):
            self.add(change)

    def add(self, change: Change) -> None:
        """Add a change; one in the same slot as others comes last.

        :raises ConfigError: when it, or a later change on top of it, leads to settings that do not go
            together. Nothing is changed then.
        """
        at = bisect_right(self._changes, change.slot, key=lambda other: other.slot)
        changes = [*self._changes[:at], change, *self._changes[at:]]
        keep = next((i for i, slot in enumerate(self._slots) if slot >= change.slot), len(self._slots))
        slots, configs = self._slots[:keep] or [0], self._configs[:keep] or [self._base]
        for item in changes:
            if item.slot < change.slot:
                continue
            config = configs[-1].changed(dict(item.values))
            if item.slot == slots[-1]:
                configs[-1] = config
            else:
                slots.append(item.slot)
                configs.append(config)
        self._changes, self._slots, self._configs = changes, slots, configs

    def at(self, slot: int) -> Epoch:
        """Return the slots with the same settings to which a slot belongs."""
        i = bisect_right(self._slots, slot) - 1
        end = self._slots[i + 1] if i + 1 < len(self._slots) else None
        return Epoch(self._slots[i], end, self._configs[i])


def scheduled_changes(config: Config) -> Iterable[Change]:
    """Turn entries of the schedule, which may end, into changes that stay, at most one per slot."""
    names = {name for entry in config.schedule for name, _ in entry.values}
    edges = sorted({e.slot for e in config.schedule} | {e.until for e in config.schedule if e.until is not None})
    before = {name: getattr(config, name) for name in names}
    for edge in edges:
        now = {name: getattr(config, name) for name in names}
        begun = dict.fromkeys(names, -1)
        for entry in config.schedule:
            if entry.slot <= edge and (entry.until is None or edge < entry.until):
                for name, value in entry.values:
                    if entry.slot >= begun[name]:
                        now[name], begun[name] = value, entry.slot
        values = tuple((name, now[name]) for name in sorted(names) if now[name] != before[name])
        before = now
        if values:
            yield Change(edge, values)
