"""Checks a flight that was merged from the bags of agents on a network."""

from __future__ import annotations

import numpy as np

from dtsa_bench.log.arrays import FlightArrays
from dtsa_bench.log.bag.errors import UnusableBag
from dtsa_bench.log.merge.merge import clocks_apart, verified
from dtsa_bench.log.merged_bag import to_log
from dtsa_bench.log.merge.merged_flight import from_log

from .differences import first_difference
from .realtime import OwnStates, check_own_states
from .result import Difference, Mismatch, Result


def check_merged(log: FlightArrays, result: Result) -> None:
    """All decisions of a merged flight follow from what each agent heard; no rule is broken.

    :raises Mismatch: at the first difference.
    :raises UnusableBag: if a part of the bag is lost, or its records do not fit together.
    """
    if result.broken_off:
        raise UnusableBag(result.bag, "it was merged, and a part of it is lost: merge the agents' bags again")
    result.slots, result.simulated_s = len(log), len(log) * log.config.swarm.slot_s
    result.count("slot records", len(log))
    check_merged_receptions(log)
    check_own_states(log, OwnStates(log.config.swarm, result, tags=False))
    found = from_log(log).judge()
    differences, turns = found["decisions_again"]["differences"], found["turns"]
    if differences:
        one = differences[0]
        why = "follows from what the agent says to have heard"
        raise Mismatch(Difference(one["field"], str(one["again"]), str(one["recorded"]), why, one["slot"], one["agent"]))
    result.count("decisions made again", found["decisions_again"]["equal"])
    if others := found["frames_heard_not_as_sent"]:
        why = "nobody hears what was not sent"
        raise Mismatch(Difference("frames heard", "as they were sent", f"{others} others", why))
    if apart := found["not_determined"]:
        raise Mismatch(Difference("time line", "one of all agents", f"{len(apart)} groups", clocks_apart(apart)))
    if not verified(found):
        why = "all bags are there and whole"
        raise Mismatch(Difference("frames in turn", "no rule broken", "; ".join(turns["which"]), why))
    if found["missing"] or found["broken_off"] or found["nothing_written"]:
        result.skipped["turns"] = "bags are missing or break off: who was given a turn is not known of all"
    else:
        result.count("frames in turn", turns["frames_judged"])
    if log.config.swarm.auth:
        result.skipped["tags of frames"] = "the agents have checked them; they cover more than is recorded"
    result.skipped["motion"] = "each agent has recorded where it was"
    result.skipped["why a frame was not heard"] = "a network does not say"
    result.safety |= {
        "frames": turns["frames_judged"],
        "slots_with_two_senders": turns["slots_with_two_senders"],
        "missing": found["missing"],
        "broken_off_bags": found["broken_off"],
    }


def check_merged_receptions(log: FlightArrays) -> None:
    """Who received a frame, and who did not, follows from what each agent heard.

    :raises Mismatch: at the first difference.
    """
    again = to_log(from_log(log))
    for part, right in ((log, again), (log.earlier, again.earlier)):
        if part is None or right is None:
            continue
        if len(part) != len(right):
            raise Mismatch(Difference("slot records", str(len(right)), str(len(part)), "each slot has one"))
        for name in ("known", "start_ns", "outcome", "length", "lost", "collided", "offset_ns", "sent_ns", "presence"):
            expected, recorded = getattr(right, name), getattr(part, name)
            if expected is not None and recorded is not None and expected.tobytes() != recorded.tobytes():
                raise first_difference(name, expected, recorded, 0, part)[1]
        if part.received.tobytes() != right.received.tobytes() or part.data != right.data:
            frame = next(iter(np.flatnonzero((part.received != right.received).any(axis=1))), 0)
            row, sender = (int(values[frame]) for values in part.sent_frames[:2])
            why = "it follows from what the agents heard"
            raise Mismatch(Difference("received", "what the agents say", "another mask", why, row, sender))


