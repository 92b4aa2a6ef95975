"""The same flights in vectorised NumPy: the baseline for the speed of the compiled core, and nothing else.

Everything a loss-free slot consists of is here once more, without the compiled kernel: who sends (tdma,
age, dtsa), the quantised frame, the table that all agents share, extrapolation, reciprocal avoidance of all
agents at once, physics. Only pairs within reach are computed, sums over neighbours are `bincount`, and the
soft problems of all agents are solved together.

    PYTHONPATH=tools python -m dtsa_dev.benchmark.numpy_swarm --agents 18 70 --policy dtsa
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Scenario, Swarm, SwarmConfig, make_scenario
from dtsa_agent.core.settings.flight_models import FlightModel, flight_model

Array = NDArray[np.float64]

POLICIES = ("tdma", "age", "dtsa")


def limited(vectors: Array, largest: float) -> Array:
    """Shortens the columns of (3, N) to at most ``largest``."""
    norm = np.sqrt((vectors**2).sum(axis=0))
    return vectors * np.where(norm > largest, largest / np.maximum(norm, 1e-300), 1.0)


def priorities(position: Array, velocity: Array, slot_s: float) -> Array:
    """g of all agents (eq:permission_d_p_ang); arrays (3, N)."""
    p = position[:, :, None] - position[:, None, :]
    v = velocity[:, None, :] - velocity[:, :, None]
    distance, speed = np.sqrt((p**2).sum(axis=0)), np.sqrt((v**2).sum(axis=0))
    product = distance * speed
    some = product > 0
    safe = np.where(some, product, 1.0)
    alpha = np.arccos(np.clip((p * v).sum(axis=0) / safe, -1.0, 1.0))
    eta = np.where(some, speed**2 / safe * slot_s * (np.pi - alpha) / np.pi, 0.0)
    return np.where((velocity != 0).any(axis=0), eta.sum(axis=1), 0.0)


def orca(model: FlightModel, p: Array, v: Array, goal: Array, believed_p: Array, believed_v: Array) -> Array:
    """Commands of all agents, (3, N), from one common table of beliefs; formulas in docs/reference/avoiders.md."""
    a, count = model.avoider, p.shape[1]
    wish = limited(a.gain * (goal - p), a.v_max)
    wish = limited(wish + a.bias * np.stack((wish[1], -wish[0], 0 * wish[0])), a.v_max)
    r = believed_p[:, None, :] - p[:, :, None]
    near = (r**2).sum(axis=0) < (a.radius + 2 * a.v_max * a.horizon) ** 2
    np.fill_diagonal(near, False)
    i, j = np.nonzero(near)
    r, w0 = r[:, i, j], v[:, i] - believed_v[:, j]
    r2, along = (r**2).sum(axis=0), (r * w0).sum(axis=0)
    outside = r2 - a.radius**2
    e = w0 - r / a.horizon
    back = (e * r).sum(axis=0)
    round_end = (back < 0) & (back**2 > a.radius**2 * (e**2).sum(axis=0))
    overlap = outside <= 0
    cross2 = (np.cross(r, w0, axis=0) ** 2).sum(axis=0)
    t = (along + a.radius * np.sqrt(cross2 / np.where(overlap, 1.0, outside))) / r2
    s = np.where(overlap, 1 / a.period, np.where(round_end, 1 / a.horizon, t))
    w = w0 - s * r
    length = np.sqrt((w**2).sum(axis=0))
    n = w / length
    b = (n * (v[:, i] + (a.radius * s - length) / 2 * n)).sum(axis=0)
    return limited(soft_minima(wish, n, b, i, a.softness, count), a.v_max)


def soft_minima(wish: Array, n: Array, b: Array, owner: NDArray[np.intp], rho: float, count: int) -> Array:
    """All agents' minimisers of |x - wish|^2 / 2 + rho / 2 sum max(0, b - n.x)^2 by damped Newton steps."""

    def per_agent(values: Array) -> Array:
        return np.asarray(np.bincount(owner, weights=values, minlength=count), dtype=np.float64)

    def lacks(x: Array) -> Array:
        return np.asarray(np.maximum(0.0, b - (n * x[:, owner]).sum(axis=0)), dtype=np.float64)

    x, lack = wish.copy(), lacks(wish)
    if not lack.any():
        return x
    value = rho / 2 * per_agent(lack**2)
    for _ in range(60):
        gradient = x - wish - rho * np.stack([per_agent(lack * n[k]) for k in range(3)])
        curvature = np.tile(np.eye(3), (count, 1, 1))
        active = lack > 0
        for k in range(3):
            for m in range(k, 3):
                total = rho * per_agent(active * n[k] * n[m])
                curvature[:, k, m] += total
                if m != k:
                    curvature[:, m, k] += total
        step = -np.linalg.solve(curvature, gradient.T[:, :, None])[:, :, 0].T
        slope = (step * gradient).sum(axis=0)
        if np.all(slope > -1e-28):
            break
        share = np.ones(count)
        for _ in range(40):
            to = x + share * step
            lack = lacks(to)
            new = ((to - wish) ** 2).sum(axis=0) / 2 + rho / 2 * per_agent(lack**2)
            worse = new > value + 1e-4 * share * slope + 1e-15 * (1 + value)
            if not worse.any():
                break
            share[worse] /= 2
        x, value = to, new
    return x


@dataclass
class NumpySwarm:
    """All agents of a loss-free swarm that share one table."""

    config: SwarmConfig
    scenario: Scenario
    model: FlightModel = field(init=False)

    def __post_init__(self) -> None:
        count = self.config.agents
        self.model = flight_model(self.config.avoider, self.config.options)
        self.position, self.velocity = self.scenario.start.copy(), np.zeros((3, count))
        self.sent_position, self.sent_velocity = self.scenario.start.copy(), np.zeros((3, count))
        self.sent_slot, self.last = np.full(count, -1), np.full(count, -1)
        self.in_ap = np.ones(count, dtype=bool)
        self.goal = self.scenario.target

    def believed(self, slot: int, offset: float = 0.0) -> Array:
        """Extrapolated positions (eq:estimate), (3, N)."""
        age = np.where(self.sent_slot < 0, 0.0, (slot - self.sent_slot) * self.config.slot_s + offset)
        return self.sent_position + self.sent_velocity * age

    def choose(self, slot: int) -> int:
        """Index of the sender, -1: nobody."""
        config, count = self.config, self.config.agents
        if config.policy == "tdma":
            return slot % count
        if config.policy == "dtsa" and config.boot_round and slot < count:
            return slot
        outside = np.flatnonzero(~self.in_ap)
        if config.return_every and slot % config.return_every == config.return_every - 1 and outside.size:
            return int(outside[slot // config.return_every % outside.size])
        members = int(self.in_ap.sum())
        if not members:
            return -1
        counter = np.where(self.in_ap, slot - 1 - self.last, -1)
        oldest = int(np.argmax(counter))
        if config.policy == "age" or (config.age_cap and counter[oldest] >= config.age_cap * members):
            return oldest
        g = np.where(self.in_ap, priorities(self.believed(slot), self.sent_velocity, config.slot_s), -1.0)
        if g.max() <= 0:
            return oldest
        return int(np.argmax(np.where(g >= (1 - config.epsilon) * g.max(), counter, -1)))

    def slot(self, slot: int) -> int:
        """One whole slot; returns the sender's index, -1: nobody."""
        sender = self.choose(slot)
        frame = None
        if sender >= 0:
            position, velocity = self.position[:, sender], self.velocity[:, sender]
            arrived = np.sqrt(((self.goal[:, sender] - position) ** 2).sum()) <= self.config.r_min
            frame = (
                self.goal[:, sender] if arrived else np.clip(np.rint(position / 0.002), -32768, 32767) * 0.002,
                np.zeros(3) if arrived else np.clip(np.rint(velocity / 0.01), -2048, 2047) * 0.01,
                arrived,
            )
        dt, vehicle, moving = self.config.slot_s / self.config.steps, self.model.vehicle, self.scenario.moving
        for step in range(self.config.steps):
            command = orca(
                self.model,
                self.position,
                self.velocity,
                self.goal,
                self.believed(slot, step * dt),
                self.sent_velocity,
            )
            change = limited((np.where(moving, command, 0.0) - self.velocity) / vehicle.tau, vehicle.a_max)
            self.velocity = self.velocity + dt * change
            self.position = self.position + dt * self.velocity
        if frame is not None:
            self.sent_position[:, sender], self.sent_velocity[:, sender], arrived = frame
            self.sent_slot[sender] = self.last[sender] = slot
            self.in_ap[sender] = not arrived
        return sender


def core_slot(swarm: Swarm, slot: int) -> int:
    """One whole slot of the compiled core without loss; returns the sender's index, -1: nobody."""
    sending = swarm.begin(slot)
    frames = [swarm.frame(local) for local in sending]
    swarm.fly(slot)
    for data in frames:
        swarm.hear(slot, data)
    swarm.end(slot)
    return sending[0] if sending else -1


def both(config: SwarmConfig) -> tuple[Swarm, NumpySwarm]:
    """The same swarm twice, at its start."""
    scenario = make_scenario(config)
    core = Swarm(config, scenario, shared_table=True)
    scenario.advance(0, core)
    return core, NumpySwarm(config, scenario)


def flight_slots(config: SwarmConfig) -> int:
    """Slots of a whole flight: until about the time all agents have arrived."""
    model = flight_model(config.avoider, config.options)
    way = 2 * max(model.min_radius, model.spacing * config.agents / (2 * math.pi))
    return math.ceil((way / model.avoider.v_max + 2.0) / config.slot_s)


def measure(
    agents: int,
    policy: str,
    slot_ms: float = 10.0,
    seed: int = 1,
    slots: int | None = None,
) -> dict[str, float | int | str]:
    """Time of a slot of both, averaged over a flight with all agents moving.

    :param agents: N.
    :param policy: tdma, age or dtsa.
    :param slot_ms: length of a slot, ms.
    :param seed: seed of the scenario.
    :param slots: slots to fly; None: until all have about arrived.
    """
    config = SwarmConfig(agents=agents, policy=policy, estimator="linear", avoider="orca", slot_ms=slot_ms, seed=seed)
    slots = slots or flight_slots(config)
    core, plain = both(config)
    began = time.perf_counter()
    for slot in range(slots):
        core_slot(core, slot)
    core_s = (time.perf_counter() - began) / slots
    began = time.perf_counter()
    for slot in range(slots):
        plain.slot(slot)
    numpy_s = (time.perf_counter() - began) / slots
    row = {
        "agents": agents,
        "policy": policy,
        "slots": slots,
        "core_us": core_s * 1e6,
        "numpy_us": numpy_s * 1e6,
        "ratio": numpy_s / core_s,
    }
    return row


def main() -> int:
    """Prints a table or JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--agents", type=int, nargs="+", default=[18, 70])
    parser.add_argument("--policy", choices=POLICIES, nargs="+", default=["tdma", "dtsa"])
    parser.add_argument("--slots", type=int, default=None, help="slots to fly (default: a whole flight)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    rows = [measure(n, policy, seed=args.seed, slots=args.slots) for n in args.agents for policy in args.policy]
    if args.json:
        print(json.dumps(rows, indent=2))
    else:
        print(f"{'agents':>6} {'policy':>6} {'slots':>6} {'core us':>9} {'numpy us':>9} {'ratio':>6}")
        for row in rows:
            line = f"{row['agents']:6d} {row['policy']:>6} {row['slots']:6d} {row['core_us']:9.1f}"
            line += f" {row['numpy_us']:9.0f} {row['ratio']:6.0f}"
            print(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
