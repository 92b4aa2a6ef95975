"""The entries of docs/evidence/league-1 flown a second time, whole; and entries in which one number was changed."""

from __future__ import annotations

import copy
import random
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dtsa_bench.experiments.batch.task import Row
from dtsa_bench.experiments.league.cells import PRACTICE, League, league
from dtsa_bench.experiments.league.check import check_entry
from dtsa_bench.experiments.league.entry import FIELDS, digest_of, read_entry
from dtsa_bench.experiments.league.scores import summary_of

from .item import Item, NotMet, Soak

_ROOT = Path(__file__).resolve().parents[3]
_ENTRIES = _ROOT / "docs" / "evidence" / "league-1"
_ARCHIVED = ("learned",)  # its package is not part of the repository any more
_FORGED = 10  # entries with one number changed, of each entry
_SAMPLE = ("lease", "tdma")


def _items() -> tuple[Item, ...]:
    names = sorted(path.stem for path in _ENTRIES.glob("*.json") if path.stem not in _ARCHIVED)
    return tuple(Item(name, {}, number, 60.0, sample=name in _SAMPLE) for number, name in enumerate(names, 1))


def _run(item: Item, directory: Path) -> dict[str, Any]:
    entry = read_entry(_ENTRIES / f"{item.name}.json")
    there = league(entry["league"])
    word = there.practice if entry["seeds"] == PRACTICE else there.published()
    found = check_entry(there, entry, word=word, sample=None, seed=0, jobs=None)
    if found.differences:
        raise NotMet(f"{len(found.differences)} differences, the first: {found.differences[0]}")
    draw, missed = random.Random(item.seed), []
    for _ in range(_FORGED):
        forged, what = _forged(there, entry, draw)
        if not check_entry(there, forged, word=word, sample=None, seed=0, jobs=1).differences:
            missed.append(what)
    if missed:
        raise NotMet(f"changed and not found: {', '.join(missed)}")
    return {"flights": found.flown, "forged": _FORGED}


def _forged(there: League, entry: Mapping[str, Any], draw: random.Random) -> tuple[dict[str, Any], str]:
    """One flight of an entry with one number changed, sums and digest made anew; and what was changed."""
    cell = draw.choice(list(entry["flights"]))
    line = copy.deepcopy(draw.choice(entry["flights"][cell]))
    place = draw.choice([n for n, value in enumerate(line) if isinstance(value, (int, float)) and FIELDS[n] != "k"])
    line[place] = line[place] + 1 if isinstance(line[place], int) else line[place] * (1 - 1e-6)
    forged = {**entry, "flights": {cell: [line]}, "complete": False, "summary": summary_of(there, {cell: [line]})}
    return {**forged, "digest": digest_of(forged)}, f"{cell}/{line[0]} {FIELDS[place]}"


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    found = [row["summary"] for row in rows if "flights" in row["summary"]]
    return {"entries": len(found), **{name: sum(one[name] for one in found) for name in ("flights", "forged")}}


SOAK = Soak(
    "league",
    "Every flight of every entry of league-1 flown again has the same row and digest; an entry with one number changed "
    "is found, even if its sums and its digest were made anew.",
    _items(),
    _run,
    _figures,
)
