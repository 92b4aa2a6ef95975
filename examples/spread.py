"""Effect of a channel on an environment of others: simple_spread of mpe2, whose agents share landmarks out among them.

Each agent gives every agent, where it last heard it, a landmark, and goes to its own. It needs mpe2, and draws a
picture: ``python examples/spread.py PICTURE``.
"""

import sys

import numpy as np
from mpe2 import simple_spread_v3
from scipy.optimize import linear_sum_assignment

import dtsa.env
from dtsa_bench.drawing.style import style

AGENTS, STEPS, SEEDS = 6, 60, 100
NAMES = [f"agent_{k}" for k in range(AGENTS)]
FIRST = 4 + 2 * AGENTS  # after its own velocity and place and the landmarks: the places of the others


def of_others(agent, other):
    """Numbers of an agent's observation that another agent sends it."""
    rank = [name for name in NAMES if name != agent].index(other)
    return slice(FIRST + 2 * rank, FIRST + 2 * rank + 2)


def action(row, seen, ages):
    """Where an agent goes: left 1, right 2, down 3, up 4; landmarks and places are relative to its own."""
    landmarks = seen[4:FIRST].reshape(-1, 2)
    others = seen[FIRST : FIRST + 2 * (AGENTS - 1)].reshape(-1, 2)
    places = np.insert(others, row, 0.0, axis=0)
    cost = np.linalg.norm(places[:, None] - landmarks, axis=2)
    cost[[rank for rank, name in enumerate(NAMES) if ages.get(name) == -1]] = 0.0  # never heard: may be anywhere
    way = landmarks[linear_sum_assignment(cost)[1][row]]
    axis = int(np.abs(way).argmax())
    return 0 if np.abs(way[axis]) < 0.05 else 1 + 2 * axis + int(way[axis] > 0)


def gaps(**settings):
    """Mean distance of a landmark from the nearest agent after each step, (STEPS,)."""
    env = dtsa.env.channel(simple_spread_v3.parallel_env(N=AGENTS, max_cycles=STEPS), of_others, **settings)
    result = np.zeros((SEEDS, STEPS))
    for seed in range(SEEDS):
        observations, infos = env.reset(seed=seed)
        for step in range(STEPS):
            actions = {name: action(row, observations[name], infos[name]["age"]) for row, name in enumerate(NAMES)}
            observations, *_, infos = env.step(actions)
            landmarks = np.array([observations[name][4:FIRST].reshape(-1, 2) for name in NAMES])
            result[seed, step] = np.linalg.norm(landmarks, axis=2).min(axis=0).mean()
    return result.mean(axis=0)


def places(env):
    """Where agents are, (AGENTS, 2), m."""
    return [agent.state.p_pos for agent in env.unwrapped.world.agents]


CASES = {
    "no loss": {},
    "20 % lost": {"loss": 0.2},
    "20 % lost, slots of 500 ms": {"loss": 0.2, "access": "tdma", "slot_ms": 500},
    "20 % lost, range of 0.7 m": {"loss": 0.2, "range_m": 0.7, "positions": places},
}

if __name__ == "__main__":
    with style():
        import matplotlib.pyplot as plt

        figure, axis = plt.subplots(figsize=(6.4, 3.4), layout="constrained")
        for label, settings in CASES.items():
            gap = gaps(**settings)
            print(f"{label}: {gap[-10:].mean():.3f} at the end")
            axis.plot(gap, label=label)
        axis.set(xlabel="step", title="distance of a landmark from the nearest agent", ylim=(0, None))
        axis.legend()
        figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "spread.png", dpi=120)
