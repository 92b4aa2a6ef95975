"""How old the agents' knowledge of each other was, and how wrong their estimates, slot by slot; and the results."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Swarm
from dtsa_agent.core.errors import DtsaError
from dtsa_agent.core.settings.scenario import make_scenario
from dtsa_bench.runs.delivery import DeliveryCounts, as_sentence
from dtsa_bench.runs.metrics import FlightMetrics

from .arrays import UNKNOWN, FlightArrays, recorded_config
from .merged_flight import follow_merged, observed_merged
from .replay import MeanAges, ObservedPairs, knowledge_tables, replay_tables


@dataclass(frozen=True, slots=True)
class Knowledge:
    """What a log gives when it is followed slot by slot; nothing where it does not hold enough."""

    ages: MeanAges | None
    summary: dict[str, Any]  # as in summary.json
    notes: list[str] = field(default_factory=list)  # what is left out, and why


def knowledge_of(log: FlightArrays) -> Knowledge:
    """What the agents of a log knew; computed once."""
    found = log.__dict__.get("_knowledge")
    if not isinstance(found, Knowledge):
        found = log.__dict__["_knowledge"] = follow(log)
    return found


def why_without_ages(log: FlightArrays) -> str:
    """Why a log does not hold enough to know what the agents knew; empty: it does."""
    try:
        config = recorded_config(log.settings)
        make_scenario(config.swarm)
    except (DtsaError, TypeError, ValueError) as error:
        return f"Ages, estimates and results are left out: the configuration cannot be used ({error})."
    complete = len(log) and log.recorded.all() and log.agents == config.swarm.agents
    if not complete or (log.merged is None and not log.known.any(axis=0).all()):
        return f"Ages, estimates and results are left out: {log.missing or 'all slots'} are missing in the bag."
    return ""


def follow(log: FlightArrays) -> Knowledge:
    """What the agents knew of each other, and the results, by the one definition of `FlightMetrics`."""
    why = why_without_ages(log)
    if why:
        return Knowledge(None, {}, [why])
    if log.merged is not None:
        return Knowledge(*follow_merged(log))
    config, scenario = log.config, log.scenario
    assert scenario is not None
    tables, metrics, delivery = knowledge_tables(log), FlightMetrics(config, scenario), DeliveryCounts(log.agents)
    ages, moving, shared = MeanAges.empty(len(log), log.agents), scenario.moving, _is_shared(tables)
    ages.results[log.agents :] = True
    own = np.zeros((len(tables.observer), log.agents), np.bool_)
    if not shared:
        own[np.arange(len(own)), tables.observer] = True
    track, lengths = _filled(log.track), log.length
    for row in replay_tables(log, tables, delivery):
        metrics.compare_tables(row, log.digest[row], log.chosen[row])
        outcome = int(log.outcome[row])
        sizes = lengths[row][lengths[row] > 0].tolist()
        metrics.update(row, track[row + 1], tables, outcome if outcome < UNKNOWN else 0, sizes)
        _estimate(tables, row, track[row + 1, -1])
        counted = (tables.in_ap != 0) & (tables.sent_slot >= 0) & moving & ~own
        gap = tables.estimate_position - track[row + 1, -1]
        ages.set_means(row, counted, row - tables.sent_slot, np.sqrt(np.einsum("vik,vik->vk", gap, gap)))
    if shared:
        ages.observers[:] *= log.agents - 1
    notes = [as_sentence(problem)] if (problem := delivery.problem()) else []
    return Knowledge(ages, metrics.summary(), notes)


def observed(log: FlightArrays) -> Iterator[ObservedPairs]:
    """What each observer knew, slot by slot; nothing where the log does not hold enough."""
    if why_without_ages(log):
        return
    if log.merged is not None:
        yield from observed_merged(log)
        return
    tables, moving, agents = knowledge_tables(log), log.moving, log.agents
    others, track = ~np.eye(agents, dtype=np.bool_), _filled(log.track)
    for row in replay_tables(log, tables):
        _estimate(tables, row, track[row + 1, -1])
        heard = np.broadcast_to(tables.sent_slot, (agents, agents))  # one table may stand for all
        at, column = np.nonzero(others & (heard >= 0))
        gap = np.sqrt(((tables.estimate_position - track[row + 1, -1]) ** 2).sum(axis=1))
        counted = np.broadcast_to((tables.in_ap != 0) & moving, (agents, agents))[at, column]
        error = np.broadcast_to(gap, (agents, agents))[at, column]
        yield ObservedPairs(row, at + 1, column + 1, row - heard[at, column], error, counted)


def _is_shared(tables: Swarm) -> bool:
    return len(tables.observer) == 1 and int(tables.observer[0]) < 0


def _estimate(tables: Swarm, row: int, position: NDArray[np.float64]) -> None:
    """Where the agents take each other to be at the end of a slot."""
    if tables.config.estimator_row.needs_everybody:
        tables.estimate_position[:] = position
    else:
        tables.estimate(row + 1)


def _filled(track: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions, with the last known one where an agent has not told: its vehicle is taken to stay."""
    lost = np.isnan(track).any(axis=(1, 2))  # (S + 1, N)
    if not lost.any():
        return track
    filled = track.copy()
    for row in np.flatnonzero(lost.any(axis=1)).tolist():
        gone = lost[row]
        filled[row][:, :, gone] = filled[row - 1, -1][:, gone] if row else 0.0
    return filled
