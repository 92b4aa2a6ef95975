"""Which settings hold in which slot: the schedule, and changes made in flight."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

from dtsa_agent.core.errors import ConfigError

from .schedule import Change, Changing

_Config = TypeVar("_Config", bound=Changing)


@dataclass(frozen=True, slots=True)
class Epoch(Generic[_Config]):
    """A stretch of slots with the same settings.

    :param first: its first slot.
    :param end: first slot after it; None: it lasts.
    :param config: the settings.
    """

    first: int
    end: int | None
    config: _Config


class Timeline(Generic[_Config]):
    """Settings by slot, a pure function of the configuration and of the changes.

    Entries of the schedule may overlap: the one that began last counts (of two that begin together, the later
    in the list), and when it ends, what would have held without it. A change in flight holds from its slot
    until the next change of the same setting, scheduled or not.

    :param config: the settings with their schedule.
    :raises ConfigError: when some slot would have settings that do not go together.
    """

    __slots__ = ("_base", "_changes", "_configs", "_first", "_slots")

    def __init__(self, config: _Config) -> None:
        self._base = config.changed({})
        self._first: list[int] = []  # slot of each change, ascending
        self._changes: list[Change] = []
        self._slots: list[int] = [0]  # slots at which settings change, ascending
        self._configs: list[_Config] = [self._base]
        for change in scheduled_changes(config):
            self.add(change)

    def add(self, change: Change) -> None:
        """Add a change; one in the same slot as others comes last.

        :raises ConfigError: when it, or a later change on top of it, leads to settings that do not go
            together. Nothing is changed then.
        """
        at = bisect_right(self._first, change.slot)
        changes = [*self._changes[:at], change, *self._changes[at:]]
        keep = next((i for i, slot in enumerate(self._slots) if slot >= change.slot), len(self._slots))
        slots, configs = self._slots[:keep], self._configs[:keep]
        for item in changes:
            if item.slot < change.slot:
                continue
            if not slots:
                slots, configs = [0], [self._base]
            config = configs[-1].changed(dict(item.values))
            if item.slot == slots[-1]:
                configs[-1] = config
            else:
                slots.append(item.slot)
                configs.append(config)
        self._first.insert(at, change.slot)
        self._changes = changes
        self._slots, self._configs = slots, configs

    def at(self, slot: int) -> Epoch[_Config]:
        """Return the stretch that a slot belongs to."""
        i = bisect_right(self._slots, slot) - 1
        end = self._slots[i + 1] if i + 1 < len(self._slots) else None
        return Epoch(self._slots[i], end, self._configs[i])


def scheduled_changes(config: Changing) -> Iterable[Change]:
    """Turn entries of the schedule, which may end, into changes that stay, at most one per slot.

    :param config: the settings with their schedule.
    """
    named = {name for entry in config.schedule for name, _ in entry.values}
    edges = sorted({e.slot for e in config.schedule} | {e.until for e in config.schedule if e.until is not None})
    before = {name: getattr(config, name) for name in named}
    for edge in edges:
        now = {name: getattr(config, name) for name in named}
        begun = dict.fromkeys(named, -1)
        for entry in config.schedule:
            if entry.slot <= edge and (entry.until is None or edge < entry.until):
                for name, value in entry.values:
                    if entry.slot >= begun[name]:
                        now[name], begun[name] = value, entry.slot
        values = tuple((name, now[name]) for name in sorted(named) if now[name] != before[name])
        before = now
        if values:
            yield Change(edge, values)


def check_schedule(config: Changing) -> None:
    """Tries every state that the channel will be in.

    :param config: the settings with their schedule.
    :raises ConfigError: if it leads to settings that do not go together.
    """
    try:
        Timeline(config)
    except ConfigError as error:
        raise ConfigError(f"schedule: {error.field}", error.value, error.allowed) from None
