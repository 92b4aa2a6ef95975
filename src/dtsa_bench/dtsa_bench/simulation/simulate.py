"""The Monte Carlo engine: one flight without ROS, over the very core that the nodes run.

For the same :class:`RunConfig` it gives the same sender in every slot and the same positions as `fly`, bit
for bit.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Scenario, Swarm, make_scenario
from dtsa_agent.core.kernel import ffi, lib
from dtsa_agent.core.plugins import make_swarm
from dtsa_agent.keys import with_key
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.runs.metrics import FlightMetrics, may_share
from dtsa_channel_sim import Channel, Verdict
from dtsa_channel_sim.model.verdict import SUCCESS

from .slot_arrays import SlotArrays, SlotWriter
from .unslotted import UnslottedTraffic

_CALL_S = 0.02  # a call of C takes about so long: after it, Ctrl-C works


class AcceptedFrame(NamedTuple):
    """A frame that agents accepted, in a flight of agents that send at any instant."""

    row: int  # slot in which they did
    slot: int  # of the state in it
    data: bytes
    receivers: NDArray[np.bool_]  # (N,) agents that accepted it


@dataclass(frozen=True, slots=True)
class SimulatedFlight:
    """A simulated flight."""

    run: RunConfig
    scenario: Scenario
    metrics: FlightMetrics
    swarm: Swarm  # as it was at the end
    log: SlotArrays | None  # what happened in its slots
    wall_time_s: float
    accepted: list[AcceptedFrame] | None = None  # in a log of agents that send at any instant

    def summary(self) -> dict[str, Any]:
        """The results, with the keys of ``summary.json``."""
        counts = {"malformed": self.swarm.malformed, "foreign": self.swarm.foreign}
        return self.metrics.summary(self.wall_time_s) | counts


def simulate(
    run: RunConfig, *, shared_table: bool | None = None, log: bool = False, frames: bool = False, observer: int = 0,
    slots: int | None = None, changes: Mapping[int, Mapping[str, Any]] | None = None,
    progress: Callable[[int], None] | None = None,
) -> SimulatedFlight:  # fmt: skip
    """Flies one run.

    :param shared_table: one table for all agents; None: where :func:`may_share` allows it.
    :param log: keep what happened in every slot.
    :param frames: keep the bytes of frames in it, too.
    :param observer: id of the agent whose knowledge the log has; 0: none.
    :param slots: fly so many, whether or not the flight is over by then; None: until it is over.
    :param changes: of the channel's settings, by the first slot in which they hold.
    :param progress: is called with the next slot now and then.
    """
    begun = time.perf_counter()
    scenario = make_scenario(run.swarm)
    shared = may_share(run) if shared_table is None else shared_table
    swarm = with_key(make_swarm(run.swarm, scenario, shared_table=shared))
    writer = SlotWriter(swarm, observer, frames) if log else None
    metrics, channel = FlightMetrics(run, scenario), Channel(run.air)
    for slot, values in sorted((changes or {}).items()):
        channel.set(slot=slot, **values)
    accepted: list[AcceptedFrame] | None = None
    if run.swarm.policy_row.unslotted:
        accepted = _fly_unslotted(swarm, channel, metrics, writer)
    else:
        _fly(swarm, channel, metrics, writer, slots, progress)
    arrays = None if writer is None else writer.finish()
    return SimulatedFlight(run, scenario, metrics, swarm, arrays, time.perf_counter() - begun, accepted)


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


def _fly(
    swarm: Swarm, channel: Channel, metrics: FlightMetrics, log: SlotWriter | None, slots: int | None,
    progress: Callable[[int], None] | None,
) -> None:  # fmt: skip
    """Fly slots, until the flight is over or a number of them: in C as far as agents and channel are simple."""
    flight, received = ffi.new("sim_flight *"), ffi.new("uint8_t[]", swarm.config.agents)
    flight.swarm, flight.metrics, flight.received = swarm.kernel, metrics.kernel, received
    flight.course = ffi.NULL if swarm.course is None else swarm.course.kernel
    flight.log = ffi.NULL if log is None else log.kernel
    metrics.use_arrays(swarm.track, swarm)
    if swarm.course is None:
        swarm.scenario.advance(0, swarm)  # once and for all
    whole, length, count, until = swarm.all_in_c, swarm.config.frame_length, 1, 0
    while not metrics.end if slots is None else flight.slot < slots:
        slot = flight.slot
        if progress is not None:
            progress(slot)
        if whole and slot >= until:
            until = channel.fill_losses(slot, flight.losses)
        if slot < until:
            if log is not None:
                log.make_room()
            begun = time.perf_counter()
            lib.dtsa_sim_run(flight, min(count, until - slot, until if slots is None else slots - slot))
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
) -> list[AcceptedFrame] | None:
    """The same for agents that send at any instant: what arrives in a slot is heard in it; with a log: what was."""
    traffic = UnslottedTraffic(swarm, channel)
    accepted: list[AcceptedFrame] = []
    slot, over = 0, ""
    while not over:
        swarm.scenario.advance(slot, swarm)
        swarm.digest[:] = swarm.table_hash
        carried = traffic.slot(slot)
        if log is not None:
            log.open_slot()
        metrics.compare_tables(slot, swarm.digest, swarm.chosen)
        swarm.fly(slot)
        for at, frame, mask in (*carried.heard, *carried.combined):
            swarm.hear(at, frame, mask)
            if log is not None:
                accepted.append(AcceptedFrame(slot, at, frame, mask))
        swarm.end(slot)
        over = metrics.update(slot, swarm.track, swarm, carried.outcome, carried.lengths)
        if log is not None:
            nobody, nothing = np.zeros((len(carried.senders), len(swarm.ids)), np.bool_), (0,) * len(carried.senders)
            log.close_slot(slot, Verdict(carried.outcome, carried.senders, nobody, nothing, nothing))
        slot += 1
    return None if log is None else accepted
