"""An hour of coverage-guided fuzzing of libdtsa, in shares that each go on with the inputs of the one before."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from dtsa_bench.experiments.batch.task import Row
from dtsa_dev.proofs.fuzz import TARGETS, Found, build, fuzz

from .item import Item, NotMet, Soak

_SHARES = 6
_SECONDS = {"frames": 120.0, "agents": 420.0, "hearing": 60.0}  # of one share: an hour in all
_CORPUS = Path("runs") / "fuzz"  # kept: the next soak begins where this one ended


def _items() -> Iterator[Item]:
    for target in TARGETS:
        for share in range(1, _SHARES + 1):
            seconds = _SECONDS[target]
            yield Item(f"{target} {share}", {"target": target, "seconds": seconds}, share, seconds)
        settings = {"target": target, "seconds": 30.0}
        yield Item(f"{target}, a short one", settings, 100, 30.0, sample=True)


def _run(item: Item, directory: Path) -> dict[str, Any]:
    target = str(item.settings["target"])
    try:
        done = fuzz(build(target, directory), float(item.settings["seconds"]), (_CORPUS / target).resolve(), item.seed)
    except Found as error:
        raise NotMet(str(error)) from error
    return {"target": target, "runs": done.runs, "covered": done.covered, "features": done.features}


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    figures: dict[str, Any] = {}
    for target in TARGETS:
        mine = [row["summary"] for row in rows if row["summary"]["target"] == target]
        figures[f"{target}: inputs"] = sum(int(row["runs"]) for row in mine)
        figures[f"{target}: edges reached"] = max((int(row["covered"]) for row in mine), default=0)
    return figures


SOAK = Soak(
    "fuzz",
    "no input makes decoders or agents of libdtsa, or what agents on a network make of datagrams, touch foreign "
    "memory, do what C leaves undefined, or stand still",
    tuple(_items()),
    _run,
    _figures,
)
