"""Rows of runs summed up: one group for each combination of the axes, with intervals."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dtsa_bench.experiments.batch.table import by_cell, collect, write_results
from dtsa_bench.experiments.batch.task import FAILED, Row
from dtsa_bench.experiments.statistics import Mean, Share, bootstrap_mean, wilson

from .columns import COMMON, VALUES
from .spec import Cell, Sweep


@dataclass(frozen=True, slots=True)
class Measure:
    """A number that a flight has, and which flights count for it."""

    name: str
    label: str
    unit: str
    digits: int
    complete_only: bool  # only flights that were completed without a crash, as in the paper
    better: int = 0  # 1: more is better, -1: less is better


MEASURES = {
    measure.name: measure
    for measure in (
        Measure("min_distance_m", "minimum distance", "m", 3, True, 1),
        Measure("efficiency_mean", "trajectory efficiency", "", 3, True, 1),
        Measure("completion_time_s", "completion time", "s", 2, True, -1),
        Measure("age_mean_slots", "age", "slots", 2, False, -1),
        Measure("age_mean_ms", "age", "ms", 1, False, -1),
        Measure("waking_age_mean_slots", "age from waking on", "slots", 2, False, -1),
        Measure("waking_age_mean_ms", "age from waking on", "ms", 1, False, -1),
        Measure("first_heard_95_slots", "95 % of wakings heard after", "slots", 1, False, -1),
        Measure("channel_load", "share of time on the air", "", 4, False, -1),
        Measure("estimate_error_mean_m", "error of estimates", "m", 4, False, -1),
        Measure("wasted_share", "slots without a frame", "", 3, False, -1),
    )
}
CRASHED = "crashed"  # a share, not a mean; may stand where a measure's name stands in figures


def label_of(measure: str) -> str:
    """A measure with its unit."""
    if measure == CRASHED:
        return "flights that crashed"
    spec = MEASURES[measure]
    return f"{spec.label} [{spec.unit}]" if spec.unit else spec.label


class Group:
    """All runs of one cell.

    :param cell: the cell.
    :param rows: its rows.
    """

    def __init__(self, cell: Cell, rows: Sequence[Row]) -> None:
        self.cell = cell
        self.labels = cell.labels
        self.rows = list(rows)
        flown = [row for row in rows if row["status"] != FAILED]
        self.flown = len(flown)
        self.failed = len(rows) - len(flown)
        self.timed_out = sum(row["status"] == "timed out" for row in flown)
        self.crashed: Share = wilson(sum(bool(row["collided"]) for row in flown), len(flown))
        self._means: dict[str, Mean] = {}

    def left_out(self) -> dict[str, int]:
        """Runs that do not count for means of complete flights, by reason."""
        reasons: Counter[str] = Counter()
        for row in self.rows:
            if row["status"] == FAILED:
                reasons[f"failed ({row['reason']})"] += 1
            elif row["collided"]:
                reasons["crashed"] += 1
            elif row["status"] != "completed":
                reasons[row["status"]] += 1
        return dict(reasons)

    def values(self, measure: str) -> dict[int, float]:
        """A measure by seed; runs that do not count are not a number."""
        spec = MEASURES[measure]
        return {row["seed"]: _value(row, spec) for row in self.rows}

    def mean(self, measure: str) -> Mean:
        """Mean of a measure over the runs that count, with a bootstrap interval."""
        if measure not in self._means:
            self._means[measure] = bootstrap_mean(self.values(measure).values())
        return self._means[measure]

    def flat(self) -> Row:
        """The group as one row of plain values: labels, how its flights ended, and means with their intervals."""
        share = self.crashed
        row: Row = {
            **self.labels,
            "runs": len(self.rows),
            "failed": self.failed,
            "timed_out": self.timed_out,
            "crashed": share.value,
            "crashed_low": share.low,
            "crashed_high": share.high,
        }
        for name in MEASURES:
            mean = self.mean(name)
            row |= {name: mean.value, f"{name}_low": mean.low, f"{name}_high": mean.high, f"{name}_count": mean.count}
        return row


def _value(row: Row, spec: Measure) -> float:
    if row["status"] == FAILED or (spec.complete_only and (row["collided"] or row["status"] != "completed")):
        return math.nan
    if spec.name == "wasted_share":
        return float(row["slots_total"] - row["slots_success"]) / row["slots_total"]
    value = row.get(spec.name)
    return math.nan if value is None else float(value)


class Table:
    """All groups of a sweep.

    :param sweep: the sweep.
    :param rows: its rows, see :func:`collected`.
    """

    def __init__(self, sweep: Sweep, rows: Sequence[Row]) -> None:
        self.sweep = sweep
        self.rows = list(rows)
        self.runs = len(rows)
        self.groups = [Group(cell, part) for cell, part in zip(sweep.cells, by_cell(sweep, rows), strict=True)]

    def levels(self, axis: str) -> list[Any]:
        """The values of an axis, in the sweep's order."""
        return list(dict.fromkeys(group.labels[axis] for group in self.groups))

    def where(self, **labels: Any) -> list[Group]:
        """Groups with these labels."""
        return self.select(labels)

    def select(self, labels: Mapping[str, Any], check: Callable[[Group], bool] = bool) -> list[Group]:
        """Groups with these labels.

        :param labels: axis -> value.
        :param check: a further condition.
        """
        return [g for g in self.groups if all(g.labels.get(a) == v for a, v in labels.items()) and check(g)]

    def left_out(self) -> dict[str, int]:
        """Runs left out of the means of complete flights, by reason."""
        total: Counter[str] = Counter()
        for group in self.groups:
            total.update(group.left_out())
        return dict(total)

    def plain(self) -> list[Row]:
        """The groups as plain values, for results.json."""
        return [_plain(group) for group in self.groups]


def _plain(group: Group) -> Row:
    crashed = group.crashed
    means = {}
    for name in MEASURES:
        mean = group.mean(name)
        if mean.count:
            means[name] = {"mean": mean.value, "low": mean.low, "high": mean.high, "runs": mean.count}
    return {
        **group.labels,
        "runs": len(group.rows),
        "timed_out": group.timed_out,
        "left_out": group.left_out(),
        "crashed": {"count": crashed.count, "of": crashed.total, "low": crashed.low, "high": crashed.high},
        **means,
    }


def collected(sweep: Sweep, finished: Mapping[str, Row]) -> list[Row]:
    """The rows of a sweep in its own order: labels, seed, status, reason, cell and `VALUES`.

    :param sweep: the sweep.
    :param finished: rows by key.
    """
    return collect(sweep, finished, _values)


def _values(summary: Row | None) -> Row:
    if summary is None:
        return dict.fromkeys(("collided", *VALUES))
    slots = {f"slots_{name}": count for name, count in summary["slots"].items()}
    return {"collided": summary["collided"], **{name: slots.get(name, summary.get(name)) for name in VALUES}}


def write_table(directory: Path, table: Table, code: str) -> None:
    """Writes ``results.csv`` and ``results.json``, each in one go.

    :param directory: where.
    :param table: the sweep's rows and groups.
    :param code: digest of the code that flew.
    """
    sweep = table.sweep
    content = {
        "name": sweep.name,
        "title": sweep.title,
        "code": code,
        "sweep": sweep.source,
        "groups": table.plain(),
        "runs": [{key: value for key, value in row.items() if key != "cell"} for row in table.rows],
    }
    write_results(directory, "results", [*sweep.axes, *COMMON, *VALUES], table.rows, content)
