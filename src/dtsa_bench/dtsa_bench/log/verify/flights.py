"""Checks of flights by their kind: in lockstep, in real time, merged from the bags of agents on a network."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from itertools import groupby
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import LocalProtocolError, RemoteProtocolError, decode_frame
from dtsa_agent.core.authentication import Authenticator
from dtsa_agent.core.frame import TAG_LENGTH, Frame, decode_extended, encode_frame
from dtsa_agent.core.station import check_slotted
from dtsa_agent.keys import VARIABLE
from dtsa_bench.log.arrays import FlightArrays
from dtsa_bench.log.bag.errors import UnusableBag
from dtsa_bench.log.flight_log import log_of_flight
from dtsa_bench.log.merge.merge import clocks_apart, receptions_of
from dtsa_bench.log.merged_flight import MergedReplay, check_rules
from dtsa_bench.log.replay import AgentReplay, DecisionDifference
from dtsa_bench.log.rules import RuleChecker
from dtsa_bench.runs.delivery import DeliveryCounts
from dtsa_bench.runs.metrics import FlightMetrics
from dtsa_bench.simulation.simulate import simulate
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS

from .contents import BagContents, recorded_summary
from .on_air import FramesOnAir
from .result import WHY, Mismatch, Result, field_mismatch, first_difference

_NOT_COMPARED = ("wall_time_s", "realtime_factor", "unusable_messages", "not_taken_in")
_SLOT_MASK = 0xFFFFFFFF  # slots have 32 bits in frames


# -- lockstep ---------------------------------------------------------------------------------------------------------
def check_lockstep(
    log: FlightArrays, contents: BagContents, result: Result, progress: Callable[[int], None] | None
) -> None:
    """Fly the flight again, from its configuration alone, and compare all slots.

    :raises Mismatch: at the first difference.
    :raises ConfigError: for a policy without slots.
    """
    run = log.config
    check_slotted(run.swarm.policy)
    if not len(log):
        raise UnusableBag(str(log.file), "it holds no whole slot")
    changes, slots = contents.changes, len(log)
    flight = simulate(run, shared_table=False, log=True, frames=True, slots=slots, changes=changes, progress=progress)
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
    closest_m, closest_pair = flight.metrics.closest()
    result.safety = {
        "slots_with_two_senders": int((log.sent.sum(axis=1) > 1).sum()),
        "all_agents_chose_alike": bool((log.chosen == log.chosen[:, :1]).all()),
        "closest_pair_m": closest_m,
        "closest_pair": list(closest_pair),
        "crashed": flight.metrics.crash_slot >= 0,
    }
    _check_rules(log, result, np.zeros_like(log.sent))


def _first_mismatch(log: FlightArrays, expected: FlightArrays) -> Mismatch | None:
    """The difference in the earliest slot; None: all is equal."""
    for row, column in np.argwhere(~log.known)[:1].tolist():
        return Mismatch("agent", "an account", "none", "every agent answers every slot once", row, column + 1)
    mismatch = first_difference(log, {name: getattr(expected, name) for name in WHY if name != "frame"})
    until = len(log) if mismatch is None else mismatch.difference.slot or 0  # up to there as many bytes have been sent
    for row, column in np.argwhere(log.length[:until]).tolist() if expected.data != log.data else ():
        frames = expected.frame(row, column + 1), log.frame(row, column + 1)
        if frames[0] != frames[1]:
            return field_mismatch("frame", *frames, WHY["frame"], row, column + 1, log)
    return mismatch


def _check_summary(log: FlightArrays, result: Result, metrics: FlightMetrics) -> None:
    recorded = recorded_summary(log, result)
    for key, value in json.loads(json.dumps(metrics.summary())).items():
        if key in _NOT_COMPARED or key not in recorded or (key == "end" and recorded[key] == "stopped"):
            continue
        if recorded[key] != value:
            raise Mismatch(f"summary.json: {key}", value, recorded[key], "computed from the recorded flight")
        result.count("summary.json")


def _check_rules(log: FlightArrays, result: Result, unsent: NDArray[np.bool_]) -> None:
    """Whether the frames keep to the rules; unsent: (S, N) those that were made and are in no record."""
    rules, ids = RuleChecker(log.config.swarm), np.arange(1, log.agents + 1)
    for row in range(len(log)):
        rules.check_slot(row, log.frames_in(row), unrecorded=ids[unsent[row]].tolist())
    result.note_rules(rules)


# -- real time --------------------------------------------------------------------------------------------------------
def check_realtime(log: FlightArrays, contents: BagContents, result: Result) -> None:
    """Check a flight that cannot be flown again bit for bit, because it depends on when things happened.

    What frames, times, verdicts and decisions must have in common is checked all the same.

    :raises Mismatch: at the first difference.
    """
    run, sent, authenticator = log.config, log.sent_frames, None
    assert log.sent_ns is not None
    frames = FramesOnAir(run.air, sent, sent.row * log.slot_ns + log.sent_ns[sent.row, sent.sender - 1])
    if run.swarm.auth:
        if key := os.environ.get(VARIABLE, ""):
            authenticator = Authenticator.from_hex(key, run.swarm.auth_session)
        else:
            result.skipped["tags of frames"] = f"no key in {VARIABLE}"
    result.slots, result.simulated_s = len(log), len(log) * run.swarm.slot_s
    check_own_states(log, result, authenticator)
    result.count("slot records", len(log))
    outcome = np.where(log.collided.any(axis=1), COLLISION, np.where(log.sent.any(axis=1), SUCCESS, IDLE))
    _compare(log, outcome=np.where(log.recorded, outcome, log.outcome).astype(np.uint8))
    summary = recorded_summary(log, result)
    total = summary.get("slots", {}).get("total", len(log))
    if not isinstance(total, int) or abs(total - len(log)) > 1:
        raise Mismatch("summary.json: slots", len(log), total, "each has a record")
    if summary:
        result.count("summary.json")
    if run.air.range_m or run.air.capture_db:
        result.skipped["the channel's verdicts"] = "they depend on where all were when each frame was settled"
        frames.check_numbers()
        frames.find_times()
        frames.check_overlaps()
        result.count("frames that no agent received together", len(frames.slot))
    else:
        # Frames that are lost may have been on the air together with the last ones that are there.
        until_ns = (len(log) - 1) * log.slot_ns if result.broken_off else 1 << 62
        received, lost, collided, count = frames.resolve_again(contents.changes, until_ns)
        counts = {name: np.zeros_like(getattr(log, name)) for name in ("lost", "collided")}
        counts["lost"][frames.slot, frames.sender - 1] = lost
        counts["collided"][frames.slot, frames.sender - 1] = collided
        _compare(log, "overlap on the time line, and the channel's draw from its seed", received=received, **counts)
        result.count("verdicts made again", count)
    _check_decisions(log, frames, result, summary, has_key=authenticator is not None)
    # Frames that came too late to be sent were made all the same.
    _check_rules(log, result, log.known & (log.chosen == np.arange(1, log.agents + 1)) & ~log.sent)
    result.safety |= {"frames": len(frames.slot), "frames_collided": int((log.collided > 0).sum())}


def _check_decisions(
    log: FlightArrays, frames: FramesOnAir, result: Result, summary: dict[str, Any], has_key: bool
) -> None:
    """What agents took in had been delivered to them, and their decisions follow from it."""
    assert log.heard is not None
    count, delays = frames.check_received(log.heard, len(log), log.reached)
    result.count("frames taken in as they were delivered", count)
    delivery = DeliveryCounts(log.agents, len(log), int(log.sent.sum()), int(log.reached.sum()), count)
    result.unheard = delivery.problem(summary.get("not_taken_in"))
    result.skipped["motion"] = "it depends on when in a slot each message reached each process"
    if log.config.swarm.auth and not has_key:
        result.skipped["decisions"] = f"no key in {VARIABLE}"
    else:
        ends = np.logical_and.accumulate(log.known).sum(axis=0)  # (N,) up to the first slot that each has not told of
        differences: list[DecisionDifference] = []
        for end, ids in groupby(range(1, log.agents + 1), key=lambda agent: ends[agent - 1]):
            replay = AgentReplay(log, list(ids), tags=log.config.swarm.auth)
            for row in range(end):
                replay.step(row)
                if replay.differences:
                    differences.append(replay.differences[0])
                    break
            result.count("decisions made again", replay.equal)
        if differences:
            raise _decision_mismatch(min(differences, key=attrgetter("slot", "agent")), log)
    result.safety |= delays | {"stalls": summary.get("stalls", [])}


def check_own_states(log: FlightArrays, result: Result, authenticator: Authenticator | None = None) -> None:
    """Frames decode, name their sender and slot, say where their senders were, and left when these say.

    :param authenticator: of sealed frames; None: their tags are left out. Those of a network cover the datagram's head,
        too, which no log has.
    :raises Mismatch: at the first that does not.
    """
    row, sender, frames, *_ = log.sent_frames
    known = log.known[row, sender - 1]
    row, sender, frames = row[known], sender[known], [frame for frame, own in zip(frames, known, strict=True) if own]
    if log.sent_ns is not None:
        sent_ns, offset_ns = log.sent_ns[row, sender - 1], log.offset_ns[row, sender - 1]
        for k in np.flatnonzero(sent_ns != offset_ns)[:1].tolist():
            values = f"{sent_ns[k]} ns", f"{offset_ns[k]} ns"
            raise Mismatch("offset_ns", *values, "a frame starts when its sender's does", int(row[k]), int(sender[k]))
    states = (log.track[row, -1, :, sender - 1], log.velocity[row, :, sender - 1], log.command[row, :, sender - 1])
    columns = ((row + log.first_slot).tolist(), sender.tolist(), frames, *(state.tolist() for state in states))
    for slot, agent, data, *state in zip(*columns, strict=True):
        try:
            own, expected = _own_states(log, authenticator, slot, agent, data, *state)
        except (RemoteProtocolError, LocalProtocolError) as error:  # or its sender's state is in no frame
            raise Mismatch("frame", "a frame", error, "agents send what others can decode", slot, agent) from None
        if own == expected:
            continue
        field = next(name for name in Frame.__slots__ if getattr(own, name) != getattr(expected, name))
        why = "a frame names its sender and its slot, and says the sender's own state as the codec rounds it"
        raise Mismatch(f"frame.{field}", getattr(expected, field), getattr(own, field), why, slot, agent)
    if authenticator is not None and frames:
        result.count("tags", len(frames))
    if frames:
        result.count("frames equal to their sender's state", len(frames))


def _own_states(
    log: FlightArrays, authenticator: Authenticator | None, slot: int, agent: int, data: bytes, *state: list[float]
) -> tuple[Frame, Frame]:
    """The sender's own state in a frame, and what it should be."""
    config = log.config.swarm
    opened = data[: len(data) - TAG_LENGTH * config.auth] if authenticator is None else authenticator.open(data, slot)
    if opened is None:
        raise RemoteProtocolError("a tag that the key does not make")
    data = config.protocol_part(opened)
    own = decode_extended(data, config.extent_m).own if config.extended else decode_frame(data, config.extent_m)
    position, velocity, command = ((x, y, z) for x, y, z in state)
    expected = Frame(agent, slot & _SLOT_MASK, own.c_r, position, velocity, command if own.intent else None)
    return own, decode_frame(encode_frame(expected, config.extent_m), config.extent_m)


# -- merged -----------------------------------------------------------------------------------------------------------
def check_merged(log: FlightArrays, result: Result) -> None:
    """All decisions of a merged flight follow from what each agent heard; no rule is broken.

    :raises Mismatch: at the first difference.
    :raises UnusableBag: if a part of the bag is lost, or its records do not fit together.
    """
    if result.broken_off:
        raise UnusableBag(result.bag, "it was merged, and a part of it is lost: merge the agents' bags again")
    about = log.merged or {}
    result.slots, result.simulated_s = len(log), len(log) * log.config.swarm.slot_s
    result.count("slot records", int(log.known.any(axis=1).sum()))
    whole = log.whole or log
    received, lost, outcome = receptions_of(whole)
    expected = {"outcome": outcome, "lost": lost, "collided": np.zeros_like(lost), "received": received}
    _compare(whole, "it follows from what the agents heard", **expected)
    check_own_states(log, result)
    replay = MergedReplay(log).run()
    if first := next((one for process in replay.processes for one in process.replay.differences), None):
        raise _decision_mismatch(first, log)
    if replay.equal != (recorded := int(whole.known.sum())):
        why = "each is of one of the processes that the bag names"
        raise Mismatch("decisions made again", recorded, replay.equal, why)
    result.count("decisions made again", replay.equal)
    if others := about["frames_heard_not_as_sent"] + replay.count_unmatched_frames():
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


def _decision_mismatch(found: DecisionDifference, log: FlightArrays) -> Mismatch:
    why = "follows from what the agent says to have taken in"
    return field_mismatch(found.field, found.expected, found.recorded, why, found.slot, found.agent, log)


def _compare(log: FlightArrays, why: str = "", **expected: Any) -> None:
    """Compare fields of a log; Mismatch: they differ."""
    if mismatch := first_difference(log, expected, why):
        raise mismatch
