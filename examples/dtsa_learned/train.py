"""Trains the rules of policy `learned` by evolution in the environments of `dtsa.env`. See README.md.

    python train.py --seed 1 --generations 40 --minutes 60
    python train.py --validate 8

The same seed and number of generations give the same weights.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from dtsa_learned.rules import Rules, digest_of, rules_of, start
from dtsa_learned.turns import Turns
from numpy.typing import NDArray

import dtsa.env

Floats = NDArray[np.float64]

#: Swarms to learn from, drawn at random in each generation; no cell of a league is among them.
SWARMS: tuple[dict[str, Any], ...] = (
    {"agents": 8, "moving": 4, "loss": 0.05},
    {"agents": 10, "moving": 2},
    {"agents": 10, "loss": 0.1},
    {"agents": 14, "moving": 4, "loss": 0.2, "avoider": "jerky"},
    {"agents": 16, "moving": 10, "loss": 0.05},
    {"agents": 24, "moving": 6, "loss": 0.1, "burst_length": 10},
    {"agents": 30, "moving": 6, "loss": 0.05},
    {"agents": 20, "moving": 5, "avoider": "jerky", "range_m": 3.5, "loss": 0.05},
    {"agents": 16, "avoider": "jerky", "slot_ms": 15, "loss": 0.05},
    {"agents": 12, "scenario": "waypoints", "stops": 2, "slot_ms": 20, "loss": 0.1},
    {"agents": 20, "moving": 6, "scenario": "waypoints", "stops": 2, "pause_slots": 200, "loss": 0.05},
    {"agents": 16, "scenario": "stop-and-go", "stops": 1, "pause_slots": 100, "slot_ms": 20, "loss": 0.05},
    {"agents": 16, "scenario": "staggered", "stagger_slots": 30, "slot_ms": 30, "loss": 0.1},
)
COMMON = {"estimator": "linear", "avoider": "orca", "slot_ms": 10, "frame": "extended"}
FIRST_SEED = 50_000_000  # of training; those of the validation come before it
SLOTS = 600  # most of a flight
STEP = 0.12  # first step size of the evolution
MOST = 10.0  # rounds, the largest age that counts
# What a crash costs on top. The league's price, an age of ten rounds, is four times that: luck would hide the rest.
LOST = 1.0


class Swarm:
    """Flights of one kind of swarm, one for each pair of rules and a seed.

    :param settings: what is flown.
    :param flights: number of flights B.
    """

    def __init__(self, settings: dict[str, Any], flights: int) -> None:
        self.agents = int(settings["agents"])
        self._env = dtsa.env.batch_env(
            flights=flights, slots=SLOTS, autoreset=False, reward=_nothing, **{**COMMON, **settings}
        )
        ids = np.arange(1, self.agents + 1)
        self._by_id = ((ids[None, :] - ids[:, None]) % self.agents)[None]  # (1, V, N) from an observation's order
        self._ids = ids

    def fly(self, rules: Sequence[Rules], seeds: Sequence[int], record: list[Any] | None = None) -> Floats:
        """What each flight costs: the logarithm of its age from waking on in rounds of TDMA, more if it is lost.

        :param rules: (B) of each flight.
        :param seeds: (B) of each flight.
        :param record: takes who sent in each slot.
        :returns: (B,).
        """
        turns = Turns(rules, self.agents, self._ids)
        observations = self._env.reset(seed=list(seeds))
        costs, under_way = np.zeros(len(rules)), len(rules)
        for slot in range(SLOTS):
            fields = dtsa.env.fields(observations, agents=self.agents)
            age = np.take_along_axis(fields["age"], self._by_id, axis=2).astype(np.int64)
            moves = np.take_along_axis(fields["moves"], self._by_id, axis=2) > 0
            sends = turns(slot, np.where(age < 0, -1, slot - 1 - age), moves)
            if record is not None:
                record.append(sends)
            observations, _, _, _ = self._env.step(sends)
            for ended in self._env.ended:
                costs[ended.flight] = self._cost(ended.summary)
                under_way -= 1
            if not under_way:
                break
        return costs

    def _cost(self, summary: dict[str, Any]) -> float:
        age = summary["waking_age_mean_slots"]
        rounds = MOST if age is None else min(MOST, float(age) / self.agents)
        return math.log(max(rounds, 1e-3)) + LOST * (summary["end"] == "crashed")


def _nothing(results: dtsa.env.SlotResults) -> Floats:
    """The reward: none, because the summaries say what a flight was worth."""
    return np.zeros((len(results.slot), 1))


class Evolution:
    """A (mu/mu, lambda) evolution strategy with cumulative step-size adaptation, element by element.

    No matrices are decomposed, so the same seed gives the same numbers with every BLAS.

    :param mean: where it begins.
    :param step: its step size.
    :param population: lambda.
    :param seed: of its random numbers.
    """

    def __init__(self, mean: Floats, step: float, population: int, seed: int) -> None:
        self.mean, self.step, self.population = mean.copy(), step, population
        self._random = np.random.default_rng(seed)
        weights = np.log(population / 2 + 0.5) - np.log(np.arange(1, population // 2 + 1))
        self._weights = weights / weights.sum()
        self._mass = 1.0 / float((self._weights**2).sum())
        size = len(mean)
        self._rate = (self._mass + 2.0) / (size + self._mass + 5.0)
        self._damping = 1.0 + self._rate + 2.0 * max(0.0, math.sqrt((self._mass - 1.0) / (size + 1.0)) - 1.0)
        self._length = math.sqrt(size) * (1.0 - 1.0 / (4.0 * size) + 1.0 / (21.0 * size * size))
        self._path = np.zeros(size)
        self._moves = np.zeros((population, size))

    def ask(self) -> Floats:
        """(lambda, SIZE) what to try: pairs on both sides of the mean."""
        half = self._random.standard_normal((self.population // 2, len(self.mean)))
        self._moves = np.concatenate([half, -half])
        return self.mean + self.step * self._moves

    def tell(self, costs: Floats) -> None:
        """Moves on.

        :param costs: (lambda,) of what was tried.
        """
        best = np.argsort(costs, kind="stable")[: len(self._weights)]
        move = np.zeros_like(self.mean)
        for weight, k in zip(self._weights, best, strict=True):
            move = move + weight * self._moves[k]
        self.mean = self.mean + self.step * move
        kept = math.sqrt(self._rate * (2.0 - self._rate) * self._mass)
        self._path = (1.0 - self._rate) * self._path + kept * move
        length = math.sqrt(math.fsum(self._path**2))
        self.step *= math.exp((self._rate / self._damping) * (length / self._length - 1.0))


def train(
    seed: int, generations: int, *, minutes: float = math.inf, population: int = 16, swarms: int = 5, flights: int = 2,
    out: Path | None = None, every: int = 5, kinds: Sequence[dict[str, Any]] = SWARMS,
) -> dict[str, Any]:  # fmt: skip
    """Learns rules.

    :param seed: of the training.
    :param generations: at most so many.
    :param minutes: at most so long.
    :param population: rules that are tried in a generation.
    :param swarms: kinds of swarms in a generation.
    :param flights: flights of each with each rules.
    :param out: file of the weights, written every so many generations.
    :param every: how many.
    :param kinds: what they are drawn from.
    :returns: what is in the file: the best of the start and of the means after every so many generations.
    """
    begun, draw = time.monotonic(), np.random.default_rng([seed, 1])
    evolution = Evolution(start(), STEP, population, seed)
    made: dict[int, Swarm] = {}
    log: list[dict[str, float]] = []
    best, checked = evolution.mean, check(evolution.mean, kinds)
    print(f"start: {checked:.3f}", flush=True)
    swarms, count = min(swarms, len(kinds)), 0
    for generation in range(1, generations + 1):
        if time.monotonic() - begun > 60.0 * minutes:
            break
        tried = evolution.ask()
        costs = np.zeros(population)
        for k in draw.choice(len(kinds), swarms, replace=False):
            swarm = made.setdefault(int(k), Swarm(kinds[k], population * flights))
            seeds = [FIRST_SEED + count + i for i in range(flights)]
            count += flights
            rules = [rules_of(theta, swarm.agents) for theta in tried for _ in seeds]
            costs += swarm.fly(rules, seeds * population).reshape(population, flights).mean(axis=1) / swarms
        evolution.tell(costs)
        log.append({"best": float(costs.min()), "mean": float(costs.mean()), "step": evolution.step})
        if generation % every == 0:
            log[-1]["check"] = now = check(evolution.mean, kinds)
            if now < checked:
                best, checked = evolution.mean, now
            if out is not None:
                write(out, best, seed, log)
        print(generation, json.dumps(log[-1]), f"{time.monotonic() - begun:.0f} s", flush=True)
    return content_of(best, seed, log)


def content_of(theta: Floats, seed: int, log: list[dict[str, float]]) -> dict[str, Any]:
    """What is in a file of weights."""
    learned = [float(value) for value in theta]
    rules = {str(agents): digest_of(rules_of(learned, agents)) for agents in (12, 40)}
    return {"seed": seed, "generations": len(log), "theta": learned, "rules": rules, "log": log}


def write(out: Path, theta: Floats, seed: int, log: list[dict[str, float]]) -> None:
    """Writes the file of weights, whole or not at all."""
    part = out.with_name(out.name + ".part")
    part.write_text(json.dumps(content_of(theta, seed, log), indent=1) + "\n", encoding="utf-8")
    part.replace(out)


def check(theta: Floats, kinds: Sequence[dict[str, Any]]) -> float:
    """Mean cost in all kinds of swarms, on the same flights each time."""
    return float(np.mean(validate(theta, 4, kinds, first_seed=2_000_000)))


def validate(
    theta: Sequence[float] | Floats, flights: int, kinds: Sequence[dict[str, Any]] = SWARMS, first_seed: int = 1_000_000
) -> list[float]:
    """Mean cost in each kind of swarm, with seeds that no training uses.

    :param theta: the learned numbers.
    :param flights: flights of each kind.
    :param kinds: the kinds.
    :param first_seed: of the first flight.
    """
    costs = []
    for k, settings in enumerate(kinds):
        swarm = Swarm(settings, flights)
        seeds = [first_seed + 1000 * k + i for i in range(flights)]
        costs.append(float(swarm.fly([rules_of(theta, swarm.agents)] * flights, seeds).mean()))
    return costs


def main() -> None:
    """Trains, and writes the weights."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--generations", type=int, default=1000)
    parser.add_argument("--minutes", type=float, default=25.0)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "dtsa_learned" / "weights.json")
    parser.add_argument(
        "--validate", type=int, metavar="FLIGHTS", help="train nothing; compare what is there with the start"
    )
    args = parser.parse_args()
    if args.validate is None:
        train(args.seed, args.generations, minutes=args.minutes, out=args.out)
        return
    learned = json.loads(args.out.read_text(encoding="utf-8"))["theta"]
    lines = zip(SWARMS, validate(list(start()), args.validate), validate(learned, args.validate), strict=True)
    for settings, before, after in lines:
        print(f"{before:7.3f} {after:7.3f}  {settings}")


if __name__ == "__main__":
    main()
