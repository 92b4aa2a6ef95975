"""One 10 ms step of RotorPy's multirotor beside one of our vehicles: what a full rigid-body model costs.

The two are not the same model: RotorPy integrates position, velocity, attitude, body rates and rotor speeds
with an adaptive scheme in Python, ours is a point mass that answers a velocity command. The ratio says how
much of a slot's budget the choice of the vehicle takes, not that one is better. RotorPy's Crazyflie is
commanded by velocity (`cmd_vel`), its own inner loop included, as ours is.

    PYTHONPATH=tools python -m dtsa_dev.benchmark.rotorpy_step --agents 18 70 200
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time

import numpy as np
from rotorpy.vehicles.crazyflie_params import quad_params
from rotorpy.vehicles.multirotor import Multirotor

from dtsa_agent.core import Swarm, SwarmConfig

STEP_S = 0.01


def time_rotorpy(steps: int = 200) -> float:
    """Median time of one step of one RotorPy Crazyflie that follows a changing velocity command, s."""
    hover = float(np.sqrt(quad_params["mass"] * 9.81 / (quad_params["num_rotors"] * quad_params["k_eta"])))
    state = {
        "x": np.zeros(3),
        "v": np.zeros(3),
        "q": np.array([0.0, 0.0, 0.0, 1.0]),
        "w": np.zeros(3),
        "wind": np.zeros(3),
        "rotor_speeds": np.full(4, hover),
    }
    vehicle = Multirotor(quad_params, initial_state=state, control_abstraction="cmd_vel")
    samples = []
    for step in range(steps):
        turn = 2 * np.pi * step / steps
        control = {"cmd_v": np.array([np.cos(turn), np.sin(turn), 0.0])}
        began = time.perf_counter()
        state = vehicle.step(state, control, STEP_S)
        samples.append(time.perf_counter() - began)
    return statistics.median(samples)


def time_ours(agents: int, steps: int = 2000) -> float:
    """Median time of one step of all vehicles, called from Python, s."""
    config = SwarmConfig(agents=agents, avoider="orca")
    assert config.slot_s / config.steps == STEP_S
    swarm, random = Swarm(config, shared_table=True), np.random.default_rng(1)
    swarm.position[:], swarm.velocity[:], swarm.command[:] = random.normal(size=(3, 3, agents))
    samples = []
    for _ in range(steps):
        began = time.perf_counter()
        swarm.move(0)
        samples.append(time.perf_counter() - began)
    return statistics.median(samples)


def measure(agents: int, rotorpy_s: float | None = None) -> dict[str, float | int]:
    """Microseconds of one step of all agents' vehicles.

    :param agents: N.
    :param rotorpy_s: time of one RotorPy step, s; None: measure it. Agents are stepped one by one.
    """
    one = time_rotorpy() if rotorpy_s is None else rotorpy_s
    ours = time_ours(agents)
    return {
        "agents": agents,
        "ours_us": ours * 1e6,
        "rotorpy_us": agents * one * 1e6,
        "ratio": agents * one / ours,
    }


def main() -> int:
    """Prints a table or JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--agents", type=int, nargs="+", default=[18, 70, 200])
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    one = time_rotorpy()
    rows = [measure(n, one) for n in args.agents]
    if args.json:
        print(json.dumps(rows, indent=2))
        return 0
    print(f"{'agents':>6} {'ours us':>9} {'rotorpy us':>11} {'ratio':>8}")
    for row in rows:
        print(f"{row['agents']:6d} {row['ours_us']:9.2f} {row['rotorpy_us']:11.0f} {row['ratio']:8.0f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
