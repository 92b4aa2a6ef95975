"""An entry: one JSON file with a row a flight, who flew, with what, and a summary that follows from the rows."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_agent.core.errors import ConfigError
from dtsa_bench import __version__
from dtsa_bench.experiments.batch.made_with import made_with
from dtsa_bench.experiments.batch.table import write_whole
from dtsa_bench.experiments.batch.task import FAILED, Row

from .cells import JUDGED, PRACTICE, League, league
from .entrant import Entrant
from .flight import VALUES
from .plan import Wanted
from .scores import summary_of

FIELDS = ("k", "seed", "status", *VALUES, "digest", "reason")
_KEYS: dict[str, Any] = {
    "league": str, "frozen": str, "name": str, "kind": str, "scheme": dict, "package": dict, "seeds": str,
    "commitment": (str, type(None)), "complete": bool, "made_with": dict, "summary": dict, "digest": str,
    "fields": list, "flights": dict,
}  # fmt: skip


def make_entry(
    there: League, entrant: Entrant, flights: Sequence[Wanted], rows: Sequence[Row], seeds: str, code: str
) -> dict[str, Any]:
    """An entry from finished flights.

    :param there: the league.
    :param entrant: who flew.
    :param flights: what was flown.
    :param rows: the row of each.
    :param seeds: ``practice`` or ``judged``.
    :param code: digest of the code that flew.
    """
    table: dict[str, list[list[Any]]] = {cell.name: [] for cell in there.cells}
    for wanted, row in zip(flights, rows, strict=True):
        table[wanted.cell].append(listed(wanted, row))
    table = {cell: sorted(lines) for cell, lines in table.items() if lines}
    made = made_with()
    entry = {
        "league": there.name,
        "frozen": there.digest,
        "name": entrant.name,
        "kind": entrant.kind,
        "scheme": dict(entrant.scheme),
        "package": dict(entrant.package),
        "seeds": seeds,
        "commitment": there.commitment if seeds == JUDGED else None,
        "complete": is_complete(there, table),
        "made_with": {
            "dtsa": __version__,
            "code": code,
            "commit": made["commit"],
            "tree_changed": made["tree_changed"],
            "date": made["date"],
            "python": made["python"],
            "numpy": np.__version__,
        },
        "summary": summary_of(there, table),
        "fields": list(FIELDS),
        "flights": table,
    }
    return {**entry, "digest": digest_of(entry)}


def listed(wanted: Wanted, row: Row) -> list[Any]:
    """A flight as its entry lists it, in the order of :data:`FIELDS`.

    :param wanted: the flight.
    :param row: its row.
    """
    summary = row["summary"] if row["status"] != FAILED else dict.fromkeys((*VALUES, "digest"))
    values = [summary[name] for name in (*VALUES, "digest")]
    return [wanted.k, wanted.seed, row["status"], *values, row["reason"]]


def is_complete(there: League, table: Mapping[str, Sequence[Sequence[Any]]]) -> bool:
    """Whether all seeds of all cells were flown.

    :param there: the league.
    :param table: rows by cell.
    """
    return all([line[0] for line in table.get(cell.name, ())] == list(range(there.count)) for cell in there.cells)


def digest_of(entry: Mapping[str, Any]) -> str:
    """SHA-256 over all that an entry says but this digest.

    :param entry: the entry.
    """
    rest = {key: value for key, value in entry.items() if key != "digest"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def write_entry(path: Path, entry: Mapping[str, Any]) -> None:
    """Writes an entry, a line a flight.

    :param path: the file.
    :param entry: the entry.
    """
    head = json.dumps({key: value for key, value in entry.items() if key != "flights"}, indent=1)
    cells = [
        f'  "{cell}": [\n' + ",\n".join("   " + json.dumps(line, separators=(",", ":")) for line in lines) + "\n  ]"
        for cell, lines in entry["flights"].items()
    ]
    write_whole(path, head[:-2] + ',\n "flights": {\n' + ",\n".join(cells) + "\n }\n}\n")


def read_entry(path: str | Path) -> dict[str, Any]:
    """An entry from its file, or from the directory that `league enter` wrote.

    :param path: the file or directory.
    :raises ConfigError: if it is none.
    """
    file = Path(path) / "entry.json" if Path(path).is_dir() else Path(path)
    try:
        entry = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError("ENTRY", str(path), f"an entry of a league, JSON ({error})") from error
    if not isinstance(entry, dict):
        raise ConfigError("ENTRY", str(path), "an entry of a league: a JSON object")
    for key, kind in _KEYS.items():
        if key not in entry or not isinstance(entry[key], kind):
            raise ConfigError("ENTRY", str(path), f"an entry of a league: {key} is missing or of another type")
    there = league(entry["league"])
    if entry["frozen"] != there.digest:
        raise ConfigError("ENTRY", str(path), f"an entry of {there.name} as it is frozen here ({there.digest})")
    if entry["seeds"] not in (PRACTICE, JUDGED):
        raise ConfigError("ENTRY", str(path), f"seeds: {PRACTICE} or {JUDGED}")
    _check_rows(str(path), there, entry)
    return entry


def _check_rows(path: str, there: League, entry: Mapping[str, Any]) -> None:
    """Whether rows have the fields and types of rows.

    :raises ConfigError: naming the first that has not.
    """
    if entry["fields"] != list(FIELDS):
        raise ConfigError("ENTRY", path, f"an entry whose fields are {', '.join(FIELDS)}")
    for cell, lines in entry["flights"].items():
        there.cell(cell)
        for line in lines if isinstance(lines, list) else [None]:
            if not _is_row(line):
                raise ConfigError("ENTRY", path, f"rows of cell {cell} with {', '.join(FIELDS)}; got {str(line)[:60]}")


def _is_row(line: Any) -> bool:
    if not isinstance(line, list) or len(line) != len(FIELDS):
        return False
    row = dict(zip(FIELDS, line, strict=True))
    numbers = [row[name] for name in VALUES if row[name] is not None]
    return (
        all(isinstance(row[name], int) and not isinstance(row[name], bool) for name in ("k", "seed"))
        and all(isinstance(row[name], str) for name in ("status", "reason"))
        and isinstance(row["digest"], (str, type(None)))
        and all(isinstance(n, (int, float)) and not isinstance(n, bool) and math.isfinite(n) for n in numbers)
    )
