"""Where agents start and where they fly to. The same settings give the same scenario in every process."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.kernel import ffi, lib, memory

from .config import SwarmConfig
from .flight_models import flight_model

Array = NDArray[np.float64]

# Streams of random numbers, one a purpose: adding a purpose changes none of the others.
STREAM_SCENARIO, STREAM_POLICY, STREAM_CHANNEL, STREAM_CLOCKS, STREAM_RADIOS, STREAM_PLUG_INS = range(1, 7)


def generator(seed: int, stream: int, *more: int) -> np.random.Generator:
    """A random generator for one purpose of one run: one of the ``STREAM_`` constants, and further indices."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, stream, *more])))


@lru_cache(maxsize=64)  # a sweep flies the same seeds again with other settings
def policy_key(seed: int) -> int:
    """By which policies draw lots, 63 bits."""
    return int(generator(seed, STREAM_POLICY).integers(0, 2**63))


def plug_in_random(config: SwarmConfig, agent: int, name: str) -> np.random.Generator:
    """Random numbers of one instance of a plug-in: the same in nodes, simulator and verifier.

    :param config: what its factory was given; the run's seed counts.
    :param agent: what its factory was given.
    :param name: of the plug-in.
    """
    return generator(config.seed, STREAM_PLUG_INS, agent, *name.encode())


@dataclass(frozen=True, slots=True)
class Plan:
    """The goals of all agents, known before the flight."""

    goals: Array  # (K, 3, N), m: where each flies to, one after the other; the last one is its target
    begin: NDArray[np.int64]  # (N,) first slot in which each flies
    pause: NDArray[np.int64]  # (N,) slots that each rests at a goal before it flies on to the next


class Course:
    """How far some agents, (L,) indices ``local``, are with a scenario's plan: the memory of ``swarm_advance``.

    From the slot's number and an agent's own position alone: an agent runs this for itself, the simulator for all.
    ``r_min``: m, closer than this an agent has arrived.
    """

    def __init__(self, scenario: Scenario, plan: Plan, local: NDArray[np.int32], r_min: float) -> None:
        self._start = scenario.start[:, local]
        self.leg = np.full(len(local), -1, dtype=np.int64)  # index of the present goal, -1: waits for its first slot
        self._since = self.leg.copy()  # slot of arrival at the present goal, -1: under lengths
        self.changed = self.leg.copy()  # slot in which that became its goal
        self.goal: Array = np.ascontiguousarray(self._start)  # (3, L) m, frame map, where each flies to now
        arrays = {
            "local": np.array(local, dtype=np.int32), "start": np.ascontiguousarray(scenario.start),
            "goals": np.ascontiguousarray(plan.goals), "begin": np.array(plan.begin, dtype=np.int64),
            "pause": np.array(plan.pause, dtype=np.int64), "moving": np.array(scenario.moving, dtype=np.uint8),
            "leg": self.leg, "since": self._since, "changed": self.changed, "goal": self.goal,
        }  # fmt: skip
        self._borrowed = {name: memory(array) for name, array in arrays.items()}
        sizes = {"n": scenario.start.shape[1], "count": len(local), "goal_count": len(plan.goals), "r_min": r_min}
        self.kernel = ffi.new("course *", {**sizes, **self._borrowed})  # for swarm_advance

    def reset(self) -> None:
        """Back to the start of the flight."""
        self.leg[:] = self._since[:] = self.changed[:] = -1
        self.goal[:] = self._start


@dataclass(frozen=True, slots=True)
class Scenario:
    """Starts, goals and movers of one run; known to all agents.

    ``start`` and ``target`` have shape (3, N), m, frame map; ``moving`` has shape (N,). Without a plan
    everybody flies straight to its target from slot 0 on.
    """

    start: Array
    target: Array
    moving: NDArray[np.bool_]
    plan: Plan | None = None
    goals_known: bool = True  # all know where everybody wants to be in each slot

    @property
    def path_length(self) -> Array:
        """Length of the straight lines from goal to goal, (N,), m."""
        goals = self.target[None] if self.plan is None else self.plan.goals
        points = np.concatenate((self.start[None], goals))
        return np.asarray(np.sqrt((np.diff(points, axis=0) ** 2).sum(axis=1)).sum(axis=0))

    def course(self, local: NDArray[np.int32], r_min: float) -> Course | None:
        """The state of a flight along the plan, of the agents with indices ``local``; None without a plan."""
        return None if self.plan is None else Course(self, self.plan, local, r_min)

    def advance(self, slot: int, swarm: Any) -> None:
        """Set goals and activity of a :class:`~dtsa_agent.core.swarm.Swarm` for the slot that is about to begin.

        Only the own state of each agent is looked at.
        """
        if swarm.course is not None:
            lib.swarm_advance(swarm.kernel, swarm.course.kernel, slot)
        elif slot == 0:
            swarm.active[:] = self.moving[swarm.local]


def make_scenario(config: SwarmConfig) -> Scenario:
    """The scenario of a configuration: the same arrays for the same configuration, in every process.

    :raises ConfigError: if it does not fit into the extent that frames can say.
    """
    random = generator(config.seed, STREAM_SCENARIO)
    places, partner = (_streams if config.scenario == "streams" else _places)(config)
    count = config.agents
    order = random.permutation(count) if config.permute else np.arange(count)
    if config.places:
        order = np.array(config.place_numbers) - 1
    places = places + random.uniform(-config.jitter_m, config.jitter_m, (3, count))
    pairs = [(a, int(b)) for a, b in enumerate(partner) if a < b]
    chosen = random.permutation(len(pairs))
    target, moving = places.copy(), np.zeros(count, dtype=np.bool_)
    if config.scenario == "streams":
        moving[: config.movers] = True
        half, (_, _, length) = config.movers // 2, _stream_size(config)
        target[0, :half] += length  # one stream flies along x, the other along y
        target[1, half : config.movers] += length
    else:
        for index in chosen[: config.movers // 2]:
            a, b = pairs[index]
            target[:, a], target[:, b] = places[:, b], places[:, a]
            moving[a] = moving[b] = True
        if config.movers % 2:
            # Without a partner: the agent that has none anyway, else the first of the next pair.
            single = count - 1 if count % 2 else pairs[chosen[config.movers // 2]][0]
            target[:, single] = _far_point(config, places[:, single])
            moving[single] = True
    # Micrometres: whatever the last bit of a cosine is on some machine, all agents start from the same numbers.
    start, target = (np.ascontiguousarray(np.round(planes, 6)[:, order]) for planes in (places, target))
    plain = Scenario(start, target, moving[order])
    check_extent(config, plain)  # waypoints lie between the starts
    return _planned(config, plain, random)


def _far_point(config: SwarmConfig, place: Array) -> Array:
    """Goal of a mover without a partner, (3,), m: opposite, one spacing further out, where nobody else has a place."""
    spacing = flight_model(config.avoider, config.options).spacing
    far: Array = -place * (1.0 + spacing / math.sqrt(float(place @ place)))
    return far


FIELD_MARGIN_M = 2.0  # m, room to avoid each other beyond the outermost start or goal


def check_extent(config: SwarmConfig, scenario: Scenario) -> None:
    """Check that frames can say where everybody will be.

    :raises ConfigError: naming the extent that would do.
    """
    points = np.array([scenario.start, scenario.target, *([] if scenario.plan is None else scenario.plan.goals)])
    reach = float(np.abs(points).max(initial=0.0))
    if not np.isfinite(points).all():
        raise ConfigError("scenario", "places that are not", "finite starts and goals")
    if not reach + FIELD_MARGIN_M <= config.extent_m:
        enough = math.ceil(10.0 * (reach + FIELD_MARGIN_M)) / 10.0
        text = f"{enough:g} m or more: starts and goals are up to {reach:.2f} m from the centre"
        raise ConfigError("extent_m", config.extent_m, f"{text}, and agents avoid each other")


def _planned(config: SwarmConfig, plain: Scenario, random: np.random.Generator) -> Scenario:
    """The scenario with the plan of its kind; random numbers are drawn after all those of the plain one."""
    if config.scenario in ("exchange", "streams"):
        return plain
    count, moving = config.agents, plain.moving
    begin = np.zeros(count, dtype=np.int64)
    pause = np.where(moving, config.pause_slots, 0).astype(np.int64)
    goals = plain.target[None]
    if config.scenario == "staggered":
        # Partners start together: pairs one after the other, in the order of their lower ids.
        partner = {tuple(plain.start[:, k]): k for k in range(count)}
        mates = [(int(k), partner.get(tuple(plain.target[:, k]), int(k))) for k in np.flatnonzero(moving)]
        for turn, (a, b) in enumerate(pair for pair in mates if pair[0] <= pair[1]):
            begin[a] = begin[b] = turn * config.stagger_slots
    elif config.scenario == "waypoints":
        goals = np.concatenate((_waypoints(config, plain, random), goals))
    else:  # stop-and-go: to the other side, rest, back, rest, ...
        legs = config.stops + 1
        goals = np.stack([plain.target if leg % 2 == 0 else plain.start for leg in range(legs)])
        if config.pause_slots:
            begin[moving] = random.integers(0, config.pause_slots, int(moving.sum()))
    goals_known = config.scenario == "staggered"
    return Scenario(plain.start, np.ascontiguousarray(goals[-1]), moving, Plan(goals, begin, pause), goals_known)


WAYPOINT_GAP = 0.9  # m, between a waypoint and everybody's last goal, and among the movers' n-th waypoints


def _waypoints(config: SwarmConfig, plain: Scenario, random: np.random.Generator) -> Array:
    """Random points for all agents, (stops, 3, N), within the start shape, up to 0.5 m above and below its middle."""
    ax, ay, _ = half_axes(config)
    points = np.repeat(plain.start[None], config.stops, axis=0)
    for stop in range(config.stops):
        occupied = list(plain.target.T)
        for k in np.flatnonzero(plain.moving):
            gap = WAYPOINT_GAP
            while True:
                angle, r = 2 * math.pi * random.random(), math.sqrt(random.random())
                z = random.uniform(-0.5, 0.5)
                point = np.round([ax * r * math.cos(angle), ay * r * math.sin(angle), z], 6)
                if min(float(np.sqrt(((point - other) ** 2).sum())) for other in occupied) >= gap:
                    break
                gap *= 0.998  # a crowded room has no better place
            points[stop, :, k] = point
            occupied.append(point)
    return points


def _stream_size(config: SwarmConfig) -> tuple[int, float, float]:
    """Agents in a row of a stream, the distance between them, m, and the length of the way of each, m."""
    rows = math.ceil(math.sqrt(max(1, (config.movers + 1) // 2)))
    gap = max(1.0, flight_model(config.avoider, config.options).spacing)
    return rows, gap, 2 * ((rows + 1) * gap + 2.0)


def _streams(config: SwarmConfig) -> tuple[Array, NDArray[np.int64]]:
    """Places of two blocks that will cross, movers first, and of those that hover around them."""
    rows, gap, length = _stream_size(config)
    half, movers = config.movers // 2, config.movers
    index = np.arange(movers - half)  # the second stream has the odd one
    depth, lane = index // rows * gap, (index % rows - (rows - 1) / 2) * gap
    places = np.zeros((3, config.agents))
    along = -length / 2 - depth + (rows - 1) * gap / 2
    places[0, :half], places[1, :half] = along[:half], lane[:half]
    places[0, half:movers], places[1, half:movers] = lane, along
    hovering = config.agents - movers
    if hovering:
        radius = max(length / 2 + rows * gap + 1.0, gap * hovering / (2 * math.pi))
        angle = 2 * np.pi * np.arange(hovering) / hovering
        places[0, movers:], places[1, movers:] = radius * np.cos(angle), radius * np.sin(angle)
    return places, np.full(config.agents, -1, dtype=np.int64)


def half_axes(config: SwarmConfig) -> tuple[float, float, float]:
    """Half axes of the start shape in x, y and z, m.

    Without given axes a circle of radius max(r0, s N / 2 pi), s and r0 from the flight model.
    """
    model = flight_model(config.avoider, config.options)
    x = config.axis_x_m or max(model.min_radius, model.spacing * config.agents / (2 * math.pi))
    y = config.axis_y_m or (x if config.shape != "ellipse" else x * 5 / 3)
    return x, y, config.axis_z_m or x


def _places(config: SwarmConfig) -> tuple[Array, NDArray[np.int64]]:
    """Places on the shape, (3, N), and the index of the place opposite to each (-1: none)."""
    count, (ax, ay, az) = config.agents, half_axes(config)
    partner, half = np.full(count, -1, dtype=np.int64), count // 2
    partner[: 2 * half] = np.roll(np.arange(2 * half), -half)
    if config.shape == "ellipsoid":
        upper, top = _half_sphere(half), np.array([[0.0], [0.0], [1.0]])
        unit = np.concatenate((upper, -upper, top), axis=1)[:, :count]
        return unit * np.array([[ax], [ay], [az]]), partner
    angle = _equal_arcs(count, ax, ay)
    return np.stack((ax * np.cos(angle), ay * np.sin(angle), np.zeros(count))), partner


def _equal_arcs(count: int, ax: float, ay: float) -> Array:
    """Angles that cut an ellipse into equal arcs."""
    if ax == ay:
        return 2 * np.pi * np.arange(count) / count
    fine = np.linspace(0.0, 2 * np.pi, 20001)
    speed = np.hypot(ax * np.sin(fine), ay * np.cos(fine))
    length = np.concatenate(([0.0], np.cumsum((speed[1:] + speed[:-1]) / 2)))
    angles: Array = np.interp(length[-1] * np.arange(count) / count, length, fine)
    return angles


def _half_sphere(count: int) -> Array:
    """Even points on the upper half of the unit sphere (Fibonacci lattice), (3, count)."""
    index = np.arange(count)
    z = (index + 0.5) / max(count, 1)
    turn = index * math.pi * (3.0 - math.sqrt(5.0))
    r = np.sqrt(1.0 - z * z)
    return np.stack((r * np.cos(turn), r * np.sin(turn), z))
