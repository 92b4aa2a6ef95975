"""Runs a soak item by item, within a limit of time, and writes what it found."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from dtsa_bench.experiments.batch.journal import Journal
from dtsa_bench.experiments.batch.made_with import made_with
from dtsa_bench.experiments.batch.progress import Progress, ending_on_signals
from dtsa_bench.experiments.batch.table import write_whole
from dtsa_bench.experiments.batch.task import FAILED, Row, Task, attempt
from dtsa_dev.code import developers_digest

from .item import Item, NotMet, Soak, SoakPlan

PASSED = "passed"


def run_soak(soak: Soak, directory: Path, minutes: float, sample: bool = False) -> dict[str, Any]:
    """Does what a directory's journal does not have yet, one item after the other.

    :param soak: the soak.
    :param directory: where the journal is; made if it does not exist.
    :param minutes: min after which no item begins.
    :param sample: only the items of the sample.
    :returns: the record of the soak, see :func:`record_of`.
    :raises KeyboardInterrupt: on Ctrl-C and SIGTERM; finished items are kept.
    """
    plan, end = SoakPlan(soak, sample), time.monotonic() + 60.0 * minutes
    journal = Journal(directory, plan, developers_digest())
    state = made_with()
    before = _load()
    with ending_on_signals(journal), Progress(journal) as progress:
        rows, failed = journal.rows(), journal.failed()
        for task in plan.tasks():
            if task.key in rows:
                continue
            if time.monotonic() >= end:
                break
            row = _one(soak, plan.items[task.cell], task)
            journal.append([row])
            rows[task.key] = row
            if row["status"] == FAILED:
                print(f"{plan.name}: {plan.items[task.cell].name}: {row['reason']}", file=sys.stderr)
            progress.advance(1, task.cost)
    record = record_of(plan, rows, failed, state)
    return {**record, "load": {"before": before, "after": _load()}}


def _one(soak: Soak, item: Item, task: Task) -> Row:
    begin, load = time.monotonic(), _load()
    failed: Row | None = None  # figures of an item that failed

    def run(_: Task) -> tuple[str, Row]:
        nonlocal failed
        with tempfile.TemporaryDirectory(prefix="dtsa-soak-") as directory:
            try:
                return PASSED, soak.run(item, Path(directory))
            except NotMet as error:
                failed = error.figures
                raise

    row = attempt(task, run)
    if failed is not None:
        row["summary"] = failed
    return {**row, "item": item.name, "wall_s": round(time.monotonic() - begin, 1), "load": load[0]}


def record_of(
    plan: SoakPlan, rows: dict[str, Row], failed: dict[str, list[Row]], state: dict[str, Any]
) -> dict[str, Any]:
    """What is kept of a soak.

    :param plan: the items.
    :param rows: those that are finished, by key.
    :param failed: those that failed in runs before, by key: no failure is forgotten, whatever came of it when repeated.
    :param state: what it ran on.
    """
    tasks = list(plan.tasks())
    rows = {key: earlier[-1] for key, earlier in failed.items()} | rows
    done = [rows[task.key] for task in tasks if task.key in rows]
    failures = [_failure(row) for row in done if row["status"] == FAILED]
    repeated = [_failure(row) for key, earlier in failed.items() if rows[key]["status"] != FAILED for row in earlier]
    return {
        "soak": plan.name,
        "promise": plan.soak.promise,
        **state,
        "seeds": sorted({row["seed"] for row in done}),
        "items": len(tasks),
        "finished": len(done),
        "wall_s": round(sum(row["wall_s"] for row in done), 1),
        "load_of_items": [min((r["load"] for r in done), default=0.0), max((r["load"] for r in done), default=0.0)],
        "figures": plan.soak.figures([row for row in done if row["summary"] is not None]),
        "failures": failures,
        **({"failed_before_they_passed": repeated} if repeated else {}),
    }


def _failure(row: Row) -> dict[str, str]:
    return {"item": row["item"], "reason": row["reason"]}


def write_record(path: Path, record: dict[str, Any]) -> None:
    """Writes a soak's record as JSON, whole or not at all.

    :param path: the file; its directory is made.
    :param record: what :func:`run_soak` returned.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, json.dumps(record, indent=1) + "\n")


def _load() -> list[float]:
    """Load of the machine over the last 1, 5 and 15 minutes."""
    return [float(word) for word in Path("/proc/loadavg").read_text(encoding="ascii").split()[:3]]
