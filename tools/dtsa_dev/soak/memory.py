"""Memory of every process of long flights: it does not grow after the first minute."""

from __future__ import annotations

import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dtsa_bench.experiments.batch.task import Row

from .flights import ENDLESS, Running, alive, children, flying
from .item import Item, NotMet, Soak

_WARM_S = 60.0  # s: what grows until then is start-up
_GROWTH_KB = 5_000
_EVERY_S = 10.0
_MODES = {"lockstep": (), "realtime": ("--mode", "realtime", "--slot-ms", "20")}
_SWARM = (
    "--agents", "12", "--moving", "12", "--processes", "2", "--scenario", "waypoints", "--stops", "100",
    "--policy", "lease", "--loss", "0.1", "--axis-x-m", "8", "--no-stop-on-crash",
)  # fmt: skip
_LONG = ("--pause-slots", "100000", "--timeout-s", "86400", *ENDLESS)  # not complete within an hour

_ITEMS = (
    Item("lockstep, two minutes", {"mode": "lockstep", "seconds": 120.0}, 2, 140.0, sample=True),
    Item("real time, ten minutes", {"mode": "realtime", "seconds": 600.0}, 1, 620.0),
    Item("lockstep, an hour", {"mode": "lockstep", "seconds": 3600.0}, 1, 3620.0),
)


def own_memory_kb(pid: int) -> int:
    """Memory that belongs to a process alone, in RAM or swapped out, kB; pages of files and shared memory do not count.

    :param pid: the process.
    """
    total = 0
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines():
        if line.startswith(("Private_Dirty:", "Swap:")):
            total += int(line.split()[1])
    return total


def _run(item: Item, directory: Path) -> dict[str, Any]:
    seconds = float(item.settings["seconds"])
    with flying(directory, *_MODES[item.settings["mode"]], *_SWARM, *_LONG, "--seed", str(item.seed)) as flight:
        samples = _watch(flight, seconds)
        flight.process.send_signal(signal.SIGINT)
        flight.end()
        flight.nobody_left()
    growth = {name: _growth_kb(kept) for name, kept in samples.items()}
    worst = max(growth, key=lambda name: growth[name])
    if growth[worst] > _GROWTH_KB:
        raise NotMet(f"{worst} has grown by {growth[worst]} kB in {seconds:g} s: {_course(samples[worst])}")
    return {
        "mode": item.settings["mode"],
        "seconds": seconds,
        "growth_kb": growth,
        "first_kb": {name: _after_start(kept)[0] for name, kept in samples.items()},
    }


def _watch(flight: Running, seconds: float) -> dict[str, list[tuple[float, int]]]:
    """Memory of each process by time since the flight has begun."""
    begin = time.monotonic()
    processes = {"channel and recorder": flight.process.pid}
    processes |= {f"agents {number}": pid for number, pid in enumerate(children(flight.process.pid), 1)}
    samples: dict[str, list[tuple[float, int]]] = {name: [] for name in processes}
    while (now := time.monotonic() - begin) < seconds:
        for name, pid in processes.items():
            if not alive(pid):
                raise NotMet(f"{name} has ended after {now:.0f} s: {flight.said().strip()[-300:]}")
            samples[name].append((now, own_memory_kb(pid)))
        time.sleep(_EVERY_S)
    return samples


def _after_start(samples: list[tuple[float, int]]) -> list[int]:
    return [kb for when, kb in samples if when >= _WARM_S] or [kb for _, kb in samples]


def _growth_kb(samples: list[tuple[float, int]]) -> int:
    """The largest size after the first minute beyond the first one of that time."""
    later = _after_start(samples)
    return max(later) - later[0]


def _course(samples: list[tuple[float, int]]) -> str:
    step = max(1, len(samples) // 8)
    return ", ".join(f"{kb} kB at {when:.0f} s" for when, kb in samples[::step])


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    return {row["item"]: {name: row["summary"][name] for name in ("growth_kb", "first_kb")} for row in rows}


SOAK = Soak(
    "memory",
    "No process of an hour in lockstep or of ten minutes in real time grows by 5 MB after its first minute.",
    _ITEMS,
    _run,
    _figures,
)
