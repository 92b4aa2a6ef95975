"""What is to be run: tasks of a plan, and the work that does one of them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

Row = dict[str, Any]
FAILED = "failed"  # status of a run that ended with an error


@dataclass(frozen=True, slots=True)
class Task:
    """One run, small enough to be sent anywhere."""

    key: str  # of the run's settings: equal settings, equal key
    cell: int  # index of its combination of settings in the plan
    seed: int
    settings: dict[str, Any]
    cost: float  # a rough guess of the work in it, about 1 us of a core


class Labelled(Protocol):
    """One combination of settings, which is run with every seed."""

    @property
    def labels(self) -> Mapping[str, Any]:
        """What tells it from others: name -> value."""
        ...


class Plan(Protocol):
    """All runs of an experiment."""

    @property
    def name(self) -> str:
        """Its name; a directory of results belongs to one."""
        ...

    @property
    def cells(self) -> Sequence[Labelled]:
        """All combinations of settings."""
        ...

    @property
    def source(self) -> Mapping[str, Any]:
        """What it was made from, as plain values."""
        ...

    def tasks(self) -> Iterator[Task]:
        """All runs, cell by cell, with ascending seeds in each."""
        ...


@dataclass(frozen=True, slots=True)
class Work:
    """How a run is done. Both are functions of a module, so that they can be sent to other processes."""

    run: Callable[[Task], Row]  # never raises: see :func:`attempt`
    code: Callable[[], str]  # digest of the code that runs, see :mod:`.code`: rows of different code are never mixed


def attempt(task: Task, run: Callable[[Task], tuple[str, Row]]) -> Row:
    """One run as a row. Whatever goes wrong in it becomes the reason in the row: one bad run never ends a batch.

    :param task: the run.
    :param run: returns how the run ended, and its results as plain values.
    """
    row: Row = {"key": task.key, "cell": task.cell, "seed": task.seed}
    try:
        status, summary = run(task)
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        return {**row, "status": FAILED, "reason": reason, "summary": None}
    return {**row, "status": status, "reason": "", "summary": summary}


def key_of(settings: Mapping[str, Any]) -> str:
    """A short digest of settings."""
    text = json.dumps(settings, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:20]
