"""The flights of one entry as a plan, so that they fly as those of a sweep do: resumed, on all cores, on a cluster."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from dtsa_agent.core.registry import POLICIES
from dtsa_bench.experiments.batch.code import code_digest
from dtsa_bench.experiments.batch.task import Task, Work, key_of
from dtsa_bench.experiments.sweep.spec import cost_of

from .cells import League
from .flight import fly_one


@dataclass(frozen=True, slots=True)
class Label:
    """One cell of the plan."""

    labels: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Wanted:
    """One flight that is to be flown."""

    cell: str
    k: int  # number of its seed
    seed: int


class EntryPlan:
    """Flights of one scheme.

    :param there: the league.
    :param name: of the entry.
    :param scheme: what the entry sets.
    :param flights: what is to be flown.
    """

    def __init__(self, there: League, name: str, scheme: Mapping[str, Any], flights: Sequence[Wanted]) -> None:
        self.name = f"{there.name} {name}"
        self.cells = tuple(Label({"cell": cell.name}) for cell in there.cells)
        self.source = {"league": there.name, "frozen": there.digest, "scheme": dict(scheme)}
        self.flights = list(flights)
        numbers = {cell.name: number for number, cell in enumerate(there.cells)}
        self._tasks = {
            wanted: self._task(there, scheme, wanted, numbers[wanted.cell])
            for wanted in sorted(flights, key=lambda w: (numbers[w.cell], w.k))
        }

    @staticmethod
    def _task(there: League, scheme: Mapping[str, Any], wanted: Wanted, number: int) -> Task:
        settings = {"league": there.name, "cell": wanted.cell, "scheme": dict(scheme), "seed": wanted.seed}
        cost = cost_of(there.settings(there.cell(wanted.cell), scheme, wanted.seed))
        return Task(key_of({**settings, "frozen": there.digest}), number, wanted.seed, settings, cost)

    def tasks(self) -> Iterator[Task]:
        """All flights, cell by cell."""
        return iter(self._tasks.values())

    def key(self, wanted: Wanted) -> str:
        """Key of the row of a flight.

        :param wanted: the flight.
        """
        return self._tasks[wanted].key


def work_of(policy: str) -> Work:
    """How flights of a policy are done; its code is that of its package, too.

    :param policy: name of the policy.
    """
    named = frozenset() if policy in POLICIES.rows else frozenset({("policy", policy)})
    return Work(fly_one, partial(code_digest, named))


def flights_of(there: League, word: str, cells: Sequence[str], count: int) -> list[Wanted]:
    """The flights of an entry.

    :param there: the league.
    :param word: the practice word, or the secret.
    :param cells: names of the cells.
    :param count: seeds of each.
    """
    return [Wanted(cell, k, there.seed(word, cell, k)) for cell in cells for k in range(count)]
