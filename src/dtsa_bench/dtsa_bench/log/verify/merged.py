"""Checks a flight that was merged from the bags of agents on a network."""

from __future__ import annotations

import numpy as np

from dtsa_bench.log.arrays import FlightArrays
from dtsa_bench.log.bag.errors import UnusableBag
from dtsa_bench.log.merge.join import receptions_of
from dtsa_bench.log.merge.merge import clocks_apart
from dtsa_bench.log.merged_flight import MergedReplay, check_rules, count_unmatched_frames

from .differences import decision_difference, first_difference
from .realtime import check_own_states
from .result import Mismatch, Result


def check_merged(log: FlightArrays, result: Result) -> None:
    """All decisions of a merged flight follow from what each agent heard; no rule is broken.

    :raises Mismatch: at the first difference.
    :raises UnusableBag: if a part of the bag is lost, or its records do not fit together.
    """
    if result.broken_off:
        raise UnusableBag(result.bag, "it was merged, and a part of it is lost: merge the agents' bags again")
    about = log.merged or {}
    result.slots, result.simulated_s = len(log), len(log) * log.config.swarm.slot_s
    result.count("slot records", len(log))
    _check_receptions(log)
    check_own_states(log, result)
    replay = MergedReplay(log).run()
    if first := next((one for process in replay.processes for one in process.replay.differences), None):
        raise decision_difference(first, log, "follows from what the agent says to have heard")
    result.count("decisions made again", replay.equal)
    if others := about["frames_heard_not_as_sent"] + count_unmatched_frames(log):
        why = "no agent hears a frame that was not sent"
        raise Mismatch("frames heard", "as they were sent", f"{others} others", why)
    if apart := about["not_determined"]:
        raise Mismatch("time line", "one of all agents", f"{len(apart)} groups", clocks_apart(apart))
    rules = check_rules(log, replay.unsent)
    if about["missing"] or about["broken_off"] or about["nothing_written"]:
        result.skipped["turns"] = "bags are missing or break off: it is not known to which agents all turns were given"
    elif rules.broken:
        why = "all bags are there and whole"
        raise Mismatch("frames in turn", "no rule broken", "; ".join(rules.broken), why)
    else:
        result.count("frames in turn", rules.frames)
    if log.config.swarm.auth:
        result.skipped["tags of frames"] = "the agents have checked them; they cover more than is recorded"
    result.skipped["motion"] = "each agent has recorded where it was"
    result.skipped["why a frame was not heard"] = "a network does not say"
    result.safety |= {
        "frames": rules.frames,
        "slots_with_two_senders": rules.double_slots,
        "missing": about["missing"],
        "broken_off_bags": about["broken_off"],
    }


def _check_receptions(log: FlightArrays) -> None:
    """Who received a frame, and who did not, follows from what each agent heard.

    :raises Mismatch: at the first difference.
    """
    for part, (received, lost, outcome) in zip(log.parts, receptions_of(log), strict=True):
        expected = {"outcome": outcome, "lost": lost, "collided": np.zeros_like(lost), "received": received}
        if mismatch := first_difference(part, expected, "it follows from what the agents heard"):
            raise mismatch
