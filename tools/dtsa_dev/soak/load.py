"""Flights on a machine that has far too much to do: they end by themselves, and Ctrl-C ends them soon at any moment."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dtsa_bench.experiments.batch.task import Row

from .checks import clean_end, summary
from .flights import ENDLESS, flying, until
from .item import Item, NotMet, Soak

_BUSY = 6  # loops
_SIGNALS = 10  # for each number of agents
_ENDS_S = 2.0
_AGENTS = (12, 18)
_BY_ITSELF_S = 120.0
_LOOP = "import ctypes; ctypes.CDLL(None).prctl(1, 9)\nwhile True: pass"  # killed with the process that started it


def _items() -> Iterator[Item]:
    for agents in _AGENTS:
        yield Item(f"{agents} agents end by themselves", {"agents": agents, "signal": False}, 1, 60.0)
        for seed in range(1, _SIGNALS + 1):
            settings = {"agents": agents, "signal": True}
            yield Item(f"{agents} agents, Ctrl-C {seed}", settings, seed, 40.0, sample=seed == 1 and agents == 12)


@contextmanager
def busy_machine(loops: int = _BUSY) -> Iterator[None]:
    """Loops that want all the processor time there is.

    :param loops: how many.
    """
    with_loops = [subprocess.Popen([sys.executable, "-c", _LOOP], start_new_session=True) for _ in range(loops)]
    try:
        yield
    finally:
        for process in with_loops:
            process.kill()
            process.wait()


def _run(item: Item, directory: Path) -> dict[str, Any]:
    words = ("--mode", "realtime", "--policy", "lease", "--agents", str(item.settings["agents"]), "--slot-ms", "10")
    with busy_machine():
        if not item.settings["signal"]:
            return _by_itself(directory, words)
        return _interrupted(directory, words, random.Random(f"{item.name}").uniform(0.0, 8.0))


def _by_itself(directory: Path, words: tuple[str, ...]) -> dict[str, Any]:
    with flying(directory, *words, "--timeout-s", "3", "--no-picture", begun=False) as flight:
        begin = time.monotonic()
        flight.end(_BY_ITSELF_S)
        took = time.monotonic() - begin
        flight.nobody_left()
        if "Traceback" in flight.said():
            raise NotMet(f"a traceback: {flight.said().strip()[-300:]}")
        return {"wall_s": round(took, 1), "end": summary(flight)["end"]}


def _interrupted(directory: Path, words: tuple[str, ...], after_s: float) -> dict[str, Any]:
    with flying(directory, *words, *ENDLESS, "--timeout-s", "3600", begun=False) as flight:
        until(lambda: flight.out.exists() or flight.process.poll() is not None, "the flight is under way")
        time.sleep(after_s)
        if flight.process.poll() is not None:
            raise NotMet(f"the flight has ended before the signal: {flight.said().strip()[-300:]}")
        begin = time.monotonic()
        os.kill(flight.process.pid, signal.SIGINT)
        clean_end(flight, 130)
        took = time.monotonic() - begin
        if took > _ENDS_S:
            raise NotMet(f"Ctrl-C after {after_s:.1f} s ends it in {took:.1f} s")
        return {"after_s": round(after_s, 2), "ended_s": round(took, 2)}


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    found = [row["summary"] for row in rows]
    ended = [one["ended_s"] for one in found if "ended_s" in one]
    by_itself = {row["item"]: row["summary"] for row in rows if "end" in row["summary"]}
    return {"signals": len(ended), "slowest_end_s": max(ended, default=None), "by itself": by_itself}


SOAK = Soak(
    "load",
    "With six busy loops, flights of 12 and 18 agents at 10 ms end by themselves, and by Ctrl-C within two seconds.",
    tuple(_items()),
    _run,
    _figures,
)
