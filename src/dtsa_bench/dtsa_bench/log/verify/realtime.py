"""Checks a flight of agents with clocks of their own, or of vehicles that are not simulated."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import RemoteProtocolError, SwarmConfig, decode_frame
from dtsa_agent.core.authentication import Authenticator
from dtsa_agent.core.frame import (
    TAG_LENGTH,
    ExtendedFrame,
    Frame,
    decode_extended,
    encode_extended,
    encode_frame,
)
from dtsa_agent.keys import VARIABLE
from dtsa_bench.log.arrays import FlightArrays
from dtsa_bench.log.replay import AgentReplay
from dtsa_bench.log.rules import RuleChecker
from dtsa_bench.runs.config import REALTIME, RunConfig
from dtsa_bench.runs.delivery import DeliveryCounts
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS

from .contents import BagContents, recorded_summary
from .differences import WHY, decision_difference
from .on_air import FramesOnAir
from .result import Difference, Mismatch, Result

_SLOT_MASK = 0xFFFFFFFF  # slots have 32 bits in frames


def check_realtime(log: FlightArrays, contents: BagContents, result: Result) -> None:
    """Check a flight that cannot be flown again bit for bit, because it depends on when things happened.

    What frames, times, verdicts and decisions must have in common is checked all the same.

    :raises Mismatch: at the first difference.
    """
    own_clocks = result.mode == REALTIME
    run = RunConfig.from_dict({**log.settings, "mode": REALTIME})  # missions say what they fly with instead of a mode
    frames, own_states = FramesOnAir.of_log(log, run.air, own_clocks), OwnStates(run.swarm, result)
    result.slots, result.simulated_s = len(log), len(log) * run.swarm.slot_s
    check_own_states(log, own_states)
    result.count("slot records", len(log))
    _check_outcomes(log)
    frames.check_numbers()
    result.count("frames that no agent heard together with another", frames.check_overlaps())
    summary = _check_summary(log, result)
    if own_clocks and (run.air.range_m or run.air.capture_db):
        result.skipped["the channel's verdicts"] = "they depend on where all were when each frame was settled"
    else:
        # Frames that are lost may have been on the air together with the last ones that are there.
        until_ns = (len(log) - 1) * log.slot_ns if result.broken_off else None
        result.count("verdicts made again", frames.check_verdicts(contents.changes, until_ns))
    if own_clocks:
        _check_decisions(log, frames, own_states, result, summary)
    else:
        result.skipped["decisions and motion"] = (
            "they depend on when each message reached each process, which the bag does not hold"
        )
    _check_rules(log, run.swarm, frames, result)
    result.safety |= frames.safety()
    if own_clocks:
        result.safety |= _clock_spread(log)


def _check_outcomes(log: FlightArrays) -> None:
    right = np.where(log.collided.any(axis=1), COLLISION, np.where(log.sent.any(axis=1), SUCCESS, IDLE))
    wrong = np.flatnonzero(log.recorded & (right != log.outcome))
    if len(wrong):
        row = int(wrong[0])
        raise Mismatch(Difference("outcome", str(right[row]), str(log.outcome[row]), WHY["outcome"], row))


def _check_decisions(
    log: FlightArrays, frames: FramesOnAir, own_states: OwnStates, result: Result, summary: dict[str, Any]
) -> None:
    """What agents took in had been delivered to them, and their decisions follow from it."""
    assert log.heard is not None
    count, delays = frames.check_received(log.heard, len(log))
    result.count("frames taken in as they were delivered", count)
    delivery = DeliveryCounts(log.agents, len(log), int(log.sent.sum()), int(log.received.sum()), count)
    result.unheard = delivery.problem(summary.get("not_taken_in"))
    result.skipped["motion"] = "it depends on when in a slot each message reached each process"
    auth = log.config.swarm.auth
    if auth and not own_states.has_key:
        result.skipped["decisions"] = f"no key in {VARIABLE}"
    else:
        result.count("decisions made again", compare_decisions(log, auth))
    result.safety |= delays | {"stalls": summary.get("stalls", [])}


def _check_rules(log: FlightArrays, config: SwarmConfig, frames: FramesOnAir, result: Result) -> None:
    """Whether the frames keep to the rules; those that came too late to be sent were made all the same."""
    rules, ids = RuleChecker(config), np.arange(1, log.agents + 1)
    unsent = log.known & (log.chosen == ids)
    slots: dict[int, dict[int, bytes]] = {}
    for sent in frames.all():
        slots.setdefault(sent.slot, {})[sent.sender] = sent.data
        unsent[sent.slot, sent.sender - 1] = False
    for row in range(len(log)):
        if row in slots or unsent[row].any():
            rules.check_slot(row, slots.get(row, {}), unrecorded=ids[unsent[row]].tolist())
    result.note_rules(rules)


def _clock_spread(log: FlightArrays) -> dict[str, float]:
    here = log.known & ~log.sent  # a frame may leave late; the slot starts when it starts
    rows = np.flatnonzero(here.sum(axis=1) > 1).tolist()
    spread = [int(np.ptp(log.offset_ns[row, here[row]])) for row in rows]
    mean = float(np.mean(spread)) / 1e6 if spread else 0.0
    return {"clock_spread_max_ms": max(spread, default=0) / 1e6, "clock_spread_mean_ms": mean}


def _check_summary(log: FlightArrays, result: Result) -> dict[str, Any]:
    found = recorded_summary(log, result)
    recorded = found.get("slots", {}).get("total")
    if recorded is not None and abs(recorded - len(log)) > 1:
        raise Mismatch(Difference("summary.json: slots", str(len(log)), str(recorded), "each has a record"))
    if found:
        result.count("summary.json")
    return found


def compare_decisions(log: FlightArrays, tags: bool) -> int:
    """Replay all agents, together, up to the first slot that one of them has not told of; return the equal decisions.

    :param tags: check the tags of frames.
    :raises Mismatch: at the first that is not equal.
    """
    replay = AgentReplay(log, range(1, log.agents + 1), tags)
    for row in range(len(log)):
        if not log.known[row].all():
            break
        replay.step(row)
        if replay.differences:
            why = "follows from what the agent says to have taken in"
            raise decision_difference(replay.differences[0], log, why)
    return replay.equal


def check_own_states(log: FlightArrays, own_states: OwnStates) -> None:
    """Frames say where their senders were, and left when these say.

    :raises Mismatch: at the first that does not.
    """
    frames = log.sent_frames
    for row, sender, data in zip(frames.row.tolist(), frames.sender.tolist(), frames.data, strict=True):
        if not log.known[row, sender - 1]:
            continue
        if log.sent_ns is not None:
            expected, recorded = (int(values[row, sender - 1]) for values in (log.sent_ns, log.offset_ns))
            if expected != recorded:
                why = "a frame starts when its sender's does"
                raise Mismatch(Difference("offset_ns", f"{expected} ns", f"{recorded} ns", why, row, sender))
        state = (log.track[row, -1], log.velocity[row], log.command[row])
        place = row + log.first_slot, sender
        own_states.check(*place, data, *(vectors[:, sender - 1] for vectors in state))


class OwnStates:
    """Compares frames with the states that their senders reported.

    :param tags: check the tags of frames; of a network they cover the datagram's head too, which no log has.
    """

    def __init__(self, config: SwarmConfig, result: Result, tags: bool = True) -> None:
        self._config, self._result = config, result
        self._authenticator: Authenticator | None = None
        if config.auth and tags:
            if key := os.environ.get(VARIABLE, ""):
                self._authenticator = Authenticator.from_hex(key, config.auth_session)
            else:
                result.skipped["tags of frames"] = f"no key in {VARIABLE}"

    @property
    def has_key(self) -> bool:
        """Whether the key of sealed frames is at hand."""
        return self._authenticator is not None

    def check(self, slot: int, agent: int, data: bytes, *state: NDArray[np.float64]) -> None:
        """One frame: it decodes, names its sender and slot, and says where its sender really was.

        :param state: (3,) each, frame map: position, m, velocity and commanded velocity, m/s, at the slot's start.
        :raises Mismatch: if it does not.
        """
        try:
            found, right = self._compared(data, slot, agent, *state)
        except RemoteProtocolError as error:
            raise Mismatch(
                Difference("frame", "a frame", str(error), "agents send what others can decode", slot, agent)
            ) from None
        for name in ("sender", "slot", "position", "velocity", "intent"):
            expected, recorded = getattr(right, name), getattr(found, name)
            if expected != recorded:
                why = "a frame names its sender and its slot" if name in ("sender", "slot") else (
                    "the sender's own state, as the codec rounds it")  # fmt: skip
                raise Mismatch(Difference(f"frame.{name}", str(expected), str(recorded), why, slot, agent))
        self._result.count("frames equal to their sender's state")

    def _compared(self, data: bytes, slot: int, agent: int, *state: NDArray[np.float64]) -> tuple[Frame, Frame]:
        """The sender's own state in a frame, and what it should be."""
        position, velocity, command = (tuple(vector.tolist()) for vector in state)
        if self._config.auth:
            data = self._opened(data, slot)
        data = self._config.protocol_part(data)
        extent, extended = self._config.extent_m, self._config.extended
        found: Any = decode_extended(data, extent).own if extended else decode_frame(data, extent)
        right = Frame(agent, slot & _SLOT_MASK, found.c_r, position, velocity, command if found.intent else None)
        if extended:
            return found, decode_extended(encode_extended(ExtendedFrame(right), extent), extent).own
        return found, decode_frame(encode_frame(right, extent), extent)

    def _opened(self, data: bytes, slot: int) -> bytes:
        """A sealed frame without its tag, which is checked where the key is at hand."""
        if self._authenticator is None:
            return data[:-TAG_LENGTH]
        opened = self._authenticator.open(data, slot)
        if opened is None:
            raise RemoteProtocolError("a tag that the key does not make")
        self._result.count("tags")
        return opened
