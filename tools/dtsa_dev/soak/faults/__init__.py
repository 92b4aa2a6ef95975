"""Faults and how the system reacts to them: each row is made to happen to real processes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dtsa_bench.experiments.batch.table import markdown
from dtsa_bench.experiments.batch.task import Row
from dtsa_dev.soak.item import Item, Soak

from . import by_hand, clocks, graph, processes, storage
from .fault import Fault

FAULTS: tuple[Fault, ...] = (
    *processes.FAULTS,
    *graph.FAULTS,
    *by_hand.FAULTS,
    *storage.FAULTS,
    *clocks.FAULTS,
)
_BY_NAME = {fault.name: fault for fault in FAULTS}
_MARK = "<!-- faults: made by `python -m dtsa_dev.soak.faults docs/evidence/faults.md` -->"
_END = "<!-- end -->"
_SECONDS = 25.0  # a guess of the wall time of a row


def _run(item: Item, directory: Path) -> dict[str, Any]:
    _BY_NAME[item.name].run(directory)
    return {}


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    return {"rows": len(FAULTS), "as the table says": len(rows)}


def table() -> str:
    """The table of faults and reactions, in Markdown."""
    lines = [
        (str(number), fault.fault, fault.reaction, "tests and soak" if fault.sample else "soak")
        for number, fault in enumerate(FAULTS, 1)
    ]
    return markdown(("", "what happens", "what the system does", "run by"), lines)


def rewritten(text: str) -> str:
    """A document with the table as it should be.

    :param text: the document; the table stands between two comments.
    """
    head, mark, rest = text.partition(_MARK)
    _, end, tail = rest.partition(_END)
    return f"{head}{mark}\n{table()}\n{end}{tail}"


SOAK = Soak(
    "faults",
    "Each fault of docs/evidence/faults.md has the reaction that stands beside it.",
    tuple(Item(fault.name, {}, 0, _SECONDS, fault.sample) for fault in FAULTS),
    _run,
    _figures,
)
