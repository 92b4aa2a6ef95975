"""Commands at 50 Hz for twelve Crazyflies through the bridge's process, over UDP and over three dongles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from dtsa_bench.experiments.batch.task import Row
from dtsa_dev.benchmark.crazyflie import COUNT, MEASURE_S, measure
from dtsa_dev.soak.checks import met
from dtsa_dev.soak.item import Item

from .fleets import station_priority

EACH = 2
LEAST_HZ = 48.0
_LOSSES: dict[str, float | None] = {"udp": None, "radio": 0.0, "radio 1 %": 0.01, "radio 5 %": 0.05}
_KEPT = ("commands_hz", "logs_hz", "latency_median_ms", "latency_p99_ms", "bridge_cpu_percent", "fleet_cpu_percent")


def items() -> Iterator[Item]:
    """Two flights of each kind."""
    for over in _LOSSES:
        for seed in range(1, EACH + 1):
            yield Item(f"commands over {over}, {seed}", {"part": "stream", "over": over}, seed, 30.0)


def run(item: Item, directory: Path) -> dict[str, Any]:
    """Fly.

    :raises NotMet: somebody gets fewer commands than that.
    """
    with station_priority():
        row = measure(COUNT, MEASURE_S, loss=_LOSSES[str(item.settings["over"])])
    met(row["commands_hz"] >= LEAST_HZ, f"only {row['commands_hz']:.1f} commands/s arrive")
    return {**item.settings, **{name: round(float(row[name]), 2) for name in _KEPT}}


def figures(rows: Sequence[Row]) -> dict[str, Any]:
    """By kind: smallest and largest of all numbers."""
    found: dict[str, Any] = {}
    for over in _LOSSES:
        mine = [row for row in rows if row["over"] == over]
        if mine:
            found[f"commands over {over}"] = {
                name: [min(r[name] for r in mine), max(r[name] for r in mine)] for name in _KEPT
            }
    return found
