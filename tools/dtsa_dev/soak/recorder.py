"""The recorder killed at random moments: what it leaves is recovered and is what the protocol gives, up to its end."""

from __future__ import annotations

import random
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dtsa_bench.experiments.batch.task import Row
from dtsa_bench.recordings.bag.errors import UnusableBag
from dtsa_bench.recordings.bag.recover import Recovery, recover
from dtsa_bench.recordings.verify import verify_bag

from .flights import ENDLESS, Running, flying
from .item import Item, NotMet, Soak

_KILLS = 30
_LOST_S = 1.0  # s of wall time that may be lost at most
_POLL_S = 0.002
_FLIGHTS = (
    ("--agents", "6", "--processes", "2", "--policy", "lease", "--loss", "0.1"),
    ("--agents", "4", "--processes", "2", "--policy", "tdma", "--estimator", "hold"),
    ("--agents", "3", "--policy", "lease", "--moving", "2"),
    ("--agents", "5", "--processes", "1", "--policy", "aloha"),
)
_MODES = {"lockstep": (), "realtime": ("--mode", "realtime", "--slot-ms", "20")}


def _items() -> tuple[Item, ...]:
    return tuple(
        Item(f"{mode} {seed}", {"mode": mode}, seed, 20.0, sample=seed == 1)
        for seed in range(1, _KILLS + 1)
        for mode in _MODES
    )


def _run(item: Item, directory: Path) -> dict[str, Any]:
    pick = random.Random(f"{item.name} {item.seed}")
    words = (*_MODES[item.settings["mode"]], *_FLIGHTS[item.seed % len(_FLIGHTS)], "--seed", str(item.seed))
    with flying(directory, *words, *ENDLESS) as flight:
        growth = _watch(flight, pick.uniform(0.0, 5.0))
        flight.process.kill()
        killed_s = time.monotonic()
        flight.process.wait()
        flight.nobody_left()
    try:
        result = recover(flight.out / "bag")
    except UnusableBag as error:
        raise NotMet(f"nothing recovered: {error}") from None
    lost_s = killed_s - _saved_s(growth, result, flight.bag_bytes())
    verified = verify_bag(result.directory)
    if not verified.ok:
        raise NotMet(f"the recovered bag is not what the protocol gives: {verified.difference}")
    if not verified.broken_off:
        raise NotMet("the recovered bag does not say that it breaks off")
    if verified.slots < 1 and killed_s - growth[0][0] > _LOST_S:
        raise NotMet(f"no slot is saved of {killed_s - growth[0][0]:.2f} s")
    if lost_s > _LOST_S:
        raise NotMet(f"{lost_s:.2f} s of wall time are lost")
    return {"mode": item.settings["mode"], "slots": verified.slots, "lost_s": round(lost_s, 3)}


def _watch(flight: Running, seconds: float) -> list[tuple[float, int]]:
    """When the file that is recorded grew, and to which size, until the moment of the kill."""
    end = time.monotonic() + seconds
    growth = [(time.monotonic(), flight.bag_bytes())]
    while time.monotonic() < end:
        size = flight.bag_bytes()
        if size != growth[-1][1]:
            growth.append((time.monotonic(), size))
        time.sleep(_POLL_S)
    return growth


def _saved_s(growth: list[tuple[float, int]], result: Recovery, size: int) -> float:
    """Wall time up to which everything is saved: that of the last growth whose chunk is whole."""
    torn = any("cut off" in note for note in result.damaged)
    whole = [when for when, to in growth if not torn or to < size]
    return whole[-1] if whole else growth[0][0]


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for mode in _MODES:
        lost = [row["summary"]["lost_s"] for row in rows if row["summary"]["mode"] == mode]
        found[mode] = {"kills": len(lost), "largest_loss_s": max(lost, default=None)}
    return found


SOAK = Soak(
    "recorder",
    "What a recorder killed with SIGKILL leaves is recovered and verified up to its end; at most one second is lost.",
    _items(),
    _run,
    _figures,
)
