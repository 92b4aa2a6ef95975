"""Missions of twelve that are cut short while all change places: those that fly keep apart until they stand."""

from __future__ import annotations

import random
import signal
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_bench.crazyflies.simulated.truth import read_truth
from dtsa_bench.experiments.batch.task import Row
from dtsa_dev.soak.checks import met
from dtsa_dev.soak.flights import flying
from dtsa_dev.soak.item import Item, NotMet

from .fleets import running
from .missions import CLOSEST_M, COUNT, FLYING_M

EACH = 5
BEGIN_S, END_S = 0.5, 1.8  # of the exchange, in which they meet in the middle
CTRL_C, BATTERY, LOST = "Ctrl-C", "a low battery", "a lost link"
CODES = {CTRL_C: 130, BATTERY: 1, LOST: 1}
_PATIENCE_S = 180.0


def items() -> Iterator[Item]:
    """Five of each way to end."""
    for seed in range(1, EACH + 1):
        for way in CODES:
            yield Item(f"a mission cut short by {way}, {seed}", {"part": "cut", "by": way}, seed, 40.0)


def run(item: Item, directory: Path) -> dict[str, Any]:
    """Fly, and cut it short.

    :raises NotMet: two that fly come too close, or the exit code is another one.
    """
    way, chance = str(item.settings["by"]), random.Random(f"{item.seed} {item.settings['by']}")
    station: dict[str, Any] = {"toc_cache": str(directory / "cache")}
    options = ["--arming", "auto", "--seed", str(item.seed)]
    victim = chance.randint(1, COUNT)
    with running(directory, COUNT, None, options, station) as fleet:
        words = ("--backend", "cflib", "--config", str(fleet.config), "--slot-ms", "20", "--no-picture")
        with flying(directory / "mission", *words, "--seed", str(item.seed), begun=False) as flight:
            wait_for_events(fleet.truth, '"streaming"', COUNT)  # the exchange begins
            time.sleep(chance.uniform(BEGIN_S, END_S))
            if way == CTRL_C:
                when = fleet.fault("heal")
                flight.process.send_signal(signal.SIGINT)
            elif way == BATTERY:
                when = fleet.fault("battery", victim, voltage=3.0)
            else:
                when = fleet.fault("freeze", victim)
            code = flight.end(_PATIENCE_S)
            said = flight.said().strip()[-300:]
            met(code == CODES[way], f"exit code {code}: {said}")
    others = [k for k in range(COUNT) if way != LOST or k != victim - 1]
    before, after = _closest(fleet.truth, others, when)
    met(np.isfinite(after), f"it was over before it was cut short: {said}")
    met(after >= CLOSEST_M, f"two that fly came to {after:.3f} m after it was cut short (before: {before:.3f} m)")
    return {**item.settings, "closest_before_m": round(before, 3), "closest_after_m": round(after, 3)}


def wait_for_events(truth: Path, name: str, count: int) -> None:
    """Wait until something has happened often enough.

    :param truth: the record of what really happens.
    :param name: the event's name, as JSON.
    :param count: so often.
    :raises NotMet: it does not happen.
    """
    found, end = 0, time.monotonic() + _PATIENCE_S
    with truth.open(encoding="utf-8") as lines:
        while found < count:
            line = lines.readline()
            found += name in line
            if not line:
                if time.monotonic() > end:
                    raise NotMet(f"only {found} of {count} {name} within {_PATIENCE_S:g} s")
                time.sleep(0.01)


def _closest(truth: Path, others: Sequence[int], when: float) -> tuple[float, float]:
    """Smallest distance (m) of two that fly, by the truth, before and after a time (s).

    :param others: indices of those that count.
    """
    times, places, _ = read_truth(truth)
    found = [np.inf, np.inf]
    for t, place in zip(times, places, strict=True):
        high = [k for k in others if place[2, k] > FLYING_M]
        if len(high) > 1:
            p = place[:, high]
            gap = np.linalg.norm(p[:, :, None] - p[:, None, :], axis=0)
            late = int(t >= when)
            found[late] = min(found[late], float(gap[np.triu_indices(len(high), 1)].min()))
    return found[0], found[1]


def figures(rows: Sequence[Row]) -> dict[str, Any]:
    """By what cut them short: missions, and the smallest distance before and after."""
    found: dict[str, Any] = {}
    for way in CODES:
        mine = [row for row in rows if row["by"] == way]
        if mine:
            found[f"missions cut short by {way}"] = {
                "missions": len(mine),
                "closest_before_m": min(row["closest_before_m"] for row in mine),
                "closest_after_m": min(row["closest_after_m"] for row in mine),
            }
    return found
