"""Checks a flight of agents with clocks of their own, or of vehicles that are not simulated."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from dtsa_agent.core import RemoteProtocolError, decode_frame
from dtsa_agent.core.authentication import Authenticator
from dtsa_agent.core.frame import TAG_LENGTH, Frame, decode_extended, encode_frame
from dtsa_agent.keys import VARIABLE
from dtsa_bench.log.arrays import FlightArrays
from dtsa_bench.log.replay import AgentReplay
from dtsa_bench.log.rules import RuleChecker
from dtsa_bench.runs.config import REALTIME
from dtsa_bench.runs.delivery import DeliveryCounts
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS

from .contents import BagContents, recorded_summary
from .differences import decision_difference, first_difference
from .on_air import FramesOnAir
from .result import Mismatch, Result

_SLOT_MASK = 0xFFFFFFFF  # slots have 32 bits in frames


def check_realtime(log: FlightArrays, contents: BagContents, result: Result) -> None:
    """Check a flight that cannot be flown again bit for bit, because it depends on when things happened.

    What frames, times, verdicts and decisions must have in common is checked all the same.

    :raises Mismatch: at the first difference.
    """
    own_clocks = result.mode == REALTIME
    log.settings = {**log.settings, "mode": REALTIME}  # missions say what they fly with instead of a mode
    run = log.config
    frames, authenticator = FramesOnAir.of_log(log, run.air, own_clocks), None
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
    frames.check_numbers()
    overlapping = frames.check_overlaps()
    result.count("frames that no agent heard together with another", len(frames.slot))
    summary = _check_summary(log, result)
    if own_clocks and (run.air.range_m or run.air.capture_db):
        result.skipped["the channel's verdicts"] = "they depend on where all were when each frame was settled"
    else:
        # Frames that are lost may have been on the air together with the last ones that are there.
        until_ns = (len(log) - 1) * log.slot_ns if result.broken_off else None
        received, lost, collided, count = frames.resolve_again(contents.changes, until_ns)
        counts = {name: np.zeros_like(getattr(log, name)) for name in ("lost", "collided")}
        counts["lost"][frames.slot, frames.sender - 1] = lost
        counts["collided"][frames.slot, frames.sender - 1] = collided
        _compare(log, "overlap on the time line, and the channel's draw from its seed", received=received, **counts)
        result.count("verdicts made again", count)
    if own_clocks:
        _check_decisions(log, frames, result, summary, has_key=authenticator is not None)
    else:
        result.skipped["decisions and motion"] = (
            "they depend on when each message reached each process, which the bag does not hold"
        )
    _check_rules(log, result)
    collided_count = int((log.collided > 0).sum())
    result.safety |= {"frames": len(frames.slot), "overlapping_pairs": overlapping, "frames_collided": collided_count}
    if own_clocks:
        result.safety |= _clock_spread(log)


def _compare(log: FlightArrays, why: str = "", **expected: Any) -> None:
    """Compare fields of a log; Mismatch: they differ."""
    if mismatch := first_difference(log, expected, why):
        raise mismatch


def _check_decisions(
    log: FlightArrays, frames: FramesOnAir, result: Result, summary: dict[str, Any], has_key: bool
) -> None:
    """What agents took in had been delivered to them, and their decisions follow from it."""
    assert log.heard is not None
    count, delays = frames.check_received(log.heard, len(log))
    result.count("frames taken in as they were delivered", count)
    delivery = DeliveryCounts(log.agents, len(log), int(log.sent.sum()), int(log.received.sum()), count)
    result.unheard = delivery.problem(summary.get("not_taken_in"))
    result.skipped["motion"] = "it depends on when in a slot each message reached each process"
    if log.config.swarm.auth and not has_key:
        result.skipped["decisions"] = f"no key in {VARIABLE}"
    else:
        result.count("decisions made again", compare_decisions(log, log.config.swarm.auth))
    result.safety |= delays | {"stalls": summary.get("stalls", [])}


def _check_rules(log: FlightArrays, result: Result) -> None:
    """Whether the frames keep to the rules; those that came too late to be sent were made all the same."""
    rules, ids = RuleChecker(log.config.swarm), np.arange(1, log.agents + 1)
    unsent = log.known & (log.chosen == ids) & ~log.sent
    for row in np.flatnonzero((log.sent | unsent).any(axis=1)).tolist():
        rules.check_slot(row, log.frames_in(row), unrecorded=ids[unsent[row]].tolist())
    result.note_rules(rules)


def _clock_spread(log: FlightArrays) -> dict[str, float]:
    on_time = log.known & ~log.sent  # a frame may leave late; the slot starts when it starts
    rows = np.flatnonzero(on_time.sum(axis=1) > 1)
    latest = np.where(on_time, log.offset_ns, np.iinfo(np.int64).min).max(axis=1)[rows]
    spread = latest - np.where(on_time, log.offset_ns, np.iinfo(np.int64).max).min(axis=1)[rows]
    mean, most = (float(spread.mean()), int(spread.max())) if len(rows) else (0.0, 0)
    return {"clock_spread_max_ms": most / 1e6, "clock_spread_mean_ms": mean / 1e6}


def _check_summary(log: FlightArrays, result: Result) -> dict[str, Any]:
    summary = recorded_summary(log, result)
    recorded = summary.get("slots", {}).get("total")
    if recorded is not None and abs(recorded - len(log)) > 1:
        raise Mismatch("summary.json: slots", len(log), recorded, "each has a record")
    if summary:
        result.count("summary.json")
    return summary


def compare_decisions(log: FlightArrays, tags: bool) -> int:
    """Replay all agents, together, up to the first slot that one of them has not told of; return the equal decisions.

    :param tags: check the tags of frames.
    :raises Mismatch: at the first that is not equal.
    """
    replay = AgentReplay(log.config.swarm, range(1, log.agents + 1), tags)
    for row in range(len(log)):
        if not log.known[row].all():
            break
        replay.step(log, row)
        if replay.differences:
            why = "follows from what the agent says to have taken in"
            raise decision_difference(replay.differences[0], log, why)
    return replay.equal


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
        except RemoteProtocolError as error:
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
    if config.auth and authenticator is None:
        data = data[:-TAG_LENGTH]
    elif authenticator is not None:
        opened = authenticator.open(data, slot)
        if opened is None:
            raise RemoteProtocolError("a tag that the key does not make")
        data = opened
    data = config.protocol_part(data)
    own = decode_extended(data, config.extent_m).own if config.extended else decode_frame(data, config.extent_m)
    position, velocity, command = (tuple(vector) for vector in state)
    expected = Frame(agent, slot & _SLOT_MASK, own.c_r, position, velocity, command if own.intent else None)
    return own, decode_frame(encode_frame(expected, config.extent_m), config.extent_m)
