"""The runs of the protocol's table as a plan, and how one of them is done."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from typing import Any

import yaml

from dtsa_bench.experiments.batch.task import Row, Task, Work, attempt, key_of
from dtsa_dev.code import developers_digest

from .cases import FEWER, PROTOCOLS, SEEDS, SLOTS, Case, Result, cases, run_case

NAME = "protocol"
FIRST_SEED = 1001
TITLE = "The slot protocols alone: ages, waking, joins, deaths, jams, partitions"


@dataclass(frozen=True, slots=True)
class Cell:
    """One case with one protocol."""

    labels: dict[str, str]  # case and protocol


class ProtocolPlan:
    """Every case with each of its protocols and every seed.

    :param rows: the cases.
    :param seeds: number of seeds; None: each column's own.
    :param slots: length of steady and stop-and-go runs; None: each column's own.
    :param first_seed: first of the seeds.
    """

    name = NAME

    def __init__(
        self, rows: Sequence[Case], seeds: int | None = None, slots: int | None = None, first_seed: int = FIRST_SEED
    ) -> None:
        self._rows, self._seeds, self._slots, self._first_seed = rows, seeds, slots, first_seed
        self.cells = [Cell({"case": case.name, "protocol": protocol}) for case in rows for protocol in case.protocols]
        names = [case.name for case in rows]
        self.source: dict[str, Any] = {
            "title": TITLE, "seeds": seeds, "slots": slots, "first_seed": first_seed, "cases": names
        }  # fmt: skip

    def tasks(self) -> Iterator[Task]:
        """All runs, cell by cell."""
        index = 0
        for case in self._rows:
            for protocol in case.protocols:
                seeds, slots = case.effort(protocol)
                seeds = seeds if self._seeds is None else self._seeds
                slots = slots if self._slots is None else self._slots
                many = 20 if protocol == "dtsa" and case.loss else 1
                cost = float(case.agents * case.slots(protocol, slots) * many)
                for seed in range(self._first_seed, self._first_seed + seeds):
                    settings = {"case": case.name, "protocol": protocol, "seed": seed, "slots": slots}
                    yield Task(key_of(settings), index, seed, settings, cost)
                index += 1


@cache
def _cases() -> dict[str, Case]:
    return {case.name: case for case in cases()}


def run_one(task: Task) -> Row:
    """Does one run.

    :param task: the run.
    :returns: its row; what goes wrong becomes the reason in it.
    """
    return attempt(task, _run)


def _run(task: Task) -> tuple[str, Row]:
    wanted = task.settings
    result = run_case(_cases()[wanted["case"]], wanted["protocol"], task.seed, wanted["slots"])
    return "completed", asdict(result)


def result_of(row: Row) -> Result:
    """What a run gave, from its row in the journal."""
    values = row["summary"]
    return Result(**{name: tuple(v) if isinstance(v, list) else v for name, v in values.items()})


WORK = Work(run_one, developers_digest)


def as_yaml() -> str:
    """What is run, for `protocol --show`."""
    rows = [{name: list(v) if isinstance(v, tuple) else v for name, v in asdict(case).items()} for case in cases()]
    fewer = {name: {"seeds": seeds, "slots": slots} for name, (seeds, slots) in FEWER.items()}
    content = {
        "title": TITLE, "seeds": SEEDS, "slots": SLOTS, "fewer": fewer, "protocols": PROTOCOLS, "cases": rows
    }  # fmt: skip
    head = "# Runs without flight: for `tools/dtsa protocol`, not for `sweep --file`.\n"
    return head + yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=120)
