"""How old the agents' knowledge of each other was, and how wrong their estimates, slot by slot."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Scenario, Swarm, make_scenario
from dtsa_agent.core.errors import DtsaError
from dtsa_bench.recordings.bag.run import RecordedRun, recorded_config
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.runs.hearing import Hearing, sentence
from dtsa_bench.runs.metrics import FlightMetrics, metrics_tables

from .followed import Ages, Followed, Observed


@dataclass(frozen=True, slots=True)
class _Usable:
    """A run that can be followed, or why it cannot."""

    config: RunConfig | None
    scenario: Scenario | None
    why_not: str = ""


def _usable(run: RecordedRun) -> _Usable:
    try:
        config = recorded_config(run.config)
        scenario = make_scenario(config.swarm)
    except (DtsaError, TypeError, ValueError) as error:
        note = f"Ages, estimates and results are left out: the configuration cannot be used ({error})."
        return _Usable(None, None, note)
    complete = len(run.slots) and np.array_equal(run.slots, np.arange(len(run.slots)))
    everyone = np.array_equal(run.motion.ids, np.arange(1, run.agents + 1))
    if complete and run.merged is not None and run.agents == config.swarm.agents:
        return _Usable(config, scenario)
    if not complete or not everyone or run.agents != config.swarm.agents:
        missing = run.missing or "agents of the configuration"
        note = f"Ages, estimates and results are left out: {missing} are missing in the bag."
        return _Usable(None, scenario, note)
    if not any(run.frames.data):
        return _Usable(None, scenario, "Ages and estimates are left out: the bag holds no frames.")
    return _Usable(config, scenario)


def why_without_ages(run: RecordedRun) -> str:
    """Why a bag does not hold enough to know what the agents knew; empty: it does."""
    return _usable(run).why_not


def follow_run(run: RecordedRun) -> Followed:
    """What the agents knew of each other, and the results, by the one definition of `FlightMetrics`."""
    usable = _usable(run)
    if usable.config is None or usable.scenario is None:
        return Followed(usable.scenario, None, {}, [usable.why_not])
    config, scenario = usable.config, usable.scenario
    if run.merged is not None:
        from .merged import follow_merged  # other bags need nothing of it

        return follow_merged(run, config, scenario)
    metrics, hearing = FlightMetrics(config, scenario), Hearing(run.agents)
    ages = _means(run, _tables(run, config, scenario), metrics, scenario.moving, hearing)
    notes = [sentence(problem)] if (problem := hearing.problem()) else []
    if config.swarm.steps > 1 and len(run.motion.time_ns) < config.swarm.steps * len(run.slots):
        notes.append("Distances are those at the ends of slots; within a slot agents may have been closer.")
    return Followed(scenario, ages, metrics.summary(), notes)


def observed(run: RecordedRun) -> Iterator[Observed]:
    """What each observer knew, slot by slot; nothing where the bag does not hold enough."""
    usable = _usable(run)
    if usable.config is None or usable.scenario is None:
        return
    if run.merged is not None:
        from .merged import observed_merged

        yield from observed_merged(run, usable.config)
        return
    tables, moving, agents = _tables(run, usable.config, usable.scenario), usable.scenario.moving, run.agents
    others = ~np.eye(agents, dtype=bool)
    for slot, truth in _steps(run, tables, None):
        heard = np.broadcast_to(tables.sent_slot, (agents, agents))  # one table may stand for all
        row, column = np.nonzero(others & (heard >= 0))
        gap = np.sqrt(((tables.estimate_position - truth) ** 2).sum(axis=1))
        yield Observed(
            slot,
            row + 1,
            column + 1,
            slot - heard[row, column],
            np.broadcast_to(gap, (agents, agents))[row, column],
            np.broadcast_to((tables.in_ap != 0) & moving, (agents, agents))[row, column],
        )


def _tables(run: RecordedRun, config: RunConfig, scenario: Scenario) -> Swarm:
    """Tables like those of the agents: one that hears everything, or one an agent."""
    heard_by_all = run.frames.lost.sum() == 0 and run.frames.collided.sum() == 0
    return metrics_tables(config, scenario, everyone=not heard_by_all)


def _steps(
    run: RecordedRun, tables: Swarm, metrics: FlightMetrics | None, hearing: Hearing | None = None
) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Feed the recorded frames to the tables, and the metrics with what they then know.

    :returns: each slot, and where the agents truly were at its end, (3, N) m, frame map.
    """
    count = len(run.slots)
    starts = np.searchsorted(run.frames.slot, np.arange(count + 1))
    # Control instants of a slot: after its start, up to its end.
    edges = run.start_ns + np.arange(count + 1) * run.slot_ns
    moments = np.searchsorted(run.motion.time_ns, edges, side="right")
    shared = len(tables.observer) == 1 and tables.observer[0] < 0
    for slot in range(count):
        for index in range(starts[slot], starts[slot + 1]):
            mask = None
            if not shared:
                mask = run.frames.received[index].astype(np.uint8)
                mask[run.frames.sender[index] - 1] = 1  # who sends knows what it said
            data = run.frames.data[index]
            if data and tables.hear(slot, data, mask) and hearing is not None:
                hearing.take_in(run.frames.received[index])
        if hearing is not None:
            known = [index for index in range(starts[slot], starts[slot + 1]) if run.frames.data[index]]
            hearing.slot(len(known), run.frames.received[known])
        tables.end(slot)
        last = max(1, moments[slot + 1])
        track = np.ascontiguousarray(run.motion.position[min(moments[slot], last - 1) : last])
        if metrics is not None:
            lengths = [len(data) for data in run.frames.data[starts[slot] : starts[slot + 1]]]
            metrics.update(slot, track, tables, int(run.outcome[slot]), lengths)
        tables.estimate(slot + 1)
        yield slot, track[-1]


def _means(
    run: RecordedRun, tables: Swarm, metrics: FlightMetrics, moving: NDArray[np.bool_], hearing: Hearing
) -> Ages:
    """Follow a run; means over the observers."""
    count, agents = len(run.slots), run.agents
    age = np.full((count, agents), np.nan)
    error = np.full((count, agents), np.nan)
    watching = np.zeros((count, agents), np.int64)
    shared = len(tables.observer) == 1 and tables.observer[0] < 0
    own = np.zeros((len(tables.observer), agents), dtype=bool)
    if not shared:
        own[np.arange(len(own)), tables.observer] = True
    for slot, truth in _steps(run, tables, metrics, hearing):
        counted = (tables.in_ap != 0) & (tables.sent_slot >= 0) & moving & ~own
        observers = counted.sum(axis=0)
        some = observers > 0
        old = np.where(counted, slot - tables.sent_slot, 0).sum(axis=0)
        gap = tables.estimate_position - truth
        wrong = np.where(counted, np.sqrt(np.einsum("vik,vik->vk", gap, gap)), 0).sum(axis=0)
        age[slot, some] = old[some] / observers[some]
        error[slot, some] = wrong[some] / observers[some]
        watching[slot] = observers * (agents - 1 if shared else 1)
    return Ages(run.slots, age, error, watching, np.arange(count) >= agents)
