"""Missions of twelve with four random faults each: who flies keeps apart, and motors stop only where they may."""

from __future__ import annotations

import random
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_bench.crazyflies.simulated.truth import read_truth
from dtsa_bench.experiments.batch.task import Row
from dtsa_dev.soak.checks import met
from dtsa_dev.soak.flights import flying
from dtsa_dev.soak.item import Item

from .cuts import wait_for_events
from .fleets import RunningFleet, running
from .gaps import LOW_M, SURVIVED_S
from .missions import COUNT, FLYING_M

MISSIONS = 15
EACH = 4  # faults, of so many vehicles
CLOSEST_M = 0.2
FIRST_S = 11.0  # the first one, after the take-off's begin: a mission takes about 12 s to its landing
MORE_S = 5.0  # the others, after it: it ends the exchange, and all come to rest and land
KINDS = ("silence", "loss", "bounce", "battery", "estimate jumps", "estimate freezes", "tumbles")
_PATIENCE_S = 180.0
_OFF = ("locked", "crashed")


@dataclass(frozen=True, slots=True)
class Fault:
    """What happens to one vehicle.

    :param after_s: s, from the take-off's begin.
    :param kind: one of KINDS.
    :param request: what the simulated Crazyflies are told.
    """

    cf: int
    after_s: float
    kind: str
    request: dict[str, Any]

    @property
    def may_stop(self) -> bool:
        """Whether its motors may stop in the air: it turned over, or was silent for too long."""
        deaf = self.kind in ("silence", "bounce") or self.request.get("direction") in ("up", "both")
        return self.kind == "tumbles" or (deaf and self.request["seconds"] >= SURVIVED_S)


def faults_of(seed: int) -> list[Fault]:
    """Faults at random, in the order of time."""
    chance = random.Random(f"faults {seed}")
    first = chance.uniform(0.2, FIRST_S)
    found = [
        _fault(chance, cf, KINDS[(EACH * (seed - 1) + k) % len(KINDS)], first + k * chance.uniform(0.0, MORE_S / EACH))
        for k, cf in enumerate(chance.sample(range(1, COUNT + 1), EACH))
    ]
    return sorted(found, key=lambda fault: fault.after_s)


def _fault(chance: random.Random, cf: int, kind: str, after_s: float) -> Fault:
    seconds = round(chance.uniform(0.1, 3.0), 2)
    sign = chance.choice((-1.0, 1.0))
    rate = round(chance.uniform(0.3, 0.95), 2)
    direction = chance.choice(("up", "down", "both"))
    request: dict[str, Any] = {
        "silence": {"name": "freeze", "seconds": seconds},
        "loss": {"name": "drop", "rate": rate, "direction": direction, "seconds": seconds},
        "bounce": {"name": "close", "seconds": seconds},
        "battery": {"name": "battery", "voltage": 3.0},
        "estimate jumps": {"name": "estimate_jump", "distance": 2.0 * sign},
        "estimate freezes": {"name": "estimate_freeze"},
        "tumbles": {"name": "tumble"},
    }[kind]
    return Fault(cf, round(after_s, 2), kind, request)


def items() -> Iterator[Item]:
    """Fifteen missions: sixty faults."""
    for seed in range(1, MISSIONS + 1):
        yield Item(f"a mission with {EACH} random faults, {seed}", {"part": "fault"}, seed, 32.0)


def run(item: Item, directory: Path) -> dict[str, Any]:
    """Fly.

    :raises NotMet: two whose motors run come too close, or motors stop in the air that should not.
    """
    faults = faults_of(item.seed)
    station: dict[str, Any] = {"toc_cache": str(directory / "cache")}
    with running(directory, COUNT, None, ["--arming", "mixed", "--seed", str(item.seed)], station) as fleet:
        words = ("--backend", "cflib", "--config", str(fleet.config), "--slot-ms", "20", "--no-picture")
        with flying(directory / "mission", *words, "--seed", str(item.seed), begun=False) as flight:
            wait_for_events(fleet.truth, '"takeoff"', COUNT)
            begin, given = time.monotonic(), []
            for fault in faults:
                time.sleep(max(0.0, begin + fault.after_s - time.monotonic()))
                given.append(fleet.fault(cf=fault.cf, **fault.request))
            code = flight.end(_PATIENCE_S)
            said = flight.said().strip()
        met(code in (0, 1) and "Traceback" not in said, f"exit code {code}: {said[-300:]}")
    times, positions, _ = read_truth(fleet.truth)
    met(positions[times >= given[0], 2].max() > FLYING_M, f"it was over before the first fault: {said[-300:]}")
    off = stopped_in_air(fleet)
    closest = closest_with_motors_m(fleet.truth, off)
    told = ", ".join(f"cf{fault.cf} {fault.kind} {fault.request} at {fault.after_s} s" for fault in faults)
    allowed = {fault.cf for fault in faults if fault.may_stop}
    wrong = {f"cf{cf}": reason for cf, (_, reason) in off.items() if cf not in allowed}
    met(not wrong, f"motors stopped in the air: {wrong}; faults: {told}")
    met(closest >= CLOSEST_M, f"two came to {closest:.3f} m; faults: {told}")
    reasons = {f"cf{cf}": reason for cf, (_, reason) in off.items()}
    done = [{"cf": fault.cf, "after_s": fault.after_s, "kind": fault.kind, **fault.request} for fault in faults]
    return {**item.settings, "faults": done, "closest_m": round(closest, 3), "stopped": reasons, "code": code}


def stopped_in_air(fleet: RunningFleet) -> dict[int, tuple[float, str]]:
    """Whose motors stopped in the air: when (s), and why."""
    times, positions, events = read_truth(fleet.truth)
    found: dict[int, tuple[float, str]] = {}
    for event in events:
        if event["event"] == "state" and event["state"] in _OFF and event["cf"] not in found:
            height = positions[min(int(times.searchsorted(event["t"])), len(times) - 1), 2, event["cf"] - 1]
            if height > LOW_M:
                found[event["cf"]] = event["t"], str(event.get("reason", ""))
    return found


def closest_with_motors_m(truth: Path, off: dict[int, tuple[float, str]]) -> float:
    """Smallest distance (m) of two in the air whose motors have not been stopped, by the truth.

    :param off: whose motors stopped: when (s), and why.
    """
    times, positions, _ = read_truth(truth)
    closest = np.inf
    until = np.array([off.get(cf, (np.inf, ""))[0] for cf in range(1, positions.shape[2] + 1)])
    for t, place in zip(times, positions, strict=True):
        high = place[:, (place[2] > FLYING_M) & (t < until)]
        if high.shape[1] > 1:
            gap = np.linalg.norm(high[:, :, None] - high[:, None, :], axis=0)
            closest = min(closest, float(gap[np.triu_indices(high.shape[1], 1)].min()))
    return closest


def figures(rows: Sequence[Row]) -> dict[str, Any]:
    """How many of each kind, the smallest distance, and why motors stopped in the air."""
    if not rows:
        return {}
    kinds = [fault["kind"] for row in rows for fault in row["faults"]]
    reasons = [reason for row in rows for reason in row["stopped"].values()]
    return {
        "random faults": {
            "missions": len(rows),
            "faults": {kind: kinds.count(kind) for kind in KINDS},
            "closest_m": min(row["closest_m"] for row in rows),
            "motors stopped in the air": {reason: reasons.count(reason) for reason in sorted(set(reasons))},
        }
    }
