"""Changes of the channel's settings, by the schedule or while it runs, and which settings hold in which slot."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, NamedTuple, TypeAlias

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Setting, plain, settings_of

from .topology import parse_links, parse_partition

_SLOT = Setting("slot", "int", None, "a slot", minimum=0, maximum=2**53)
_SECONDS = Setting("at_s", "float", None, "seconds after the start of slot 0", unit="s", minimum=0, maximum=1e9)
_FOREVER = 2**63  # slots
_TIMES = ("slot", "at_s", "until", "until_s")

Config: TypeAlias = Any  # a :class:`.config.ChannelConfig`, which a schedule may change


@dataclass(frozen=True, slots=True)
class Change:
    """Settings that change at a slot: an entry of the schedule, or a change made while the channel ran."""

    slot: int  # first slot with the new values
    values: tuple[tuple[str, Any], ...]  # pairs of the setting's name and its new value
    until: int | None = None  # first slot without them again; None: they stay

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", tuple(sorted(self.values)))  # in one order: equal changes are equal objects

    @classmethod
    def from_dict(cls, entry: object, config: Config, name: str) -> Change:
        """Return an entry ``{slot | at_s: ..., until | until_s: ..., loss: ..., jam: ...}`` of this name, validated.

        Seconds count from the start of slot 0; the change comes with the first slot that starts then or later.

        :raises ConfigError: naming the part that is wrong.
        """
        changeable = {spec.name: spec for spec in settings_of(type(config)) if spec.changeable}
        if isinstance(entry, Change):
            entry = entry.to_dict()
        if not isinstance(entry, Mapping):
            raise ConfigError(name, entry, f"{{slot: or at_s:, until:, and what changes: {', '.join(changeable)}}}")
        slot = _read_slot(entry, "slot", "at_s", config.slot_ns, name)
        until = _read_slot(entry, "until", "until_s", config.slot_ns, name)
        if slot is None:
            raise ConfigError(f"{name}.slot", None, "a slot (slot: 100) or seconds (at_s: 1.0)")
        if until is not None and until <= slot:
            raise ConfigError(f"{name}.until", until, f"a slot after the entry's start, {slot}")
        values = []
        for key, value in entry.items():
            if key == "partition":
                value = parse_partition(value, config.agents, f"{name}.{key}") or ""
            elif key == "link_loss":
                value = parse_links(value, config.agents, f"{name}.{key}")
            elif key in changeable:
                value = changeable[key].check(value, f"{name}.{key}")
            elif key not in _TIMES:
                raise ConfigError(f"{name}.{key}", value, f"a setting that may change: {', '.join(changeable)}")
            if key not in _TIMES:
                values.append((key, value))
        if not values:
            raise ConfigError(name, dict(entry), f"at least one of {', '.join(changeable)}")
        return cls(slot, tuple(values), until)

    def to_dict(self) -> dict[str, Any]:
        """Return the entry as :meth:`from_dict` reads it."""
        until = {} if self.until is None else {"until": self.until}
        return {"slot": self.slot, **until, **{name: plain(value) for name, value in self.values}}


def _read_slot(entry: Mapping[str, Any], slot_key: str, time_key: str, slot_ns: int, name: str) -> int | None:
    if slot_key in entry and time_key in entry:
        raise ConfigError(f"{name}.{time_key}", entry[time_key], f"either {slot_key} or {time_key}, not both")
    if entry.get(slot_key) is not None:
        return int(_SLOT.check(entry[slot_key], f"{name}.{slot_key}"))
    if entry.get(time_key) is not None:
        seconds: float = _SECONDS.check(entry[time_key], f"{name}.{time_key}")
        return -(-round(seconds * 1e9) // slot_ns)
    return None


class Epoch(NamedTuple):
    """Slots with the same settings: from ``first`` up to, not including, ``end``."""

    first: int
    end: int
    config: Config


class Timeline:
    """Settings by slot, a pure function of the configuration and of the changes.

    Entries of the schedule may overlap: the one that began last counts (of two that begin together, the later
    in the list), and when it ends, what would have held without it. A change in flight holds from its slot
    until the next change of the same setting, scheduled or not.

    :param config: the settings with their schedule.
    :raises ConfigError: when some slot would have settings that do not go together.
    """

    __slots__ = ("_changes", "_configs")

    def __init__(self, config: Config) -> None:
        self._changes: list[Change] = []  # by slot, ascending
        self._configs: list[Config] = [config.changed({})]  # before the first of them, and after each
        for change in scheduled_changes(config):
            self.add(change)

    def add(self, change: Change) -> None:
        """Add a change; one in the same slot as others comes last.

        :raises ConfigError: when it, or a later change on top of it, leads to settings that do not go
            together. Nothing is changed then.
        """
        at = bisect_right(self._changes, change.slot, key=_slot_of)
        changes, configs = [change, *self._changes[at:]], self._configs[: at + 1]
        for item in changes:
            configs.append(configs[-1].changed(dict(item.values)))
        self._changes[at:], self._configs = changes, configs

    def at(self, slot: int) -> Epoch:
        """Return the slots with the same settings to which a slot belongs."""
        at = bisect_right(self._changes, slot, key=_slot_of)
        first = self._changes[at - 1].slot if at else 0
        return Epoch(first, self._changes[at].slot if at < len(self._changes) else _FOREVER, self._configs[at])


_slot_of = attrgetter("slot")


def scheduled_changes(config: Config) -> Iterable[Change]:
    """Turn entries of the schedule, which may end, into changes that stay, at most one per slot."""
    names = sorted({name for entry in config.schedule for name, _ in entry.values})
    edges = sorted({slot for entry in config.schedule for slot in (entry.slot, entry.until)} - {None})
    before = base = {name: getattr(config, name) for name in names}
    for edge in edges:
        now = dict(base)
        begun: set[str] = set()  # settings whose entries begin here: these end changes in flight, too
        for entry in sorted(config.schedule, key=_slot_of):
            if entry.slot <= edge and (entry.until is None or edge < entry.until):
                now.update(entry.values)
                begun |= {name for name, _ in entry.values if entry.slot == edge}
        values = tuple((name, value) for name, value in now.items() if value != before[name] or name in begun)
        before = now
        if values:
            yield Change(edge, values)
