"""What the flights of an entry are worth, and which of two entries is ahead of the other."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_bench.experiments.batch.task import FAILED
from dtsa_bench.experiments.statistics import LEVEL, wilson

from .cells import League

Array = NDArray[np.float64]
Lines = Mapping[str, Sequence[Sequence[Any]]]
COMPLETED, CRASHED, TIMED_OUT = "completed", "crashed", "timed out"
_STATUS, _AGE, _AIR = 2, 5, 7  # places in a row; a test compares them with the fields of entries
LEAST_AGE_MS = 0.01  # smaller ages count as this one: their logarithm is taken


def lost(line: Sequence[Any]) -> bool:
    """Whether a flight was lost: it crashed, did not end in time or could not be flown.

    :param line: its row.
    """
    return bool(line[_STATUS] != COMPLETED)


def age_ms(line: Sequence[Any], most: float) -> float:
    """What counts as the age of a flight, ms.

    :param line: its row.
    :param most: that of a lost flight of its cell, and the largest.
    """
    age = line[_AGE]
    return most if lost(line) or age is None else min(most, max(LEAST_AGE_MS, float(age)))


def summary_of(there: League, table: Lines) -> dict[str, Any]:
    """The scores of an entry, of all its flights and of each cell.

    :param there: the league.
    :param table: rows by cell.
    """
    cells = {cell.name: _cell(table[cell.name], cell.lost_age_ms) for cell in there.cells if cell.name in table}
    lines = [line for cell in there.cells for line in table.get(cell.name, ())]
    most = {cell.name: cell.lost_age_ms for cell in there.cells}
    worst = max(cells, key=lambda name: _badness(cells[name], most[name]), default=None)
    ages = [np.log([age_ms(line, most[name]) for line in table[name]]) for name in cells]
    loads = [np.array([line[_AIR] for line in table[name] if line[_AIR] is not None]) for name in cells]
    found = wilson(sum(map(lost, lines)), len(lines))
    age = [math.exp(value) for value in _stratified(ages)]
    return {
        "flights": len(lines),
        "lost": found.count,
        "lost_low": found.low,
        "lost_high": found.high,
        **{name: sum(line[_STATUS] == status for line in lines) for name, status in _ENDS.items()},
        **dict(zip(("age_ms", "age_low_ms", "age_high_ms"), age, strict=True)),
        **dict(zip(("air", "air_low", "air_high"), _air([part for part in loads if len(part)]), strict=True)),
        "worst_cell": worst,
        "cells": cells,
    }


def _badness(cell: Mapping[str, Any], most: float) -> tuple[float, float]:
    """Order of cells: share of lost flights, then age for that of lost ones."""
    return cell["lost"] / cell["flights"], cell["age_ms"] / most


_ENDS = {"crashed": CRASHED, "timed_out": TIMED_OUT, "failed": FAILED}


def _cell(lines: Sequence[Sequence[Any]], most: float) -> dict[str, Any]:
    found = wilson(sum(map(lost, lines)), len(lines))
    ages = np.log([age_ms(line, most) for line in lines])
    loads = np.array([line[_AIR] for line in lines if line[_AIR] is not None])
    age = [math.exp(value) for value in _stratified([ages])]
    return {
        "flights": len(lines),
        "lost": found.count,
        "lost_low": found.low,
        "lost_high": found.high,
        **{name: sum(line[_STATUS] == status for line in lines) for name, status in _ENDS.items()},
        **dict(zip(("age_ms", "age_low_ms", "age_high_ms"), age, strict=True)),
        "air": float(loads.mean()) if len(loads) else None,
    }


def _air(loads: Sequence[Array]) -> Sequence[float | None]:
    """Time on the air with its interval; None if nothing could be flown."""
    return _stratified(loads) if loads else (None, None, None)


def _stratified(parts: Sequence[Array]) -> tuple[float, float, float]:
    """Mean over parts that weigh the same, and its interval from the variances within them.

    :param parts: values of each part; with one value alone a part has no variance.
    """
    mean, error = _mean_and_error(parts)
    half = NormalDist().inv_cdf(0.5 + LEVEL / 2) * error
    return mean, mean - half, mean + half


def _mean_and_error(parts: Sequence[Array]) -> tuple[float, float]:
    mean = float(np.mean([part.mean() for part in parts]))
    variances = [part.var(ddof=1) / len(part) if len(part) > 1 else 0.0 for part in parts]
    return mean, math.sqrt(sum(map(float, variances))) / len(parts)


@dataclass(frozen=True, slots=True)
class Standing:
    """The place of an entry among others."""

    name: str
    rank: int | None  # None: a bound
    first: int | None  # best and worst rank that the pairs of flights leave open
    last: int | None


def standings(there: League, entries: Sequence[Mapping[str, Any]]) -> list[Standing]:
    """Places of entries, the best first, bounds at the end.

    An entry is ahead of another if it lost fewer flights of the same seeds (exact test of McNemar). Where that is not
    decided, it is if it has less age on the same seeds (normal test of the mean difference of logarithms, cells apart).
    All tests of all pairs are corrected together (Holm), so that all intervals of ranks hold together with 95 %.
    The order is by how many entries are ahead, of equal ones by lost flights, then by age.

    :param there: the league.
    :param entries: with the same flights.
    """
    ordered = sorted(entries, key=lambda entry: (entry["summary"]["lost"], entry["summary"]["age_ms"], entry["name"]))
    ranked = [entry for entry in ordered if entry["kind"] != "bound"]
    bounds = [Standing(entry["name"], None, None, None) for entry in ordered if entry["kind"] == "bound"]
    ahead = _ahead(there, ranked)
    better, worse = ahead.sum(axis=0), ahead.sum(axis=1)
    places = []
    for rank, number in enumerate(sorted(range(len(ranked)), key=lambda n: (better[n], n)), 1):
        # Who is ahead of whom need not be transitive: the interval has the rank in it even so.
        first, last = min(rank, 1 + int(better[number])), max(rank, len(ranked) - int(worse[number]))
        places.append(Standing(ranked[number]["name"], rank, first, last))
    return [*places, *bounds]


def _ahead(there: League, entries: Sequence[Mapping[str, Any]]) -> NDArray[np.bool_]:
    """Whether entry i is ahead of entry j, (n, n)."""
    count = len(entries)
    tests = []  # p, i, j, whether i has less, kind
    for i in range(count):
        for j in range(i + 1, count):
            tests += [
                (*_lost_test(entries[i], entries[j]), i, j, 0),
                (*_age_test(there, entries[i], entries[j]), i, j, 1),
            ]
    decided = np.zeros((count, count, 2), dtype=np.int8)
    left = len(tests)
    for p, less, i, j, kind in sorted(tests):
        if p > (1 - LEVEL) / left:
            break
        decided[i, j, kind], left = (1 if less else -1), left - 1
    chosen = np.where(decided[..., 0] != 0, decided[..., 0], decided[..., 1])
    ahead: NDArray[np.bool_] = (chosen == 1) | (chosen.T == -1)
    return ahead


def _pairs(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[tuple[str, list[tuple[Any, Any]]]]:
    return [(cell, list(zip(lines, second["flights"][cell], strict=True))) for cell, lines in first["flights"].items()]


def _lost_test(first: Mapping[str, Any], second: Mapping[str, Any]) -> tuple[float, bool]:
    """p of McNemar's exact test, and whether the first lost fewer."""
    pairs = [pair for _, cell in _pairs(first, second) for pair in cell]
    only_first = sum(lost(a) and not lost(b) for a, b in pairs)
    only_second = sum(lost(b) and not lost(a) for a, b in pairs)
    total, fewer = only_first + only_second, min(only_first, only_second)
    tail = sum(math.comb(total, k) for k in range(fewer + 1)) / 2**total
    return min(1.0, 2 * tail), only_first < only_second


def _age_test(there: League, first: Mapping[str, Any], second: Mapping[str, Any]) -> tuple[float, bool]:
    """p of a normal test of the mean difference of logarithms of ages, and whether the first has less."""
    parts = []
    for cell, pairs in _pairs(first, second):
        most = there.cell(cell).lost_age_ms
        parts.append(np.array([math.log(age_ms(a, most) / age_ms(b, most)) for a, b in pairs]))
    mean, error = _mean_and_error(parts)
    if error == 0.0:
        return 1.0, False
    return 2 * NormalDist().cdf(-abs(mean) / error), mean < 0
