"""Missions of twelve from take-off to landing, one core busy with other work."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_bench.crazyflies.simulated.truth import read_truth
from dtsa_bench.experiments.batch.task import Row
from dtsa_dev.soak.checks import met
from dtsa_dev.soak.flights import dtsa
from dtsa_dev.soak.item import Item
from dtsa_dev.soak.load import busy_machine

from .fleets import running

COUNT = 12
EACH = 5
CLOSEST_M = 0.25
FLYING_M = 0.1  # above the floor
_LOSSES: dict[str, float | None] = {"udp": None, "radio 1 %": 0.01, "radio 5 %": 0.05}
_PATIENCE_S = 180.0


def items() -> Iterator[Item]:
    """Five missions of each kind, and five times three in a row."""
    for seed in range(1, EACH + 1):
        for over in _LOSSES:
            for arming in ("auto", "required"):
                settings = {"part": "mission", "over": over, "arming": arming, "flights": 1}
                sample = seed == 1 and (over, arming) == ("radio 5 %", "auto")
                yield Item(f"mission over {over}, arming {arming}, {seed}", settings, seed, 35.0, sample=sample)
        settings = {"part": "mission", "over": "radio 1 %", "arming": "mixed", "flights": 3}
        yield Item(f"three missions in a row over radio 1 %, {seed}", settings, seed, 90.0)


def run(item: Item, directory: Path) -> dict[str, Any]:
    """Fly.

    :raises NotMet: a mission does not end with code 0, or two come too close.
    """
    over, flights = str(item.settings["over"]), int(item.settings["flights"])
    options = ["--arming", str(item.settings["arming"]), "--seed", str(item.seed), "--radio-seed", str(item.seed)]
    # What follows each other without a restart of the Crazyflies must not be locked by the first one's end.
    station: dict[str, Any] = {"toc_cache": str(directory / "cache"), "safety": {"emergency_watchdog": flights == 1}}
    completed = []
    with busy_machine(1), running(directory, COUNT, _LOSSES[over], options, station) as fleet:
        for number in range(flights):
            out = directory / f"out{number}"
            words = ["--config", str(fleet.config), "--slot-ms", "20", "--no-picture", "--out", str(out)]
            if fleet.radio is not None:
                words += ["--simulated-radio", str(fleet.radio)]
            result = dtsa("fly", "--backend", "cflib", *words, patience_s=_PATIENCE_S)
            said = result.stderr.strip()[-300:]
            met(result.returncode == 0, f"flight {number + 1}: exit code {result.returncode}: {said}")
            summary = json.loads((out / "summary.json").read_text())
            completed.append(summary["completion_time_s"])
    closest = closest_m(fleet.truth)
    met(closest >= CLOSEST_M, f"two came to {closest:.3f} m")
    return {**item.settings, "closest_m": round(closest, 3), "completion_s": completed}


def closest_m(path: Path) -> float:
    """The smallest distance of two that fly, by the record of what really happened, m."""
    _, positions, _ = read_truth(path)
    closest = np.inf
    for p in positions:
        flying = p[:, p[2] > FLYING_M]
        if flying.shape[1] > 1:
            gap = flying[:, :, None] - flying[:, None, :]
            distance = np.sqrt((gap * gap).sum(axis=0))
            closest = min(closest, float(distance[np.triu_indices(flying.shape[1], 1)].min()))
    return closest


def figures(rows: Sequence[Row]) -> dict[str, Any]:
    """By kind: missions that completed, smallest distance, completion times."""
    found: dict[str, Any] = {}
    kinds = sorted({(row["over"], row["arming"], row["flights"]) for row in rows})
    for over, arming, flights in kinds:
        mine = [row for row in rows if (row["over"], row["arming"], row["flights"]) == (over, arming, flights)]
        times = [time for row in mine for time in row["completion_s"]]
        name = f"missions over {over}, arming {arming}" + (f", {flights} in a row" if flights > 1 else "")
        found[name] = {
            "completed": sum(len(row["completion_s"]) for row in mine),
            "closest_m": min(row["closest_m"] for row in mine),
            "completion_s": [min(times), max(times)],
        }
    return found
