"""Where an agent is by now, from its last known state (eq:estimate)."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

from .arithmetic import Vector

if TYPE_CHECKING:
    from .table import Row, Rules

DECAY_STEPS = 4096  # beyond this many control periods a vehicle has settled at its command


def age_s(row: Row, rules: Rules, slot: int, step: int = 0) -> float:
    """Age of a known state, (i - m) t_s in eq:estimate, s; 0 for an agent never heard of."""
    return 0.0 if row.sent_slot < 0 else (slot - row.sent_slot) * rules.slot_s + step * rules.dt


def hold(row: Row, rules: Rules, slot: int, step: int = 0) -> tuple[Vector, Vector]:
    """Position and velocity as last heard."""
    return row.position, row.velocity


def linear(row: Row, rules: Rules, slot: int, step: int = 0) -> tuple[Vector, Vector]:
    """On with the velocity last heard: p + (i - m) t_s v (eq:estimate)."""
    age, p, v = age_s(row, rules, slot, step), row.position, row.velocity
    return (p[0] + v[0] * age, p[1] + v[1] * age, p[2] + v[2] * age), v


def intent(row: Row, rules: Rules, slot: int, step: int = 0) -> tuple[Vector, Vector]:
    """Towards the commanded velocity c, as an unsaturated vehicle answers it.

    After k control periods: velocity c + (v - c) q^k, position p + c a + (v - c) dt (q + .. + q^k).
    """
    age = age_s(row, rules, slot, step)
    ago = 0 if row.sent_slot < 0 else (slot - row.sent_slot) * rules.steps + step
    powers, ways = decay_table(rules.tau, rules.dt)
    ago = max(0, min(ago, DECAY_STEPS - 1))  # a frame of the next slot may be heard before this one is over
    q, distance = powers[ago], ways[ago]
    moved = []
    for p, v, c in zip(row.position, row.velocity, row.intent, strict=True):
        d = v - c
        moved.append((p + c * age + d * distance, c + d * q))
    (x, vx), (y, vy), (z, vz) = moved
    return (x, y, z), (vx, vy, vz)


@lru_cache(maxsize=8)
def decay_table(tau: float, dt: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """How an unsaturated vehicle approaches its command: q^k (1), and dt (q + .. + q^k) (s), for k = 0, 1, ...

    q = 1 - dt / tau is the vehicle's own integrator. By multiplication alone, so that all agents compute the same bits.
    """
    q = max(0.0, 1.0 - dt / tau)
    powers, ways = [], []
    power, distance = 1.0, 0.0
    for _ in range(DECAY_STEPS):
        powers.append(power)
        ways.append(distance)
        power *= q
        distance += dt * power
    return tuple(powers), tuple(ways)


ESTIMATORS = {"hold": hold, "linear": linear, "intent": intent}  # the oracle knows the truth, there is nothing to state
