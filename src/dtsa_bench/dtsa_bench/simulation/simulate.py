"""The Monte Carlo engine: one flight without ROS, over the very core that the nodes run.

For the same :class:`RunConfig` it gives the same sender in every slot and the same positions as `fly`, bit
for bit.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Scenario, Swarm, make_scenario
from dtsa_agent.core.plugins.entry_points import make_swarm, shareable
from dtsa_agent.keys import with_key
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.runs.metrics import FlightMetrics
from dtsa_channel_sim import Channel

from .slotted import SlottedTraffic
from .unslotted import UnslottedTraffic

Array = NDArray[np.float64]


@dataclass(slots=True)
class Trace:
    """What happened in every slot, for tests and figures; S control instants a slot, N agents."""

    senders: list[tuple[int, ...]] = field(default_factory=list)  # ids
    outcomes: list[int] = field(default_factory=list)
    reasons: list[int] = field(default_factory=list)  # index into REASONS, of ``observer``
    chosen: list[int] = field(default_factory=list)  # id that ``observer`` took for the sender, 0: nobody
    scores: list[float] = field(default_factory=list)  # priority g of that one, 0 without one
    tracks: list[Array] = field(default_factory=list)  # (S, 3, N) m, frame map, true positions
    estimates: list[Array] = field(default_factory=list)  # (3, N) m, of ``observer`` for the start of the next slot
    heard: list[Array] = field(default_factory=list)  # (3, N) m, last received positions of ``observer``
    heard_slot: list[NDArray[np.int64]] = field(default_factory=list)  # (N,) the slots they are from, -1: never
    in_ap: list[NDArray[np.uint8]] = field(default_factory=list)  # (N,) A_p of ``observer``

    def positions(self) -> Array:
        """True positions at all control instants, (T, 3, N), m, frame map."""
        return np.concatenate(self.tracks)


@dataclass(frozen=True, slots=True)
class Flight:
    """A simulated flight."""

    run: RunConfig
    scenario: Scenario
    metrics: FlightMetrics
    swarm: Swarm  # as it was at the end
    trace: Trace | None
    wall_time_s: float

    def summary(self) -> dict[str, Any]:
        """The results, with the keys of ``summary.json``."""
        result = self.metrics.summary(self.wall_time_s)
        result["malformed"], result["foreign"] = self.swarm.malformed, self.swarm.foreign
        return result


def may_share(run: RunConfig) -> bool:
    """Whether one table may stand for all agents: nothing is ever lost, and all would decide the same.

    In slots that a frame may outlast the channel names each frame's receivers, for which one table has no room.

    :param run: the run.
    """
    air, swarm = run.air, run.swarm
    lossless = not (
        air.loss
        or air.burst_length
        or air.p_good
        or air.jam
        or air.partition
        or air.range_m
        or air.capture_db
        or air.loss_matrix
        or air.link_loss
        or air.losses
        or air.schedule
        or air.airtime.total_ns(air.airtime.longest) > air.slot_ns
    )
    return lossless and shareable(swarm)


def simulate(
    run: RunConfig,
    *,
    shared_table: bool | None = None,
    trace: bool = False,
    observer: int = 1,
) -> Flight:
    """Flies one run.

    :param run: the run.
    :param shared_table: one table for all agents; None: where :func:`may_share` allows it.
    :param trace: keep what happened in every slot.
    :param observer: id whose table the trace follows.
    """
    begun = time.perf_counter()
    scenario = make_scenario(run.swarm)
    shared = may_share(run) if shared_table is None else shared_table
    kept = Trace() if trace else None
    swarm = with_key(make_swarm(run.swarm, scenario, shared_table=shared))
    metrics = FlightMetrics(run, scenario)
    fly = _fly_unslotted if run.swarm.policy_row.unslotted else _fly
    fly(swarm, Channel(run.air), metrics, kept, observer)
    return Flight(run, scenario, metrics, swarm, kept, time.perf_counter() - begun)


def _fly(swarm: Swarm, channel: Channel, metrics: FlightMetrics, kept: Trace | None, observer: int) -> None:
    """The slots of a flight until it is over. Everything in here runs once a slot: keep it bare."""
    advance, begin, update = swarm.scenario.advance, swarm.begin, metrics.update
    carry, track = SlottedTraffic(swarm, channel).slot, swarm.track
    table = 0 if swarm.shared else observer - 1
    compare = None if swarm.shared else metrics.compare_tables  # one table cannot differ from itself
    slot = 0
    while True:
        advance(slot, swarm)
        senders = begin(slot)
        if compare is not None:
            compare(slot, swarm.digest, swarm.chosen)
        verdict, lengths = carry(slot, senders)
        over = update(slot, track, swarm, verdict.outcome, lengths)
        if kept is not None:
            _keep(kept, swarm, slot, verdict.senders, verdict.outcome, table)
        if over:
            return
        slot += 1


def _fly_unslotted(swarm: Swarm, channel: Channel, metrics: FlightMetrics, kept: Trace | None, observer: int) -> None:
    """The same for agents that send at any instant: what arrives in a slot is heard in it."""
    traffic = UnslottedTraffic(swarm, channel)
    slot, over = 0, ""
    while not over:
        swarm.scenario.advance(slot, swarm)
        carried = traffic.slot(slot)
        metrics.compare_tables(slot, swarm.digest, swarm.chosen)
        swarm.fly(slot)
        for frame, mask in carried.heard:
            swarm.hear(slot, frame, mask)
        for sampled, frame, mask in carried.combined:
            swarm.hear(sampled, frame, mask)
        swarm.end(slot)
        over = metrics.update(slot, swarm.track, swarm, carried.outcome, carried.lengths)
        if kept is not None:
            _keep(kept, swarm, slot, carried.senders, carried.outcome, observer - 1)
        slot += 1


def _keep(kept: Trace, swarm: Swarm, slot: int, senders: tuple[int, ...], outcome: int, table: int) -> None:
    kept.senders.append(senders)
    kept.outcomes.append(outcome)
    kept.reasons.append(int(swarm.reason[table]))
    kept.chosen.append(int(swarm.chosen[table]))
    kept.scores.append(float(swarm.score[table]))
    kept.tracks.append(swarm.track.copy())
    swarm.estimate(slot + 1)
    kept.estimates.append(swarm.estimate_position[table].copy())
    kept.heard.append(swarm.sent_position[table].copy())
    kept.heard_slot.append(swarm.sent_slot[table].copy())
    kept.in_ap.append(swarm.in_ap[table].copy())
