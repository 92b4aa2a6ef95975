"""Agents on hosts of their own over a switch that is the medium: cold starts, losses, drifts, kills, partitions."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from dtsa_agent.core import SwarmConfig
from dtsa_bench.air.merge import verified
from dtsa_bench.air.trial import Flight, NotFlown, Trial, fly
from dtsa_bench.batch.task import Row
from dtsa_bench.run_config import RunConfig, RunLimits, from_swarm
from dtsa_bench.simulate import simulate
from dtsa_channel_sim import ChannelConfig

from .item import Item, NotMet, Soak

AGENTS = 12
_OVERLAP = 0.001  # of slots
_SECONDS = 12.0
_FAULT_S = 3.0
FAULTS = ("kill", "freeze", "partition", "jam", "stall")


def _items() -> Iterator[Item]:
    seed = 0
    for slot_ms in (10.0, 5.0):
        for loss in (0.0, 0.05, 0.2):
            for strict in (True, False):
                seed += 1
                settings = {"slot_ms": slot_ms, "loss": loss, "strict": strict}
                name = f"{slot_ms:g} ms, {loss:.0%} lost, {'no shortcuts' if strict else 'default'}"
                yield Item(name, settings, seed, 25.0, sample=(slot_ms, loss, strict) == (10.0, 0.05, True))
    for number, fault in enumerate(FAULTS, seed + 1):
        settings = {"slot_ms": 10.0, "loss": 0.05, "strict": False, "fault": fault}
        yield Item(fault, settings, number, 30.0, sample=fault == "kill")


def _disturbed(flight: Flight, fault: str) -> None:
    if fault == "kill":
        flight.signal(2, signal.SIGKILL)
        flight.carry(1.0)
        flight.start(2)
        flight.carry(_FAULT_S)
    elif fault == "freeze":
        flight.signal(2, signal.SIGSTOP)
        flight.carry(_FAULT_S)
        flight.signal(2, signal.SIGCONT)
    elif fault == "stall":
        time.sleep(1.0)
    else:
        half = AGENTS // 2
        flight.switch.set(**({"jam": True} if fault == "jam" else {"partition": f"1-{half} | {half + 1}-{AGENTS}"}))
        flight.carry(_FAULT_S)
        flight.switch.set(**({"jam": False} if fault == "jam" else {"partition": ""}))


def _run(item: Item, directory: Path) -> dict[str, Any]:
    fault = item.settings.get("fault", "")
    shortcuts = {"open_every": 0, "adoption": False} if item.settings["strict"] else {}
    swarm = SwarmConfig(
        agents=AGENTS, policy="lease", slot_ms=item.settings["slot_ms"], scenario="waypoints", stops=20, pause_slots=0,
        auth=True, auth_session=item.seed, seed=item.seed, **shortcuts,
    )  # fmt: skip
    loss = item.settings["loss"]
    trial = Trial(swarm, {"loss": loss}, seconds=_SECONDS, seed=item.seed)
    try:
        found = fly(trial, directory, (lambda flight: _disturbed(flight, fault)) if fault else None)
    except NotFlown as error:
        raise NotMet(str(error)) from error
    if not verified(found):
        raise NotMet(f"the bags do not verify: {found['decisions_again']}, {found['frames_heard_not_as_sent']} frames")
    flown, air = found["flight"], found["switch"]
    if flown is None:
        raise NotMet("they never counted alike")
    if flown["collided"] and not fault:
        raise NotMet(f"a crash: {flown['collided_pair']}")
    limit = 0.0 if item.settings["strict"] else _OVERLAP
    if not fault and air["overlap_share"] > limit:
        raise NotMet(f"frames overlapped in {air['overlap_share']:.2%} of {air['slots']} slots")
    again = _simulated(swarm, loss, flown["flight_time_s"])
    return {
        "fault": fault,
        **{name: item.settings[name] for name in ("slot_ms", "loss", "strict")},
        "common_after_last_start_s": found["common_after_last_start_s"],
        "clock_spread_ms": found["clock_spread_ms"],
        "residual_us": found["time_line"]["residual_us"],
        "frames": [found["frames_sent"], found["frames_unsent"]],
        "overlap_slots": air["overlap_slots"],
        "slots": air["slots"],
        "decisions_again": found["decisions_again"]["equal"],
        "collided": flown["collided"],
        "min_distance_m": flown["min_distance_m"],
        "agreement_share": flown["agreement_share"],
        "age_mean_slots": [flown["age_mean_slots"], again["age_mean_slots"]],
        "estimate_error_mean_m": [flown["estimate_error_mean_m"], again["estimate_error_mean_m"]],
    }


def _simulated(swarm: SwarmConfig, loss: float, seconds: float) -> dict[str, Any]:
    """The same flight in the simulator."""
    limits = RunLimits(timeout_s=max(1.0, seconds), tail_s=3600.0, stop_on_crash=False)
    config = SwarmConfig.from_dict({**swarm.to_dict(), "auth": False, "auth_session": 0})
    return simulate(RunConfig(config, ChannelConfig(loss=loss, **from_swarm(config)), limits)).summary()


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    return {row["item"]: row["summary"] for row in rows}


SOAK = Soak(
    "air",
    "Twelve agents on hosts of their own, started in any order, with drifts of 50 ppm and up to a fifth of all frames "
    "lost: their bags verify, nobody crashes, frames overlap in at most 0.1 % of slots, in none without shortcuts.",
    tuple(_items()),
    _run,
    _figures,
)
