"""Finished runs as rows, rows as tables: one way to group, print and write them."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from .task import Plan, Row


def collect(plan: Plan, finished: Mapping[str, Row], values: Callable[[Row | None], Row]) -> list[Row]:
    """The finished runs of a plan in its own order: labels, seed, status, reason, cell and flat values.

    :param plan: all runs.
    :param finished: rows by key, see :meth:`~dtsa_bench.experiments.batch.journal.Journal.rows`.
    :param values: makes flat values of the results of one run; None: the run failed.
    """
    rows = []
    for task in plan.tasks():
        row = finished.get(task.key)
        if row is not None:
            common = {"seed": task.seed, "status": row["status"], "reason": row.get("reason", ""), "cell": task.cell}
            rows.append({**plan.cells[task.cell].labels, **common, **values(row["summary"])})
    return rows


def by_cell(plan: Plan, rows: Sequence[Row]) -> list[list[Row]]:
    """Rows of each cell of a plan, in its order; a cell without rows has an empty list."""
    cells: list[list[Row]] = [[] for _ in plan.cells]
    for row in rows:
        cells[row["cell"]].append(row)
    return cells


def aligned(lines: Sequence[Sequence[str]], rule: bool = False) -> str:
    """Lines of cells in columns, for a terminal.

    :param lines: the head first.
    :param rule: draw a line below the head.
    """
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    padded = ["  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in lines]
    if rule:
        padded.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(padded)


def markdown(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Lines of cells as a table in Markdown."""
    top = ["|" + "|".join(f" {name} " if name else " " for name in head) + "|", "|---" * len(head) + "|"]
    return "\n".join([*top, *("| " + " | ".join(line) + " |" for line in lines)])


def write_results(directory: Path, name: str, columns: Sequence[str], rows: Sequence[Row], content: Any) -> None:
    """Writes `<name>.csv` and `<name>.json`, each in one go.

    :param directory: where; it exists.
    :param columns: of the CSV file, in this order; what else a row has is left out.
    :param rows: one a run.
    :param content: of the JSON file.
    """
    write_whole(directory / f"{name}.json", json.dumps(content, indent=1, default=str) + "\n")
    temporary = directory / f"{name}.csv.part"
    with temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: _cell(value) for key, value in row.items()} for row in rows)
    temporary.replace(directory / f"{name}.csv")


def _cell(value: object) -> object:
    return " ".join(map(str, value)) if isinstance(value, (list, tuple)) else value


def write_whole(path: Path, text: str) -> None:
    """Writes a file so that a reader never sees half of it."""
    temporary = path.with_name(path.name + ".part")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)
