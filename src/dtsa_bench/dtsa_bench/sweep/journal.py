"""The rows of a sweep on disk: a journal that survives a kill, and the results made from it.

``runs.jsonl`` gets a line for every finished run at once; a half-written last line is ignored when it is read
again.
"""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TextIO

from dtsa_agent.core.errors import ConfigError, DtsaError

from .spec import Sweep

Row = dict[str, Any]

#: Results of one run as columns, in this order; ``slots_...`` are shares of ``slots`` in the summary.
VALUES = (
    "min_distance_m", "efficiency_mean", "completion_time_s", "flight_time_s", "age_mean_slots",
    "age_max_slots", "estimate_error_mean_m", "estimate_error_max_m", "slots_total", "slots_success",
    "slots_collision", "slots_idle", "agreement_share", "equal_views_share", "first_divergence_slot",
    "wall_time_s",
)  # fmt: skip


class Journal:
    """Rows of one sweep in one directory.

    :param directory: where; made if it does not exist.
    :param code: fingerprint of the code that flies; rows of other code are put aside.
    :raises ConfigError: if the directory cannot be made or belongs to another sweep.
    """

    def __init__(self, directory: Path, sweep: Sweep, code: str) -> None:
        self.directory, self.sweep, self.code = directory, sweep, code
        self.put_aside = 0  # rows of other code
        self._file: TextIO | None = None
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError("out", str(directory), f"a directory that can be made ({error.strerror})") from error
        self._check_header()

    @property
    def path(self) -> Path:
        """The journal's file."""
        return self.directory / "runs.jsonl"

    def _check_header(self) -> None:
        header = self.directory / "sweep.json"
        old: dict[str, Any] = {}
        if header.exists():
            try:
                old = json.loads(header.read_text(encoding="utf-8"))
            except (OSError, json.JSONDecodeError):
                old = {}
        if old.get("name", self.sweep.name) != self.sweep.name:
            raise ConfigError("out", str(self.directory), f"another directory: this one holds sweep {old['name']}")
        if old.get("code", self.code) != self.code and self.path.exists():
            self.put_aside = sum(1 for _ in read_rows(self.path))
            self.path.replace(self.directory / f"runs-of-code-{old['code']}.jsonl")
        content = {"name": self.sweep.name, "code": self.code, "sweep": self.sweep.source}
        try:
            write_whole(header, json.dumps(content, indent=1, default=str) + "\n")
        except OSError as error:
            reason = f"a directory that can be written to ({error.strerror})"
            raise ConfigError("out", str(self.directory), reason) from error

    def rows(self) -> dict[str, Row]:
        """Finished runs of this sweep by key;

        those that failed are left out, so that they are tried again.
        """
        wanted = {task.key for task in self.sweep.tasks()}
        return {row["key"]: row for row in read_rows(self.path) if row["key"] in wanted and row["status"] != "failed"}

    def append(self, rows: Iterable[Row]) -> None:
        """Writes rows; they are in the file's hands when this returns.

        :raises DtsaError: if they cannot be written; those before stay.
        """
        try:
            self._append(rows)
        except OSError as error:
            raise DtsaError(f"{self.path} cannot be written ({error.strerror})") from error

    def _append(self, rows: Iterable[Row]) -> None:
        if self._file is None:
            broken = self.path.exists() and self.path.stat().st_size > 0 and not _ends_with_newline(self.path)
            self._file = self.path.open("a", encoding="utf-8")
            if broken:
                self._file.write("\n")
        self._file.writelines(json.dumps(row, separators=(",", ":")) + "\n" for row in rows)
        self._file.flush()

    def close(self) -> None:
        """Closes the file."""
        if self._file is not None:
            self._file.close()
            self._file = None


def read_rows(path: Path) -> Iterator[Row]:
    """The rows of a journal; lines that are no rows are skipped.

    :param path: the file; need not exist.
    """
    if not path.exists():
        return
    with path.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            try:
                row = json.loads(line)
            except json.JSONDecodeError:
                continue
            if isinstance(row, dict) and {"key", "status", "summary", "seed"} <= row.keys():
                yield row


def collect(sweep: Sweep, finished: dict[str, Row]) -> list[Row]:
    """The rows of a sweep in its own order: labels, seed, status, reason and flat values.

    :param sweep: the sweep.
    :param finished: rows by key, see :meth:`Journal.rows`.
    """
    rows = []
    for task in sweep.tasks():
        row = finished.get(task.key)
        if row is None:
            continue
        flat: Row = {
            **sweep.cells[task.cell].labels,
            "seed": task.seed,
            "status": row["status"],
            "reason": row.get("reason", ""),
            "cell": task.cell,
        }
        flat.update(_values(row["summary"]))
        rows.append(flat)
    return rows


def _values(summary: dict[str, Any] | None) -> dict[str, Any]:
    if summary is None:
        return dict.fromkeys(("collided", *VALUES))
    slots = {f"slots_{name}": count for name, count in summary["slots"].items()}
    return {"collided": summary["collided"], **{name: slots.get(name, summary.get(name)) for name in VALUES}}


def write_results(directory: Path, sweep: Sweep, rows: Sequence[Row], groups: Sequence[Row], code: str) -> None:
    """Writes ``results.csv`` and ``results.json``, each in one go.

    :param directory: where.
    :param rows: see :func:`collect`.
    :param groups: the rows summed up, one a cell.
    """
    content = {
        "name": sweep.name,
        "title": sweep.title,
        "code": code,
        "sweep": sweep.source,
        "groups": list(groups),
        "runs": [{key: value for key, value in row.items() if key != "cell"} for row in rows],
    }
    write_whole(directory / "results.json", json.dumps(content, indent=1, default=str) + "\n")
    columns = [*sweep.axes, "seed", "status", "reason", "collided", *VALUES]
    temporary = directory / "results.csv.part"
    with temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    temporary.replace(directory / "results.csv")


def write_whole(path: Path, text: str) -> None:
    """Writes a file so that a reader never sees half of it."""
    temporary = path.with_name(path.name + ".part")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)


def _ends_with_newline(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"
