"""The rows of a batch on disk: a journal that survives a kill.

``runs.jsonl`` gets a line for every finished run at once; a half-written last line is ignored when it is read again.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

from dtsa_agent.core.errors import ConfigError, DtsaError

from .table import write_whole
from .task import FAILED, Plan, Row


class Journal:
    """Rows of one plan in one directory.

    :param directory: where; made if it does not exist.
    :param plan: all runs.
    :param code: fingerprint of the code that flies; rows of other code are put aside.
    :raises ConfigError: if the directory cannot be made or belongs to another plan.
    """

    def __init__(self, directory: Path, plan: Plan, code: str) -> None:
        self.directory, self.plan, self.code = directory, plan, code
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
        if old.get("name", self.plan.name) != self.plan.name:
            raise ConfigError("out", str(self.directory), f"another directory: this one holds sweep {old['name']}")
        if old.get("code") != self.code and self.path.exists():
            self.put_aside = sum(1 for _ in read_rows(self.path))
            self._put_aside(self.directory / f"runs-of-code-{old.get('code', 'unknown')}.jsonl")
        content = {"name": self.plan.name, "code": self.code, "sweep": self.plan.source}
        try:
            write_whole(header, json.dumps(content, indent=1, default=str) + "\n")
        except OSError as error:
            reason = f"a directory that can be written to ({error.strerror})"
            raise ConfigError("out", str(self.directory), reason) from error

    def _put_aside(self, aside: Path) -> None:
        """Moves the rows to a file, after those that are in it from before."""
        if aside.exists():
            with aside.open("a", encoding="utf-8") as file:
                file.write("" if _ends_with_newline(aside) else "\n")
                file.write(self.path.read_text(encoding="utf-8", errors="replace"))
            self.path.unlink()
        else:
            self.path.replace(aside)

    def rows(self) -> dict[str, Row]:
        """Finished runs of the plan by key; those that failed are left out, so that they are tried again."""
        wanted = {task.key for task in self.plan.tasks()}
        return {row["key"]: row for row in read_rows(self.path) if row["key"] in wanted and row["status"] != FAILED}

    def failed(self) -> dict[str, list[Row]]:
        """Runs of the plan that failed by key, the last one last, whether they were tried again or not."""
        wanted = {task.key for task in self.plan.tasks()}
        found: dict[str, list[Row]] = {}
        for row in read_rows(self.path):
            if row["key"] in wanted and row["status"] == FAILED:
                found.setdefault(row["key"], []).append(row)
        return found

    def append(self, rows: Iterable[Row]) -> None:
        """Writes rows; they are in the file's hands when this returns.

        :raises DtsaError: if they cannot be written; those before stay.
        """
        try:
            self._append(rows)
        except OSError as error:
            with suppress(OSError):  # what is left of the rows in its buffer cannot be written either
                self.close()
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
        file, self._file = self._file, None
        if file is not None:
            file.close()


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


def _ends_with_newline(path: Path) -> bool:
    with path.open("rb") as file:
        if not file.seek(0, os.SEEK_END):
            return True
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"
