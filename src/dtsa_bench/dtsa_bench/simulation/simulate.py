"""The Monte Carlo engine: one flight without ROS, over the very core that the nodes run.

For the same :class:`RunConfig` it gives the same sender in every slot and the same positions as `fly`, bit
for bit.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Scenario, Swarm, make_scenario
from dtsa_agent.core.plugins.entry_points import make_swarm
from dtsa_agent.keys import with_key
from dtsa_bench.log.arrays import LogBuilder
from dtsa_bench.log.flight_log import FlightLog
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.runs.metrics import FlightMetrics, may_share
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
    log: FlightLog | None = None

    def summary(self) -> dict[str, Any]:
        """The results, with the keys of ``summary.json``."""
        result = self.metrics.summary(self.wall_time_s)
        result["malformed"], result["foreign"] = self.swarm.malformed, self.swarm.foreign
        return result


def simulate(
    run: RunConfig,
    *,
    shared_table: bool | None = None,
    trace: bool = False,
    observer: int = 1,
    log: bool = False,
) -> Flight:
    """Flies one run.

    :param run: the run.
    :param shared_table: one table for all agents; None: where :func:`may_share` allows it.
    :param trace: keep what happened in every slot.
    :param observer: id whose table the trace follows.
    :param log: keep what happened to all agents in every slot.
    """
    begun = time.perf_counter()
    scenario = make_scenario(run.swarm)
    shared = may_share(run) if shared_table is None else shared_table
    kept = Trace() if trace else None
    swarm = with_key(make_swarm(run.swarm, scenario, shared_table=shared))
    metrics = FlightMetrics(run, scenario)
    fly = _fly_unslotted if run.swarm.policy_row.unslotted else _fly
    builder = LogBuilder(run) if log else None
    fly(swarm, Channel(run.air), metrics, kept, observer, builder)
    flight = Flight(run, scenario, metrics, swarm, kept, time.perf_counter() - begun)
    return (
        flight
        if builder is None
        else replace(flight, log=FlightLog(**builder.fields(swarm.track), results=flight.summary()))
    )


def _fly(
    swarm: Swarm,
    channel: Channel,
    metrics: FlightMetrics,
    kept: Trace | None,
    observer: int,
    log: LogBuilder | None,
) -> None:
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
        if log is not None:
            log.open(swarm, {swarm.ids[index]: swarm.frame(index) for index in senders})
        verdict, lengths = carry(slot, senders)
        if log is not None:
            log.close(verdict)
        over = update(slot, track, swarm, verdict.outcome, lengths)
        if kept is not None:
            _keep(kept, swarm, slot, verdict.senders, verdict.outcome, table)
        if over:
            return
        slot += 1


def _fly_unslotted(
    swarm: Swarm,
    channel: Channel,
    metrics: FlightMetrics,
    kept: Trace | None,
    observer: int,
    log: LogBuilder | None,
) -> None:
    """The same for agents that send at any instant: what arrives in a slot is heard in it."""
    traffic = UnslottedTraffic(swarm, channel)
    slot, over = 0, ""
    while not over:
        swarm.scenario.advance(slot, swarm)
        carried = traffic.slot(slot)
        metrics.compare_tables(slot, swarm.digest, swarm.chosen)
        heard = [*((slot, frame, mask) for frame, mask in carried.heard), *carried.combined]
        if log is not None:
            log.open(swarm, {agent: swarm.frame(agent - 1) for agent in carried.senders})
            for at, frame, mask in heard:
                log.hear(at, frame, mask)
            log.close_unslotted(carried.outcome, carried.senders, heard)
        swarm.fly(slot)
        for at, frame, mask in heard:
            swarm.hear(at, frame, mask)
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
