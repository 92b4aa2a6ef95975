"""Checks a flight in lockstep: everything follows from its configuration, so everything must be equal."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

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
from .result import Difference, Mismatch, Result

_NOT_COMPARED = ("wall_time_s", "realtime_factor", "unusable_messages", "not_taken_in")
_ARRAYS = ("length", "chosen", "reason", "digest", "score", "track", "velocity", "command", "goal", "outcome", "lost",
           "collided")  # fmt: skip


def check_lockstep(
    log: FlightArrays, contents: BagContents, result: Result, progress: Callable[[int], None] | None
) -> None:
    """Fly the flight again, from its configuration alone, and compare all slots.

    :raises Mismatch: at the first difference.
    :raises ConfigError: for a policy without slots.
    """
    run, changes = log.config, contents.changes_by_slot()
    check_slotted(run.swarm.policy)
    if not len(log):
        raise UnusableBag(str(log.file), "it holds no whole slot")
    flight = simulate(
        run, shared_table=False, log=True, frames=True, slots=len(log), changes=changes, progress=progress
    )
    expected = log_of_flight(flight)
    difference = _first_mismatch(log, expected)
    slots = len(log) if difference is None else difference.difference.slot or 0
    result.slots, result.simulated_s = slots, slots * run.swarm.slot_s  # those that are equal, wherever it ends
    if slots:
        result.count("slot records", slots)
        result.count("decisions", slots * log.agents)
        result.count("frames", int(log.sent[:slots].sum()))
    if difference is not None:
        raise difference
    _check_summary(log, result, flight.metrics)
    delivered = int(log.received.sum())
    result.unheard = DeliveryCounts(log.agents, slots, int(log.sent.sum()), delivered, delivered).problem()
    _check_safety(expected, result, flight.metrics, lossless=may_share(run) and not changes)


def _first_mismatch(log: FlightArrays, expected: FlightArrays) -> Mismatch | None:
    """The difference in the earliest slot; None: all is equal."""
    if not log.known.all():
        row, column = (int(index[0]) for index in np.nonzero(~log.known))
        return Mismatch(Difference("agent", "an account", "none", WHY["known"], row, column + 1))
    found: list[tuple[int, Mismatch]] = []
    for name in _ARRAYS:
        right, recorded = getattr(expected, name), getattr(log, name)
        if right.tobytes() != recorded.tobytes():
            found.append(first_difference(name, right, recorded, 0, log))
    frames, recorded_frames = expected.sent_frames, log.sent_frames
    if frames.data != recorded_frames.data:
        pairs = zip(frames.data, recorded_frames.data, strict=False)
        at = next((k for k, (one, other) in enumerate(pairs) if one != other), 0)
        row = int(min(frames.row[at : at + 1].tolist() + recorded_frames.row[at : at + 1].tolist(), default=0))
        right, recorded = expected.frames_in(row), log.frames_in(row)
        if right != recorded:
            found.append((row, frame_difference(right, recorded, row, log.config.swarm.extent_m)))
    if len(frames.row) == len(recorded_frames.row) and (frames.received != log.received).any():
        k, column = (int(index[0]) for index in np.nonzero(frames.received != log.received))
        row, sender = int(frames.row[k]), int(frames.sender[k])
        values = [str(bool(mask[k, column])) for mask in (frames.received, log.received)]
        what = f"received, frame of cf{sender}"
        found.append((row, Mismatch(Difference(what, *values, WHY["received"], row, column + 1))))
    return min(found, key=lambda entry: entry[0])[1] if found else None


def _check_summary(log: FlightArrays, result: Result, metrics: FlightMetrics) -> None:
    recorded = recorded_summary(log, result)
    for key, value in json.loads(json.dumps(metrics.summary())).items():
        if key in _NOT_COMPARED or key not in recorded or (key == "end" and recorded[key] == "stopped"):
            continue
        if recorded[key] != value:
            why = "computed from the recorded flight"
            raise Mismatch(Difference(f"summary.json: {key}", str(value), str(recorded[key]), why))
        result.count("summary.json")


def _check_safety(log: FlightArrays, result: Result, metrics: FlightMetrics, lossless: bool) -> None:
    rules, closest = RuleChecker(log.config.swarm), metrics.closest()
    for row in range(len(log)):
        rules.check_slot(row, log.frames_in(row))
    crowded, agreement = int((log.sent.sum(axis=1) > 1).sum()), bool((log.chosen == log.chosen[:, :1]).all())
    result.safety = {
        "slots_with_two_senders": crowded,
        "all_agents_chose_alike": agreement,
        "closest_pair_m": closest[0],
        "closest_pair": list(closest[1]),
        "crashed": metrics.crash_slot >= 0,
    }
    result.note_rules(rules)
    if lossless and (crowded or not agreement):
        why = "without loss all agents hear the same and choose the same"
        raise Mismatch(Difference("two senders in one slot", "never", f"{crowded} slots", why))
