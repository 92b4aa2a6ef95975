"""Crazyflies: missions, gaps of the air and streams of commands, over UDP and over simulated radios."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from dtsa_bench.experiments.batch.task import Row
from dtsa_dev.soak.item import Item, Soak

from . import cuts, faults, gaps, missions, streams

_PARTS = {"mission": missions, "gap": gaps, "stream": streams, "cut": cuts, "fault": faults}


def _items() -> Iterator[Item]:
    """All items, a fifth of each kind after the other: a soak that is cut short has seen everything."""
    parts = [list(part.items()) for part in _PARTS.values()]
    placed = [((item.seed - 1) / max(i.seed for i in part), item) for part in parts for item in part]
    yield from (item for _, item in sorted(placed, key=lambda pair: pair[0]))


def _run(item: Item, directory: Path) -> dict[str, Any]:
    return _PARTS[str(item.settings["part"])].run(item, directory)


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    figures: dict[str, Any] = {}
    found = [row["summary"] for row in rows]
    for name, part in _PARTS.items():
        figures.update(part.figures([summary for summary in found if summary["part"] == name]))
    return figures


SOAK = Soak(
    "crazyflie",
    "missions of twelve complete with code 0, nobody nearer than 0.25 m, over UDP and over radios that lose packets; "
    "nobody falls after a gap of the air below 0.75 s; commands reach twelve over three dongles at 50 Hz; missions cut "
    "short land as far apart; with random faults nobody whose motors run comes nearer than 0.2 m to another",
    tuple(_items()),
    _run,
    _figures,
)
