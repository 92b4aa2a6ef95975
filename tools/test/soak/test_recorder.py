"""Integration: a recorder killed at a random moment leaves a bag that is recovered; it loses one second at most."""

from __future__ import annotations

import random
import time
from pathlib import Path
from typing import Any

import pytest
from fly_helpers import ENDLESS, FlightProcess, start_flight

from dtsa_bench.log.bag.recover import Recovery, recover
from dtsa_bench.log.verify.check import verify_bag

pytestmark = [pytest.mark.ros, pytest.mark.soak]
LOST_S = 1.0  # s of wall time that may be lost at most
FLIGHTS = (
    ("--agents", "6", "--processes", "2", "--policy", "lease", "--loss", "0.1"),
    ("--agents", "4", "--processes", "2", "--policy", "tdma", "--estimator", "hold"),
    ("--agents", "3", "--policy", "lease", "--moving", "2"),
    ("--agents", "5", "--processes", "1", "--policy", "aloha"),
)
MODES = {"lockstep": (), "realtime": ("--mode", "realtime", "--slot-ms", "20")}
SEEDS = [pytest.param(seed, marks=[pytest.mark.sample] * (seed == 1)) for seed in range(1, 31)]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("mode", MODES)
def test_killed_recorder(mode: str, seed: int, tmp_path: Path, record: list[dict[str, Any]]) -> None:
    pytest.importorskip("dtsa_msgs.msg")
    pick = random.Random(f"{mode} {seed}")
    words = (*MODES[mode], *FLIGHTS[seed % len(FLIGHTS)], "--seed", str(seed))
    with start_flight(tmp_path, *words, *ENDLESS) as flight:
        growth = _watch_file(flight, pick.uniform(0.0, 5.0))
        flight.process.kill()
        killed_s = time.monotonic()
        flight.process.wait()
        flight.assert_no_process_left()
    result = recover(flight.out / "bag")
    lost_s = killed_s - _saved_s(growth, result, flight.bag_bytes())
    verified = verify_bag(result.directory)
    assert verified.ok, verified.difference
    assert verified.broken_off
    assert verified.slots or killed_s - growth[0][0] <= LOST_S
    assert lost_s <= LOST_S
    record.append({"mode": mode, "lost_s": lost_s})


def _watch_file(flight: FlightProcess, seconds: float) -> list[tuple[float, int]]:
    """When the file that is recorded grew, and to which size, until the moment of the kill."""
    end = time.monotonic() + seconds
    growth = [(time.monotonic(), flight.bag_bytes())]
    while time.monotonic() < end:
        size = flight.bag_bytes()
        if size != growth[-1][1]:
            growth.append((time.monotonic(), size))
        time.sleep(0.002)
    return growth


def _saved_s(growth: list[tuple[float, int]], result: Recovery, size: int) -> float:
    """Wall time up to which everything is saved: that of the last growth whose chunk is whole."""
    torn = any("cut off" in note for note in result.damaged)
    whole = [when for when, to in growth if not torn or to < size]
    return whole[-1] if whole else growth[0][0]


def summarise(found: list[dict[str, Any]]) -> tuple[list[str], list[list[object]]]:
    lost = {mode: [row["lost_s"] for row in found if row["mode"] == mode] for mode in MODES}
    rows: list[list[object]] = [[mode, len(times), f"{max(times):.2f} s"] for mode, times in lost.items()]
    return ["mode", "kills", "lost at most"], rows
