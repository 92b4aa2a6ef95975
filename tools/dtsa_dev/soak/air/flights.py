"""Flights of twelve agents on hosts of their own over a switch that is the medium: cold starts, and what goes wrong."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dtsa_agent.air.contacts import limits_of
from dtsa_agent.air.datagram import NETWORK
from dtsa_agent.core import SwarmConfig
from dtsa_bench.recordings.bag.run import load_run
from dtsa_bench.recordings.merge.merge import verified
from dtsa_bench.recordings.tables.ages import follow_run
from dtsa_bench.recordings.verify import verify_bag
from dtsa_bench.runs.config import RunConfig, RunLimits, from_swarm
from dtsa_bench.simulation.simulate import simulate
from dtsa_channel_sim import ChannelConfig
from dtsa_dev.network.intruder import Intruder
from dtsa_dev.network.switch import Links
from dtsa_dev.network.trial import WHOLE, Flight, NotFlown, Trial, fly
from dtsa_dev.soak.checks import met
from dtsa_dev.soak.item import Item, NotMet

AGENTS = 12
OVERLAP = 0.001  # of slots
AGE_MARGIN, ERROR_MARGIN = 0.05, 0.15  # mean age and mean error may differ from the simulator's by this share
# Slots of each: those that begin later are there at once, and name it within three cycles of their lists at the latest.
_HELD = limits_of(SwarmConfig(agents=AGENTS, policy="lease"), NETWORK.peers).named
_SECONDS = 12.0
_FAULT_S = 3.0
_APART = [list(range(1, AGENTS // 2 + 1)), list(range(AGENTS // 2 + 1, AGENTS + 1))]
_ON_THE_AIR: dict[str, dict[str, Any]] = {"jam": {"jam": True}, "partition": {"partition": _APART}}
_LINKS = Links(delay_ns=200_000, jitter_ns=500_000, double=0.1)
#: What goes wrong in a flight, and what it does to it.
FAULTS = {
    "kill": "an agent's process is killed, and started again after 1 s",
    "freeze": "an agent's process stands still for 3 s",
    "partition": "the air is cut in two for 3 s",
    "jam": "nobody hears anybody for 3 s",
    "stall": "the switch stands still for 1 s",
    "groups": "the air is cut in two from the start: two groups that count differently meet",
    "intruder": "a stranger without the key answers each frame: played again, changed, made up, floods of twenty",
    "links": "frames are 0.2 to 0.7 ms longer under way, and every tenth arrives twice",
}


def cold_starts() -> Iterator[Item]:
    """All start in any order, nothing goes wrong but losses."""
    seed = 0
    for slot_ms in (10.0, 5.0):
        for loss in (0.0, 0.05, 0.2):
            for strict in (True, False):
                seed += 1
                settings = {"slot_ms": slot_ms, "loss": loss, "strict": strict}
                name = f"{slot_ms:g} ms, {loss:.0%} lost, {'no shortcuts' if strict else 'default'}"
                yield Item(name, settings, seed, 30.0, sample=(slot_ms, loss, strict) == (10.0, 0.05, True))


def faults() -> Iterator[Item]:
    """Something goes wrong."""
    for seed, fault in enumerate(FAULTS, 13):
        settings = {"slot_ms": 10.0, "loss": 0.05, "strict": False, "fault": fault}
        yield Item(fault, settings, seed, 35.0, sample=fault in ("kill", "intruder"))


def _disturbed(flight: Flight, fault: str) -> None:
    if fault == "kill":
        flight.signal(2, signal.SIGKILL)
        flight.carry(1.0)
        flight.start(2)
        flight.carry_until_heard(2)
        flight.carry(_FAULT_S)
    elif fault == "freeze":
        flight.signal(2, signal.SIGSTOP)
        flight.carry(_FAULT_S)
        flight.signal(2, signal.SIGCONT)
    elif fault == "stall":
        time.sleep(1.0)
    elif fault == "groups":
        flight.switch.set(partition="")
    elif fault == "intruder":
        Intruder(flight.switch, flight.trial.seed)
    elif fault in _ON_THE_AIR:
        flight.switch.set(**_ON_THE_AIR[fault])
        flight.carry(_FAULT_S)
        flight.switch.set(jam=False, partition="")


def run(item: Item, directory: Path) -> dict[str, Any]:
    """Flies one item.

    :param item: one of this module's.
    :param directory: an empty one.
    :raises NotMet: if something that the soak promises does not hold.
    """
    fault, slot_ms, loss, strict = (item.settings.get(name, "") for name in ("fault", "slot_ms", "loss", "strict"))
    shortcuts = {"open_every": 0, "adoption": False} if strict else {}
    swarm = SwarmConfig(
        agents=AGENTS, policy="lease", slot_ms=slot_ms, scenario="waypoints", stops=8, pause_slots=0,
        auth=True, auth_session=item.seed, seed=item.seed, **shortcuts,
    )  # fmt: skip
    medium = {"loss": loss, **({"partition": _APART} if fault == "groups" else {})}
    trial = Trial(swarm, medium, _LINKS if fault == "links" else Links(), seconds=_SECONDS, seed=item.seed)
    try:
        found = fly(trial, directory, (lambda flight: _disturbed(flight, fault)) if fault else None)
    except NotFlown as error:
        raise NotMet(str(error)) from error
    met(verified(found), f"the bags do not verify: {found['decisions_again']}, {found['turns']['which']}, "
        f"{found['frames_heard_not_as_sent']} frames heard not as sent")  # fmt: skip
    flown, air = found["flight"], found["switch"]
    if flown is None:
        raise NotMet("they never counted alike")
    _check_bag(directory / WHOLE, flown)
    met(len(air["heard_at_the_end"]) == AGENTS, f"at the end speak only {air['heard_at_the_end']}")
    again = _simulated(swarm, loss, flown["flight_time_s"], fault)
    figures = {
        "fault": fault, "slot_ms": slot_ms, "loss": loss, "strict": strict,
        "common_after_last_start_s": found["common_after_last_start_s"],
        "clock_spread_ms": found["clock_spread_ms"],
        "residual_us": found["time_line"]["residual_us"],
        "flight_time_us": found["time_line"]["flight_time_us"],
        "frames": [found["frames_sent"], found["frames_unsent"]],
        "unsent_share": found["frames_unsent"] / max(1, found["frames_sent"] + found["frames_unsent"]),
        "overlap_slots": air["overlap_slots"], "slots": air["slots"],
        "decisions_again": found["decisions_again"]["equal"],
        "collided": [flown["collided"], again["collided"]],
        "min_distance_m": [flown["min_distance_m"], again["min_distance_m"]],
        "age_mean_slots": [flown["age_mean_slots"], again["age_mean_slots"]],
        "estimate_error_mean_m": [flown["estimate_error_mean_m"], again["estimate_error_mean_m"]],
        "not_taken_in": _refused(found), "held_slots": found["held_slots"],
    }  # fmt: skip
    if fault:
        _check_fault(fault, figures)
    else:
        _check_cold_start(figures, 0.0 if strict else OVERLAP)
    return figures


def _check_bag(bag: Path, flown: dict[str, Any]) -> None:
    """The merged bag verifies, and who reads it finds the same results."""
    checked = verify_bag(bag)
    met(checked.ok, f"the merged bag does not verify: {checked.difference}")
    met(follow_run(load_run(bag)).summary == flown, "the merged bag has other results than `merge`")


def _check_cold_start(figures: dict[str, Any], overlap: float) -> None:
    """No crash, no overlap, ages and errors as in the simulator."""
    met(not figures["collided"][0], "a crash")
    held = figures["held_slots"]
    met(max(held.values(), default=0) <= _HELD, f"agents hovered for want of a quorum: {held}")
    share = figures["overlap_slots"] / figures["slots"]
    met(share <= overlap, f"frames overlapped in {share:.2%} of {figures['slots']} slots")
    for name, margin in (("age_mean_slots", AGE_MARGIN), ("estimate_error_mean_m", ERROR_MARGIN)):
        here, simulated = figures[name]
        met(abs(here / simulated - 1.0) <= margin, f"{name}: {here:.4g}, {simulated:.4g} in the simulator")


def _check_fault(fault: str, figures: dict[str, Any]) -> None:
    """What was said by a stranger was refused, each kind for its reason."""
    refused = figures["not_taken_in"]
    if fault == "intruder":
        expected = {"not ours", "other settings", "rejected", "repeated", "other time"}
        met(expected <= refused.keys(), f"not refused: {sorted(expected - refused.keys())}")
    if fault == "links":
        met(refused.get("repeated", 0) > 0, "nothing arrived twice")


def _refused(found: dict[str, Any]) -> dict[str, int]:
    """Datagrams not taken in by all agents together, as far as their bags tell."""
    total: dict[str, int] = {}
    for counts in found["not_taken_in"].values():
        for reason, count in counts.items():
            total[reason] = total.get(reason, 0) + count
    return total


def _simulated(swarm: SwarmConfig, loss: float, seconds: float, fault: str) -> dict[str, Any]:
    """The same flight in the simulator: jammed or cut in two there as well, at about the same time."""
    limits = RunLimits(timeout_s=max(1.0, seconds), tail_s=3600.0, stop_on_crash=False)
    config = SwarmConfig.from_dict({**swarm.to_dict(), "auth": False, "auth_session": 0})
    begins, lasts = (round(time_s / swarm.slot_s) for time_s in (_SECONDS / 3, _FAULT_S))
    medium: dict[str, Any] = {"loss": loss, **from_swarm(config)}
    if fault in _ON_THE_AIR:
        medium["schedule"] = [{"slot": begins, "until": begins + lasts, **_ON_THE_AIR[fault]}]
    return simulate(RunConfig(config, ChannelConfig(**medium), limits)).summary()
