"""Learns who sends next, by evolution in the environment of `dtsa.env`, and flies it as a policy: a minute in all.

    tools/dtsa shell -c 'python examples/learned.py --generations 12'

In each slot every agent gives all agents a score, by its own table alone, and sends if its own is the greatest. The
score is a weighted sum of what is known of an agent; the weights are learned. They begin with a round robin, in which
age alone counts. The same seed and number of generations give the same weights. It needs PettingZoo.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

import dtsa
from dtsa.env import Observer, fields, parallel_env

Floats = NDArray[np.float64]
#: Weights of the age of what is known of an agent, in rounds; the same if it moves; whether it moves.
START = np.array([1.0, 0.0, 0.0])
#: Swarms to learn from; validation has further seeds of them.
SWARMS: tuple[dict[str, Any], ...] = (
    {"agents": 8, "moving": 3, "loss": 0.05},
    {"agents": 12, "moving": 3},
    {"agents": 12, "moving": 8, "loss": 0.1},
)
COMMON = {"estimator": "linear", "avoider": "orca", "slot_ms": 20, "frame": "extended"}
SLOTS = 300  # most of a flight


def sends(weights: Floats, observations: NDArray[np.float32], agents: int) -> NDArray[np.bool_]:
    """(...,) whether each observer sends; ties go to the lowest id.

    Every fourth slot belongs to an owner, as in TDMA: agents that wait for each other go on there.

    :param observations: (..., F) of any number of observers; in each the observer stands first, then the next ids.
    """
    seen = fields(observations, agents)
    slot = seen["slot"].astype(np.int64)[..., None]
    own = (seen["turn_in"].astype(np.int64)[..., None] + slot) % agents  # the observer's id less one
    age = np.where(seen["age"] < 0, slot, seen["age"]) / agents
    moves = seen["moves"].astype(np.float64)
    score = weights[0] * age + weights[1] * age * moves + weights[2] * moves
    ids = (own + np.arange(agents)) % agents
    best = ((score == score.max(axis=-1, keepdims=True)) * (agents - ids)).argmax(axis=-1) == 0
    return np.where(slot % 4 == 3, own == slot // 4 % agents, best[..., None])[..., 0]


class Learned:
    """The policy `learned`: each agent decides by its own table."""

    may_join = True

    def __init__(self, config: dtsa.SwarmConfig, agent: int, weights: Floats = START) -> None:
        self._agent, self._agents, self._weights = agent, config.agents, weights
        self._observe = Observer(config, agent)

    def choose(self, table: dtsa.Table, slot: int) -> int:
        """Id of the sender of a slot, 0: another one."""
        return self._agent if sends(self._weights, self._observe(table, slot), self._agents) else 0


def cost(weights: Floats, swarm: dict[str, Any], seed: int, record: list[Any] | None = None) -> float:
    """Cost of a flight: the logarithm of its mean age in rounds of TDMA, and 1 more for a crash.

    :param record: gets the senders of each slot.
    """
    agents = int(swarm["agents"])
    env = parallel_env(slots=SLOTS, reward=lambda results: 0.0, **COMMON, **swarm)
    observations, infos = env.reset(seed=seed)
    while env.agents:
        actions = sends(weights, np.stack(list(observations.values())), agents).astype(int).tolist()
        observations, *_, infos = env.step(dict(zip(env.agents, actions, strict=True)))
        if record is not None:
            record.append(env.senders)
    summary = infos["agent_1"]["summary"]
    age = summary["waking_age_mean_slots"]
    return float(np.log(max(1e-3, (10.0 * agents if age is None else age) / agents))) + summary["collided"]


def mean_cost(weights: Floats, seeds: range) -> float:
    """Over all kinds of swarms and some seeds."""
    return float(np.mean([cost(weights, swarm, seed) for swarm in SWARMS for seed in seeds]))


def train(seed: int, generations: int, population: int = 6, flights: int = 2) -> Floats:
    """An evolution strategy: the mean of the better half of some trials around it, with steps that shrink."""
    draw, mean, step = np.random.default_rng(seed), START.copy(), 0.5
    for generation in range(generations):
        trials = mean + step * draw.standard_normal((population, len(mean)))
        seeds = range(1000 * (generation + 1), 1000 * (generation + 1) + flights)
        costs = [mean_cost(trial, seeds) for trial in trials]
        best = np.argsort(costs, kind="stable")[: population // 2]
        mean, step = trials[best].mean(axis=0), 0.9 * step
        print(
            f"generation {generation + 1}: {min(costs):.3f}  {np.round(mean, 3).tolist()}", file=sys.stderr, flush=True
        )
    return mean


def main() -> None:
    """Trains, validates on flights that training has not used, and flies the policy."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--generations", type=int, default=12)
    args = parser.parse_args()
    weights = train(args.seed, args.generations)
    print(f"cost of the round robin {mean_cost(START, range(8)):.3f}, learned {mean_cost(weights, range(8)):.3f}")
    dtsa.register("policy", "learned", lambda config, agent: Learned(config, agent, weights))
    for policy in ("tdma", "learned", "lease"):
        summary = dtsa.simulate(policy=policy, agents=18, moving=4, loss=0.05, **COMMON).summary
        print(f"{policy:8} {summary['end']:10} age from waking on {summary['waking_age_mean_slots']:.2f} slots")


if __name__ == "__main__":
    main()
