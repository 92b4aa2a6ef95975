"""What a soak consists of."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import DtsaError
from dtsa_bench.experiments.batch.task import Row, Task, key_of


class NotMet(DtsaError):
    """What a soak promises did not hold in one of its items; the message says what.

    :param figures: of that item, where it gave them all the same: they are summed up with those of the others.
    """

    def __init__(self, message: str, figures: dict[str, Any] | None = None) -> None:
        super().__init__(message)
        self.figures = figures


@dataclass(frozen=True, slots=True)
class Item:
    """One flight or fault: finished or not, never half."""

    name: str
    settings: Mapping[str, Any] = field(default_factory=dict)  # JSON types
    seed: int = 0
    seconds: float = 20.0  # a rough guess of its wall time
    sample: bool = False  # in the part that takes a few minutes only


@dataclass(frozen=True, slots=True)
class Soak:
    """A named soak.

    :param name: its name.
    :param promise: what holds if it finds nothing, in a sentence.
    :param items: all items.
    :param run: does one in an empty directory and returns its figures; raises :class:`NotMet` where the promise fails.
    :param figures: sums up the figures of all finished items that have them.
    :param check: raises a ConfigError where the machine lacks what it needs.
    """

    name: str
    promise: str
    items: tuple[Item, ...]
    run: Callable[[Item, Path], dict[str, Any]]
    figures: Callable[[Sequence[Row]], dict[str, Any]]
    check: Callable[[], None] = lambda: None


@dataclass(frozen=True, slots=True)
class _Cell:
    labels: Mapping[str, Any]


class SoakPlan:
    """Items of a soak as the plan of a batch, for its journal and its progress.

    :param soak: the soak.
    :param sample: only the items of the sample.
    """

    def __init__(self, soak: Soak, sample: bool) -> None:
        self.soak = soak
        self.name = f"{soak.name}-sample" if sample else soak.name
        self.items = tuple(item for item in soak.items if item.sample or not sample)
        self.cells = [_Cell({"item": item.name}) for item in self.items]
        self.source = {"soak": soak.name, "promise": soak.promise}

    def tasks(self) -> Iterator[Task]:
        """All items."""
        for index, item in enumerate(self.items):
            settings = {"item": item.name, "seed": item.seed, **item.settings}
            yield Task(key_of(settings), index, item.seed, settings, item.seconds * 1e6)
