"""The Monte Carlo engine: one flight without ROS, over the very core that the nodes run.

For the same :class:`RunConfig` it gives the same sender in every slot and the same positions as `fly`, bit
for bit.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Scenario, Swarm, make_scenario
from dtsa_agent.core.frame import named_in
from dtsa_agent.core.kernel import ffi, lib
from dtsa_agent.core.plugins.entry_points import make_swarm
from dtsa_agent.keys import with_key
from dtsa_bench.log.arrays import HeardFrames
from dtsa_bench.log.flight_log import FlightLog
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.runs.metrics import FlightMetrics, may_share
from dtsa_channel_sim import Channel, Verdict
from dtsa_channel_sim.model.verdict import SUCCESS

from .slot_arrays import SlotArrays, SlotWriter
from .unslotted import UnslottedTraffic

_CALL_S = 0.02  # a call of C takes about so long: after it, Ctrl-C works


@dataclass(frozen=True, slots=True)
class Flight:
    """A simulated flight."""

    run: RunConfig
    scenario: Scenario
    metrics: FlightMetrics
    swarm: Swarm  # as it was at the end
    log: SlotArrays | None  # what happened in its slots
    wall_time_s: float
    heard: HeardFrames | None = None  # in a log of agents that send at any instant

    def summary(self) -> dict[str, Any]:
        """The results, with the keys of ``summary.json``."""
        result = self.metrics.summary(self.wall_time_s)
        result["malformed"], result["foreign"] = self.swarm.malformed, self.swarm.foreign
        return result

    def to_log(self) -> FlightLog:
        """What happened, and what follows from it; the flight was simulated with its log and its frames."""
        arrays, config, heard = self.log, self.run.swarm, self.heard
        assert arrays is not None
        slots = len(arrays)
        start = np.broadcast_to(self.scenario.start, (1, *arrays.position.shape[1:]))
        received = arrays.received
        if heard is not None:  # who took a frame in that arrived, received its sender's
            received = received.copy()
            place = np.cumsum(arrays.sent).reshape(arrays.sent.shape) - 1
            for row, data, by in zip(heard.row.tolist(), heard.data, heard.by, strict=True):
                sender, slot = named_in(data) or (0, 0)
                if 0 < sender <= config.agents and slot <= row and arrays.sent[slot, sender - 1]:
                    received[place[slot, sender - 1]] |= by
        return FlightLog(
            name="", settings=self.run.to_dict(), agents=config.agents, slot_ns=config.slot_ns,
            recorded=np.ones(slots, np.bool_), known=np.ones(arrays.sent.shape, np.bool_),
            start_ns=np.arange(slots) * config.slot_ns, outcome=arrays.outcome, length=arrays.length,
            data=arrays.data.tobytes(), received=received, lost=arrays.lost, collided=arrays.collided,
            chosen=arrays.chosen, reason=arrays.reason, digest=arrays.digest, score=arrays.score,
            offset_ns=np.zeros(arrays.sent.shape, np.int64), track=np.concatenate((start, arrays.position)),
            velocity=arrays.velocity, command=arrays.command, goal=arrays.goal, heard=heard, results=self.summary(),
        )  # fmt: skip


def simulate(
    run: RunConfig,
    *,
    shared_table: bool | None = None,
    log: bool = False,
    frames: bool = False,
    observer: int = 0,
) -> Flight:
    """Flies one run.

    :param run: the run.
    :param shared_table: one table for all agents; None: where :func:`may_share` allows it.
    :param log: keep what happened in every slot.
    :param frames: keep the bytes of frames in it, too.
    :param observer: id of the agent whose knowledge the log has; 0: none.
    """
    begun = time.perf_counter()
    scenario = make_scenario(run.swarm)
    shared = may_share(run) if shared_table is None else shared_table
    swarm = with_key(make_swarm(run.swarm, scenario, shared_table=shared))
    writer = SlotWriter(swarm, observer, frames) if log else None
    metrics = FlightMetrics(run, scenario)
    heard: HeardFrames | None = None
    if run.swarm.policy_row.unslotted:
        heard = _fly_unslotted(swarm, Channel(run.air), metrics, writer)
    else:
        _fly(swarm, Channel(run.air), metrics, writer)
    arrays = None if writer is None else writer.finish()
    return Flight(run, scenario, metrics, swarm, arrays, time.perf_counter() - begun, heard)


def complete_slot(
    swarm: Swarm, channel: Channel, metrics: FlightMetrics, slot: int, senders: Sequence[int], length: int
) -> tuple[Verdict, str]:
    """Carry the frames of a slot, which are encoded already, and close it.

    :param senders: positions in ``ids`` of those that send.
    :param length: bytes of each frame on the air.
    :returns: the channel's verdict, and why the flight is over now, or "".
    """
    lengths = [length] * len(senders)
    verdict = channel.arbitrate(slot, [swarm.ids[index] for index in senders], lengths, swarm.position)
    swarm.complete(slot, senders, verdict.received, verdict.outcome == SUCCESS)
    return verdict, metrics.update(slot, swarm.track, swarm, verdict.outcome, lengths)


def _fly(swarm: Swarm, channel: Channel, metrics: FlightMetrics, log: SlotWriter | None) -> None:
    """Fly slots until the flight is over: in C as far as agents and channel are built in and simple."""
    flight, received = ffi.new("sim_flight *"), ffi.new("uint8_t[]", swarm.config.agents)
    flight.swarm, flight.metrics, flight.received = swarm.kernel, metrics.kernel, received
    flight.course = ffi.NULL if swarm.course is None else swarm.course.kernel
    flight.log = ffi.NULL if log is None else log.kernel
    metrics.use_arrays(swarm.track, swarm)
    if swarm.course is None:
        swarm.scenario.advance(0, swarm)  # once and for all
    whole, length, count, until = swarm.all_in_c, swarm.config.frame_length, 1, 0
    while not metrics.end:
        slot = flight.slot
        if whole and slot >= until:
            until = channel.fill_losses(slot, flight.losses)
        if slot < until:
            if log is not None:
                log.make_room()
            begun = time.perf_counter()
            lib.dtsa_sim_run(flight, min(count, until - slot))
            spent = time.perf_counter() - begun
            count = max(1, min(4 * count, int((flight.slot - slot) * _CALL_S / max(spent, 1e-6))))
        else:
            swarm.scenario.advance(slot, swarm)
            senders = swarm.begin(slot)
            if not swarm.shared:
                metrics.compare_tables(slot, swarm.digest, swarm.chosen)
            if log is not None:
                log.open_slot()
            verdict, _ = complete_slot(swarm, channel, metrics, slot, senders, length)
            if log is not None:
                log.close_slot(slot, verdict)
            flight.slot = slot + 1
    metrics.count_frames(length, metrics.kernel.frames)


def _fly_unslotted(
    swarm: Swarm, channel: Channel, metrics: FlightMetrics, log: SlotWriter | None
) -> HeardFrames | None:
    """The same for agents that send at any instant: what arrives in a slot is heard in it; with a log: what was."""
    traffic = UnslottedTraffic(swarm, channel)
    heard: list[tuple[int, int, bytes, NDArray[np.bool_]]] = []  # row and slot, data, by, as in HeardFrames
    slot, over = 0, ""
    while not over:
        swarm.scenario.advance(slot, swarm)
        carried = traffic.slot(slot)
        if log is not None:
            log.open_slot()
        metrics.compare_tables(slot, swarm.digest, swarm.chosen)
        swarm.fly(slot)
        arrived = [(slot, frame, mask) for frame, mask in carried.heard]
        for at, frame, mask in (*arrived, *carried.combined):
            swarm.hear(at, frame, mask)
            if log is not None:
                heard.append((slot, at, frame, mask))
        swarm.end(slot)
        over = metrics.update(slot, swarm.track, swarm, carried.outcome, carried.lengths)
        if log is not None:
            nothing = (0,) * len(carried.senders)
            log.close_slot(slot, Verdict(carried.outcome, carried.senders, None, nothing, nothing))
        slot += 1
    if log is None:
        return None
    row, taken_as = (np.array([entry[k] for entry in heard], np.int64) for k in (0, 1))
    by = np.array([mask for *_, mask in heard], np.bool_).reshape(len(heard), len(swarm.ids))
    none = np.zeros(len(heard), np.int64)
    return HeardFrames(row, none, taken_as, none, by, none.astype(np.bool_), [data for _, _, data, _ in heard])
