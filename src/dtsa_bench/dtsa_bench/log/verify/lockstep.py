"""Checks a flight in lockstep: everything follows from its configuration, so everything must be equal."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np

from dtsa_agent.core.station import check_slotted
from dtsa_bench.log.arrays import FlightArrays
from dtsa_bench.log.bag.errors import UnusableBag
from dtsa_bench.log.flight_log import log_of_flight
from dtsa_bench.log.rules import RuleChecker
from dtsa_bench.runs.delivery import DeliveryCounts
from dtsa_bench.runs.metrics import FlightMetrics, may_share
from dtsa_bench.simulation.simulate import simulate

from .contents import BagContents, recorded_summary
from .differences import WHY, first_difference, frame_difference
from .result import Mismatch, Result

_NOT_COMPARED = ("wall_time_s", "realtime_factor", "unusable_messages", "not_taken_in")


def check_lockstep(
    log: FlightArrays, contents: BagContents, result: Result, progress: Callable[[int], None] | None
) -> None:
    """Fly the flight again, from its configuration alone, and compare all slots.

    :raises Mismatch: at the first difference.
    :raises ConfigError: for a policy without slots.
    """
    run, changes = log.config, contents.changes
    check_slotted(run.swarm.policy)
    if not len(log):
        raise UnusableBag(str(log.file), "it holds no whole slot")
    flight = simulate(
        run, shared_table=False, log=True, frames=True, slots=len(log), changes=changes, progress=progress
    )
    expected = log_of_flight(flight)
    mismatch = _first_mismatch(log, expected)
    slots = len(log) if mismatch is None else mismatch.difference.slot or 0
    result.slots, result.simulated_s = slots, slots * run.swarm.slot_s  # those that are equal, wherever it ends
    if slots:
        result.count("slot records", slots)
        result.count("decisions", slots * log.agents)
        result.count("frames", int(log.sent[:slots].sum()))
    if mismatch is not None:
        raise mismatch
    _check_summary(log, result, flight.metrics)
    delivered = int(log.received.sum())
    result.unheard = DeliveryCounts(log.agents, slots, int(log.sent.sum()), delivered, delivered).problem()
    _check_safety(expected, result, flight.metrics, lossless=may_share(run) and not changes)


def _first_mismatch(log: FlightArrays, expected: FlightArrays) -> Mismatch | None:
    """The difference in the earliest slot; None: all is equal."""
    for row, column in np.argwhere(~log.known)[:1].tolist():
        return Mismatch("agent", "an account", "none", "every agent answers every slot once", row, column + 1)
    mismatch = first_difference(log, {name: getattr(expected, name) for name in WHY if name != "frame"})
    differs = (row for row in range(len(log)) if expected.frames_in(row) != log.frames_in(row))
    row = next(differs, None) if expected.data != log.data else None
    if row is None or (mismatch is not None and (mismatch.difference.slot or 0) <= row):
        return mismatch
    return frame_difference(expected.frames_in(row), log.frames_in(row), row, log)


def _check_summary(log: FlightArrays, result: Result, metrics: FlightMetrics) -> None:
    recorded = recorded_summary(log, result)
    for key, value in json.loads(json.dumps(metrics.summary())).items():
        if key in _NOT_COMPARED or key not in recorded or (key == "end" and recorded[key] == "stopped"):
            continue
        if recorded[key] != value:
            raise Mismatch(f"summary.json: {key}", value, recorded[key], "computed from the recorded flight")
        result.count("summary.json")


def _check_safety(log: FlightArrays, result: Result, metrics: FlightMetrics, lossless: bool) -> None:
    rules, (closest_m, closest_pair) = RuleChecker(log.config.swarm), metrics.closest()
    for row in range(len(log)):
        rules.check_slot(row, log.frames_in(row))
    crowded, agreement = int((log.sent.sum(axis=1) > 1).sum()), bool((log.chosen == log.chosen[:, :1]).all())
    result.safety = {
        "slots_with_two_senders": crowded,
        "all_agents_chose_alike": agreement,
        "closest_pair_m": closest_m,
        "closest_pair": list(closest_pair),
        "crashed": metrics.crash_slot >= 0,
    }
    result.note_rules(rules)
    if lossless and (crowded or not agreement):
        why = "without loss all agents hear the same and choose the same"
        raise Mismatch("two senders in one slot", "never", f"{crowded} slots", why)
