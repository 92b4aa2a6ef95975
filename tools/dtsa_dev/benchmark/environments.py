"""Environments for learning: agent-steps a second on one core, beginnings of flights included, beside `simulate`."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any

import dtsa
from dtsa_bench.simulation.simulate import simulate

Row = dict[str, Any]
WHAT = "environment"
AGENTS = 12
SETTINGS: tuple[dict[str, Any], ...] = ({}, {"loss": 0.1})
LIMIT = 20_000  # agent-steps/s with twelve agents


def environments(flights: int = 5, repeats: int = 5) -> Iterator[Row]:
    """TDMA, told by actions; the policy itself costs next to nothing.

    :param flights: in a sample.
    :param repeats: samples, of which the median counts.
    """
    for settings in SETTINGS:
        slots = simulate(dtsa.run_config(policy="tdma", agents=AGENTS, **settings)).metrics.slots * flights
        flown_us = statistics.median(_simulated(settings, slots) for _ in range(repeats))
        row: Row = {"what": WHAT, "form": "dictionaries", "agents": AGENTS, "flights": 1, "loss": 0.0, **settings}
        try:
            step = _dictionaries(settings)
        except dtsa.ConfigError as missing:
            yield {**row, "left_out": str(missing)}
            continue
        slot_us = statistics.median(_slot_us(step, slots) for _ in range(repeats))
        speed = {"agent_steps_per_s": 1e6 * AGENTS / slot_us, "slot_us": slot_us, "over_simulate": slot_us / flown_us}
        yield {**row, **speed, "limit_per_s": LIMIT}


def targets(row: Row) -> list[tuple[str, float, float, bool]]:
    """What the project asks of itself: name, value, limit, whether the limit is the least that is allowed.

    :param row: of :func:`environments`.
    """
    if "left_out" in row:
        return []
    what = f"environment of {row['agents']}, {row['form']}, loss {row['loss']:g} [agent-steps/s]"
    return [(what, row["agent_steps_per_s"], row["limit_per_s"], True)]


def _slot_us(step: Callable[[], None], steps: int) -> float:
    """Time of the processor for one slot: what else the machine does counts less."""
    begun = time.process_time()
    for _ in range(steps):
        step()
    return 1e6 * (time.process_time() - begun) / steps


def _simulated(settings: dict[str, Any], slots: int) -> float:
    """The same for `simulate`, every agent with a table of its own."""
    begun, flown, seed = time.process_time(), 0, 1
    while flown < slots:
        run = dtsa.run_config(policy="tdma", agents=AGENTS, seed=seed, **settings)
        flown += simulate(run, shared_table=False).metrics.slots
        seed += 1
    return 1e6 * (time.process_time() - begun) / flown


def _dictionaries(settings: dict[str, Any]) -> Callable[[], None]:
    env = dtsa.env.parallel_env(agents=AGENTS, **settings)
    names = env.possible_agents
    turns = [{name: int(name == owner) for name in names} for owner in names]
    slot = 0

    def step() -> None:
        nonlocal slot
        if not env.agents:
            env.reset()
            slot = 0
        env.step(turns[slot % AGENTS])
        slot += 1

    return step
