"""Integration: missions of twelve simulated Crazyflies complete with code 0, none nearer than 0.25 m to another, over
UDP and over radios that lose packets, one core busy; with random faults none whose motors run comes nearer than 0.2 m.
"""

from __future__ import annotations

import json
import math
import random
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from fly_helpers import PATIENCE_S, run_dtsa, start_flight
from waiting import wait_for

from dtsa_bench.crazyflies.simulated.process import free_base_port, running_fleet, send_fault
from dtsa_bench.crazyflies.simulated.truth import read_truth

pytestmark = [pytest.mark.ros, pytest.mark.soak, pytest.mark.timeout(900)]
COUNT = 12
CHANNELS = (20, 50, 80)  # one a dongle
CLOSEST_M, CLOSEST_WITH_FAULTS_M = 0.25, 0.2
FLYING_M = 0.1  # above the floor
LOSSES: dict[str, float | None] = {"udp": None, "radio, 1 % lost": 0.01, "radio, 5 % lost": 0.05}
FAULTS_EACH = 4  # of so many vehicles
FIRST_S = 11.0  # the first fault, after the take-off's begin: a mission takes about 12 s to its landing
MORE_S = 5.0  # the others, after it: it ends the exchange, and all come to rest and land
SURVIVED_S = 0.75  # a gap of the link after which the motors still run
KINDS = ("silence", "loss", "bounce", "battery", "estimate jumps", "estimate freezes", "tumbles")
LOOP = "import ctypes; ctypes.CDLL(None).prctl(1, 9)\nwhile True: pass"  # killed with the process that started it


@dataclass(frozen=True, slots=True)
class RunningFleet:
    words: tuple[str, ...]  # options of `fly` that reach them
    truth: Path
    control: int  # UDP port

    def fault(self, name: str, cf: int, **numbers: Any) -> float:
        return float(send_fault(("127.0.0.1", self.control), fault=name, cf=cf, **numbers)["t"])


@contextmanager
def fleet_of_twelve(directory: Path, loss: float | None, *options: str, **station: Any) -> Iterator[RunningFleet]:
    """Simulated Crazyflies on the ellipse of the paper's room, over three dongles or UDP (loss: None)."""
    base = free_base_port(COUNT)
    robots = {}
    for k in range(COUNT):
        dongle, angle = k * len(CHANNELS) // COUNT, 2 * math.pi * k / COUNT
        over = f"radio://{dongle}/{CHANNELS[dongle]}/2M/E7E7E7E7{k + 1:02X}"
        robots[f"cf{k + 1}"] = {
            "uri": f"udp://127.0.0.1:{base + k}" if loss is None else over,
            "initial_position": [round(1.2 * math.cos(angle), 3), round(2.0 * math.sin(angle), 3), 0.0],
        }
    station = {"toc_cache": str(directory / "cache"), **station}
    data = {"robots": robots, "all": {"command_rate_hz": 50, "log_rate_hz": 50}, "station": station}
    config, truth, radio = directory / "swarm.yaml", directory / "truth.jsonl", directory / "radio"
    config.write_text(yaml.safe_dump(data), encoding="utf-8")
    flown = ("--backend", "cflib", "--config", str(config), "--slot-ms", "20", "--no-picture")
    words = ["--config", str(config), "--truth", str(truth), *options]
    if loss is not None:
        words += ["--base-port", str(base), "--simulated-radio", str(radio), "--radio-loss", str(loss)]
        flown = (*flown, "--simulated-radio", str(radio))
    with running_fleet(words):
        yield RunningFleet(flown, truth, base - 1)


MISSIONS = [
    *((over, arming, 1) for over in LOSSES for arming in ("auto", "required")), ("radio, 1 % lost", "mixed", 3),
]  # fmt: skip


@pytest.mark.parametrize("seed", range(1, 6))
@pytest.mark.parametrize(("over", "arming", "flights"), MISSIONS)
def test_mission(over: str, arming: str, flights: int, seed: int, tmp_path: Path, record: list[dict[str, Any]]) -> None:
    pytest.importorskip("cflib")
    options = ["--arming", arming, "--seed", str(seed), "--radio-seed", str(seed)]
    # Missions that follow each other without a restart of the Crazyflies must not be locked by the first one's end.
    station: dict[str, Any] = {"safety": {"emergency_watchdog": flights == 1}}
    times = []
    loop = subprocess.Popen([sys.executable, "-c", LOOP], start_new_session=True)
    try:
        with fleet_of_twelve(tmp_path, LOSSES[over], *options, **station) as fleet:
            for number in range(flights):
                done = run_dtsa("fly", *fleet.words, "--out", str(tmp_path / f"out{number}"))
                assert done.returncode == 0, done.stderr[-300:]
                summary = json.loads((tmp_path / f"out{number}" / "summary.json").read_text())
                times.append(summary["completion_time_s"])
        closest = closest_m(fleet.truth, {})
    finally:
        loop.kill()
        loop.wait()
    assert closest >= CLOSEST_M
    record.append({"what": f"{over}{', three in a row' * (flights > 1)}", "times_s": times, "closest_m": closest})


@dataclass(frozen=True, slots=True)
class VehicleFault:
    """A fault of one vehicle, s after the take-off's begin; ``request`` is what the simulation is asked for."""

    cf: int
    after_s: float
    kind: str
    request: dict[str, Any]

    @property
    def may_stop(self) -> bool:
        """Whether its motors may stop in the air: it turned over, or was silent for too long."""
        deaf = self.kind in ("silence", "bounce") or self.request.get("direction") in ("up", "both")
        return self.kind == "tumbles" or (deaf and self.request["seconds"] >= SURVIVED_S)


def random_faults(seed: int) -> list[VehicleFault]:
    chance = random.Random(f"faults {seed}")
    first = chance.uniform(0.2, FIRST_S)
    faults = []
    for k, cf in enumerate(chance.sample(range(1, COUNT + 1), FAULTS_EACH)):
        kind = KINDS[(FAULTS_EACH * (seed - 1) + k) % len(KINDS)]
        after_s = first + k * chance.uniform(0.0, MORE_S / FAULTS_EACH)
        seconds = round(chance.uniform(0.1, 3.0), 2)
        sign = chance.choice((-1.0, 1.0))
        rate = round(chance.uniform(0.3, 0.95), 2)
        direction = chance.choice(("up", "down", "both"))
        request: dict[str, Any] = {
            "silence": {"name": "freeze", "seconds": seconds},
            "loss": {"name": "drop", "rate": rate, "direction": direction, "seconds": seconds},
            "bounce": {"name": "close", "seconds": seconds}, "battery": {"name": "battery", "voltage": 3.0},
            "estimate jumps": {"name": "estimate_jump", "distance": 2.0 * sign},
            "estimate freezes": {"name": "estimate_freeze"}, "tumbles": {"name": "tumble"},
        }[kind]  # fmt: skip
        faults.append(VehicleFault(cf, round(after_s, 2), kind, request))
    return sorted(faults, key=lambda fault: fault.after_s)


@pytest.mark.parametrize("seed", range(1, 16))
def test_random_faults(seed: int, tmp_path: Path, record: list[dict[str, Any]]) -> None:
    pytest.importorskip("cflib")
    faults = random_faults(seed)
    with fleet_of_twelve(tmp_path, None, "--arming", "mixed", "--seed", str(seed)) as fleet:
        with start_flight(tmp_path / "mission", *fleet.words, "--seed", str(seed), begun=False) as flight:
            wait_for(lambda: fleet.truth.read_text(encoding="utf-8").count('"takeoff"') >= COUNT, PATIENCE_S)
            begin, given = time.monotonic(), []
            for fault in faults:
                time.sleep(max(0.0, begin + fault.after_s - time.monotonic()))
                given.append(fleet.fault(cf=fault.cf, **fault.request))
            code, text = flight.end(), flight.stderr()
        assert code in (0, 1), text[-300:]
        assert "Traceback" not in text, text[-300:]
    times, positions, events = read_truth(fleet.truth)
    assert positions[times >= given[0], 2].max() > FLYING_M, "it was over before the first fault"
    stopped: dict[int, float] = {}  # vehicles whose motors stopped in the air, and when, s
    for event in events:
        if event["event"] == "state" and event["state"] in ("locked", "crashed") and event["cf"] not in stopped:
            height = positions[min(int(times.searchsorted(event["t"])), len(times) - 1), 2, event["cf"] - 1]
            if height > FLYING_M:
                stopped[event["cf"]] = event["t"]
    assert stopped.keys() <= {fault.cf for fault in faults if fault.may_stop}, faults
    closest = closest_m(fleet.truth, stopped)
    assert closest >= CLOSEST_WITH_FAULTS_M, faults
    record.append({"what": f"{FAULTS_EACH} random faults each", "times_s": [], "closest_m": closest})


def closest_m(truth: Path, stopped: dict[int, float]) -> float:
    """The smallest distance of two that fly with running motors, by the record of what really happened, m."""
    times, positions, _ = read_truth(truth)
    until = np.array([stopped.get(cf, np.inf) for cf in range(1, positions.shape[2] + 1)])
    closest = np.inf
    for t, place in zip(times, positions, strict=True):
        flying = place[:, (place[2] > FLYING_M) & (t < until)]
        if flying.shape[1] > 1:
            gaps = np.linalg.norm(flying[:, :, None] - flying[:, None, :], axis=0)
            closest = min(closest, float(gaps[np.triu_indices(flying.shape[1], 1)].min()))
    return closest


def summarise(found: list[dict[str, Any]]) -> tuple[list[str], list[list[object]]]:
    rows: list[list[object]] = []
    for what in dict.fromkeys(row["what"] for row in found):
        mine = [row for row in found if row["what"] == what]
        times = [time_s for row in mine for time_s in row["times_s"]]
        span = f"{min(times):.1f} to {max(times):.1f} s" if times else ""
        rows.append([what, len(times) or len(mine), span, f"{min(row['closest_m'] for row in mine):.2f} m"])
    return ["missions of twelve", "flown", "completed in", "closest pair"], rows
