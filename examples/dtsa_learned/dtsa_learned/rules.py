"""What is learned: how often agents get turns. A small network says it; agents use its answers as whole numbers.

All agents have to come to the same turns, on every machine. So the network is evaluated once, for the size of the
swarm, with the four operations in a fixed order, and rounded. From then on agents compute with whole numbers alone.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

KINDS = MOVER, ARRIVED, WAITING = range(3)  # an agent that moves, that rests and has moved, that has not moved yet
STEPS = 4  # of each other input: how long it has been so, how many move, how long ago any of them set out
_HIDDEN, _INPUTS = 6, 5
_HEADS = _HIDDEN * _INPUTS
_TAIL = _HEADS + len(KINDS) * (_HIDDEN + 1)
SIZE = _TAIL + 1  # how many numbers are learned
_UNIT = 4096  # rate 1 as a whole number
_HEAD_SCALE = 4.0


@dataclass(frozen=True, slots=True)
class Rules:
    """What agents go by, all of it the same for all of them."""

    rates: NDArray[np.int64]  # (3, 4, 4, 4) by kind, time, share and calm: how fast the claim to a turn grows
    every: int  # slots: each one of so many belongs to its owner, as in TDMA


def start() -> NDArray[np.float64]:
    """(SIZE,) what training begins with: all claims grow alike, a round robin. Hidden units tell inputs apart."""
    theta = np.zeros(SIZE)
    inputs = ((2, 0, 0, 0, 0), (0, 2, 0, 0, 0), (0, 0, 2, 0, 0), (0, 0, 0, 2, 0), (2, 0, 2, 0, -2), (0, 2, 2, 0, -2))
    theta[:_HEADS] = np.array(inputs, dtype=np.float64).ravel()
    return theta


def rules_of(theta: Sequence[float], agents: int) -> Rules:
    """The rules that the learned numbers say for a swarm.

    :param theta: (SIZE,) the learned numbers.
    :param agents: number of agents N.
    """
    learned = [float(value) for value in theta]
    rates = np.zeros((len(KINDS), STEPS, STEPS, STEPS), dtype=np.int64)
    for time, share, calm in product(range(STEPS), repeat=3):
        inputs = (time / 3.0, share / 3.0, calm / 3.0, agents / (agents + 20.0), 1.0)
        hidden = [_bent(_sum(learned[i * _INPUTS : (i + 1) * _INPUTS], inputs)) for i in range(_HIDDEN)]
        for kind in KINDS:
            head = learned[_HEADS + kind * (_HIDDEN + 1) : _HEADS + (kind + 1) * (_HIDDEN + 1)]
            rates[kind, time, share, calm] = _rate(_HEAD_SCALE * _sum(head, (*hidden, 1.0)))
    return Rules(rates, round(min(100.0, max(4.0, 20.0 + 10.0 * learned[_TAIL]))))


def _sum(weights: Sequence[float], values: Sequence[float]) -> float:
    """A scalar product, added up in order: BLAS may take another one on another machine."""
    total = 0.0
    for weight, value in zip(weights, values, strict=True):
        total += weight * value
    return total


def _bent(value: float) -> float:
    """Softsign: like tanh, without a function that C libraries round differently."""
    return value / (1.0 + abs(value))


def _rate(value: float) -> int:
    rate = 1.0 + 2.0 * value if value >= 0.0 else 1.0 / (1.0 - 2.0 * value)
    return max(1, round(_UNIT * rate))


def digest_of(rules: Rules) -> str:
    """SHA-256 of the whole numbers, hexadecimal: the same on every machine.

    :param rules: of a swarm.
    """
    return hashlib.sha256(f"{rules.rates.ravel().tolist()} {rules.every}".encode()).hexdigest()


@cache
def learned_rules(agents: int) -> Rules:
    """The rules that come with the package.

    :param agents: number of agents N.
    """
    content = json.loads((Path(__file__).resolve().parent / "weights.json").read_text(encoding="utf-8"))
    return rules_of(content["theta"], agents)
