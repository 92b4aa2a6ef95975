"""How old the agents' knowledge of each other was, and how wrong their estimates, slot by slot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import AbstractSwarm, Scenario, make_scenario
from dtsa_agent.core.errors import DtsaError
from dtsa_bench.bag.run import RecordedRun
from dtsa_bench.metrics import FlightMetrics, metrics_tables
from dtsa_bench.run_config import RunConfig


@dataclass(frozen=True, slots=True)
class Ages:
    """By slot and agent: means over all observers that still have that agent in A_p; NaN without any."""

    slot: NDArray[np.int64]  # (M,)
    age: NDArray[np.float64]  # slots, (M, N)
    error: NDArray[np.float64]  # m, (M, N)


@dataclass(frozen=True, slots=True)
class Followed:
    """What a recorded run gives when it is followed slot by slot; nothing where the bag does not hold enough."""

    scenario: Scenario | None
    ages: Ages | None
    summary: dict[str, Any]  # as in summary.json
    notes: list[str]  # what is left out, and why


def follow_run(run: RecordedRun) -> Followed:
    """What the agents knew of each other, and the results, by the one definition of `FlightMetrics`.

    :param run: the recorded run.
    """
    try:
        config = RunConfig.from_dict(run.config if "swarm" in run.config else {"swarm": run.config})
        scenario = make_scenario(config.swarm)
    except (DtsaError, TypeError, ValueError) as error:
        note = f"Ages, estimates and results are left out: the configuration cannot be used ({error})."
        return Followed(None, None, {}, [note])
    complete = len(run.slots) and np.array_equal(run.slots, np.arange(len(run.slots)))
    everyone = np.array_equal(run.motion.ids, np.arange(1, run.agents + 1))
    if not complete or not everyone or run.agents != config.swarm.agents:
        note = "Ages, estimates and results are left out: slots or agents are missing in the bag."
        return Followed(scenario, None, {}, [note])
    if not any(run.frames.data):
        return Followed(scenario, None, {}, ["Ages and estimates are left out: the bag holds no frames."])
    heard_by_all = run.frames.lost.sum() == 0 and run.frames.collided.sum() == 0
    tables = metrics_tables(config, scenario, everyone=not heard_by_all)
    metrics = FlightMetrics(config, scenario)
    ages = follow(run, tables, metrics, scenario.moving)
    notes = []
    if config.swarm.steps > 1 and len(run.motion.time_ns) < config.swarm.steps * len(run.slots):
        notes.append("Distances are those at the ends of slots; within a slot agents may have been closer.")
    return Followed(scenario, ages, metrics.summary(), notes)


def follow(run: RecordedRun, tables: AbstractSwarm, metrics: FlightMetrics, moving: NDArray[np.bool_]) -> Ages:
    """Feed the recorded frames to tables like those of the agents, and the metrics with what they then know.

    :param run: a run whose slots are complete from 0 on and that has odometry of all agents.
    :param tables: tables only; one that hears everything, or one an agent.
    :param metrics: updated slot by slot.
    :param moving: (N,) who moves.
    """
    count, agents = len(run.slots), run.agents
    age = np.full((count, agents), np.nan)
    error = np.full((count, agents), np.nan)
    starts = np.searchsorted(run.frames.slot, np.arange(count + 1))
    # Control instants of a slot: after its start, up to its end.
    edges = run.start_ns + np.arange(count + 1) * run.slot_ns
    moments = np.searchsorted(run.motion.time_ns, edges, side="right")
    shared = len(tables.observer) == 1 and tables.observer[0] < 0
    own = np.zeros((len(tables.observer), agents), dtype=bool)
    if not shared:
        own[np.arange(len(own)), tables.observer] = True
    for slot in range(count):
        for index in range(starts[slot], starts[slot + 1]):
            mask = None
            if not shared:
                mask = run.frames.received[index].astype(np.uint8)
                mask[run.frames.sender[index] - 1] = 1  # who sends knows what it said
            if run.frames.data[index]:
                tables.hear(slot, run.frames.data[index], mask)
        tables.end(slot)
        last = max(1, moments[slot + 1])
        track = np.ascontiguousarray(run.motion.position[min(moments[slot], last - 1) : last])
        truth = track[-1]
        metrics.update(slot, track, tables, int(run.outcome[slot]))
        tables.estimate(slot + 1)
        counted = (tables.in_ap != 0) & (tables.sent_slot >= 0) & moving & ~own
        observers = counted.sum(axis=0)
        some = observers > 0
        old = np.where(counted, slot - tables.sent_slot, 0).sum(axis=0)
        gap = tables.estimate_position - truth
        wrong = np.where(counted, np.sqrt(np.einsum("vik,vik->vk", gap, gap)), 0).sum(axis=0)
        age[slot, some] = old[some] / observers[some]
        error[slot, some] = wrong[some] / observers[some]
    return Ages(run.slots, age, error)
