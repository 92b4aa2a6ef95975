"""pyrvo's ORCA step (RVO2, C++, two dimensions) beside ours (three dimensions) on the very same states.

The states are those of a flight of our own: N agents exchange places across a circle, everyone knows
everything; every few control instants position, velocity and preferred velocity of all agents are handed to
pyrvo, and one `do_step` is timed (neighbour search, half-planes, linear programs, moving). Nothing but
`do_step` is inside the timed part. Ours is timed on the same states: avoidance of all agents, and the
vehicles' step.

pyrvo's settings, each measured:
  same-reach  neighbours within 3.336 m = R_c + 2 v_max T, all of them, horizon 1 s: what our avoider looks at
  ten         the same reach and horizon, at most 10 neighbours: RVO2's customary limit
  customary   RVO2's own circle example: neighbours within 15 m, at most 10 of them, horizon 10 s
Radius (half of R_c), largest speed and time step are ours in all three.

    PYTHONPATH=tools python -m dtsa_dev.benchmark.pyrvo_step --agents 18 70 200
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")  # pyrvo: one thread, as ours

import numpy as np
import pyrvo
from numpy.typing import NDArray

from dtsa_agent.core import Swarm, SwarmConfig
from dtsa_agent.core.settings.flight_models import FLIGHT_MODELS

Array = NDArray[np.float64]
State = tuple[Array, Array, Array]  # position, velocity, preferred velocity, each (3, N)

MODEL = FLIGHT_MODELS["orca"]
STEP_S = 0.01
REACH_M = MODEL.avoider.radius + 2 * MODEL.avoider.v_max * MODEL.avoider.horizon
# name: neighbour distance m, most neighbours (0: all), time horizon s
SETTINGS: dict[str, tuple[float, int, float]] = {
    "same-reach": (REACH_M, 0, MODEL.avoider.horizon),
    "ten": (REACH_M, 10, MODEL.avoider.horizon),
    "customary": (15.0, 10, 10.0),
}


def knowing_swarm(agents: int, seed: int) -> Swarm:
    """A swarm that knows everything; one control instant a slot.

    :param agents: N.
    :param seed: seed of the scenario.
    """
    config = SwarmConfig(agents=agents, avoider="orca", estimator="oracle", seed=seed)
    assert config.slot_s / config.steps == STEP_S
    return Swarm(config, shared_table=True)


def flight_states(agents: int, seed: int, every: int) -> tuple[list[State], Array]:
    """States of a whole flight with perfect knowledge, every so many control instants; and the goals.

    :param agents: N.
    :param seed: seed of the scenario.
    :param every: keep one state in so many.
    """
    swarm, params = knowing_swarm(agents, seed), MODEL.avoider
    position, velocity, goal = swarm.position, swarm.velocity, swarm.goal
    states: list[State] = []
    for step in range(100_000):
        if step % every == 0:
            away = params.gain * (goal - position)
            speed = np.maximum(np.linalg.norm(away, axis=0), 1e-9)
            states.append((position.copy(), velocity.copy(), away * np.minimum(1.0, params.v_max / speed)))
        swarm.fly(0)
        if np.all(np.linalg.norm(goal - position, axis=0) < 0.3):
            break
    return states, goal.copy()


def time_pyrvo(states: list[State], setting: str, repeats: int) -> float:
    """Mean over the states of the median time of one `do_step`, s."""
    reach, most, horizon = SETTINGS[setting]
    agents = states[0][0].shape[1]
    speed = MODEL.avoider.v_max
    simulator = pyrvo.RVOSimulator(STEP_S, reach, most or agents, horizon, horizon, MODEL.avoider.radius / 2, speed)
    for x, y in states[0][0][:2].T:
        simulator.add_agent((float(x), float(y)))
    times = []
    for position, velocity, wish in states:
        samples = []
        for _ in range(repeats):
            for k in range(agents):
                simulator.set_agent_position(k, (float(position[0, k]), float(position[1, k])))
                simulator.set_agent_velocity(k, (float(velocity[0, k]), float(velocity[1, k])))
                simulator.set_agent_pref_velocity(k, (float(wish[0, k]), float(wish[1, k])))
            began = time.perf_counter()
            simulator.do_step()
            samples.append(time.perf_counter() - began)
        times.append(statistics.median(samples))
    return statistics.fmean(times)


def time_ours(states: list[State], goal: Array, repeats: int) -> float:
    """The same of our avoider and vehicles, s."""
    swarm = knowing_swarm(goal.shape[1], 1)
    swarm.goal[:] = goal
    times = []
    for position, velocity, _ in states:
        samples = []
        for _ in range(repeats):
            swarm.position[:], swarm.velocity[:] = position, velocity
            began = time.perf_counter()
            swarm.fly(0)
            samples.append(time.perf_counter() - began)
        times.append(statistics.median(samples))
    return statistics.fmean(times)


def measure(agents: int, seed: int = 1, every: int = 10, repeats: int = 5) -> dict[str, float | int]:
    """Microseconds of one step of all agents, averaged over a whole flight.

    :param agents: N, all moving.
    :param seed: seed of the scenario.
    :param every: use one state in so many.
    :param repeats: samples a state, of which the median counts.
    """
    states, goal = flight_states(agents, seed, every)
    row: dict[str, float | int] = {"agents": agents, "states": len(states)}
    row["ours_us"] = time_ours(states, goal, repeats) * 1e6
    for setting in SETTINGS:
        row[f"pyrvo_{setting}_us"] = time_pyrvo(states, setting, repeats) * 1e6
    return row


def main() -> int:
    """Prints a table or JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--agents", type=int, nargs="+", default=[18, 70, 200])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    rows = [measure(n, args.seed) for n in args.agents]
    if args.json:
        print(json.dumps(rows, indent=2))
        return 0
    names = "".join(f"{'pyrvo ' + setting:>18} {'ratio':>6}" for setting in SETTINGS)
    print(f"{'agents':>6} {'states':>6} {'ours us':>8}{names}")
    for row in rows:
        line = f"{row['agents']:6d} {row['states']:6d} {row['ours_us']:8.1f}"
        for setting in SETTINGS:
            value = row[f"pyrvo_{setting}_us"]
            line += f"{value:18.1f} {value / row['ours_us']:6.1f}"
        print(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
