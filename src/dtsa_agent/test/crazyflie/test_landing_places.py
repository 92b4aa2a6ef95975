"""Where those that land come down when somebody is below them: without links and without vehicles."""

from __future__ import annotations

import itertools
import math

import pytest

from dtsa_agent.crazyflie.safety.landing_places import (
    CLEAR_M,
    PASSES_S,
    PATIENCE_S,
    SINK,
    Descent,
    LandingPlaces,
    Other,
    place_aside,
)
from dtsa_agent.crazyflie.state.conversions import Vector

LOW, HIGH = (-1.5, -2.3, 0.0), (1.5, 2.3, 1.9)


def across(a: Vector, b: Vector) -> float:
    return math.dist(a[:2], b[:2])


def descend(swarm: dict[str, Vector], most_s: float = 60.0) -> dict[str, Vector]:
    """Land all at once, 0.4 m/s in all directions, asked ten times a second; where they stand.

    At no time are two nearer to each other than 0.3 m.
    """
    places, rules = dict(swarm), LandingPlaces(LOW, HIGH)
    ways: dict[str, Vector] = {}
    for step in range(round(most_s * 10)):
        for name, here in places.items():
            if here[2] <= 0.0:
                continue
            others = [Other(n, p, p[2] > 0, p[2] > 0, rules.goal(n)) for n, p in places.items() if n != name]
            goal = ways.get(name)
            if goal is None:
                descent = rules.descent(name, here, others, 0.0, 0.1 * step)
                assert not (descent.why and not descent.wait and descent.aside is None), f"{name}: {descent.why}"
                goal = descent.aside or (here if descent.wait else (here[0], here[1], 0.0))
                if descent.aside:
                    ways[name] = goal
            way = math.dist(here, goal)
            share = min(1.0, 0.04 / way) if way else 1.0
            x, y, z = (a + share * (b - a) for a, b in zip(here, goal, strict=True))
            places[name] = (x, y, z)
            if share == 1.0:
                ways.pop(name, None)
        for (_, a), (_, b) in itertools.combinations(places.items(), 2):
            assert math.dist(a, b) >= 0.3
        if all(p[2] <= 0.0 for p in places.values()):
            return places
    raise AssertionError(f"still in the air: {places}")


@pytest.mark.parametrize(
    "swarm",
    [
        {"a": (0.0, 0.0, 0.5), "b": (0.05, 0.0, 1.2)},
        {"a": (1.4, 2.2, 0.4), "b": (1.45, 2.2, 0.9), "c": (1.4, 2.25, 1.5)},  # in a corner
        {"a": (0.0, 0.0, 0.0), "b": (0.1, 0.0, 0.9), "c": (0.5, 0.0, 0.9), "d": (-0.4, 0.0, 0.9)},  # one stands
        {f"v{k}": (1.1 * math.cos(k % 6), 1.9 * math.sin(k % 6), 0.5 + 0.9 * (k // 6)) for k in range(12)},  # in pairs
    ],
)
def test_nobody_lands_on_another_or_comes_near_on_the_way(swarm: dict[str, Vector]) -> None:
    stand = descend(swarm)
    assert all(across(a, b) >= 0.3 for a, b in itertools.combinations(stand.values(), 2))
    assert all(LOW[i] <= p[i] <= HIGH[i] for p in stand.values() for i in (0, 1))
    lowest = min(swarm, key=lambda name: swarm[name][2])
    assert across(stand[lowest], swarm[lowest]) < 1e-6  # it did not move aside


def test_those_side_by_side_sink_straight_down() -> None:
    swarm = {"a": (0.0, 0.0, 0.95), "b": (0.32, 0.0, 0.9), "c": (0.0, 0.31, 1.0)}
    stand = descend(swarm)
    assert all(across(stand[n], swarm[n]) < 1e-6 for n in swarm)


def test_one_that_flies_on_is_waited_for_and_one_that_stays_is_not() -> None:
    rules, here = LandingPlaces(LOW, HIGH), (0.0, 0.0, 1.0)
    below = [Other("b", (0.0, 0.1, 0.5), flies=True)]
    assert rules.descent("a", here, below, 0.0, PASSES_S - 0.1) == Descent(wait=True, why="b is below it")
    assert rules.descent("a", here, [Other("b", (0.0, 0.4, 0.5), flies=True)], 0.0, PASSES_S) is SINK
    aside = rules.descent("a", here, below, 0.0, PASSES_S + 0.1).aside
    assert aside is not None
    assert across(aside, (0.0, 0.1, 0.5)) >= CLEAR_M
    assert rules.descent("a", here, below, 0.0, 1.0, down_to=0.9) is SINK  # it stops high above


def test_where_there_is_no_room_one_waits_as_long_as_its_battery_allows() -> None:
    rules, low, high = LandingPlaces((-0.2, -0.2, 0.0), (0.2, 0.2, 2.0)), (-0.2, -0.2, 0.0), (0.2, 0.2, 2.0)
    below = [Other("b", (0.0, 0.0, 0.0))]
    assert place_aside((0.0, 0.0, 1.0), below, low, high) is None
    assert rules.descent("a", (0.0, 0.0, 1.0), below, 0.0, PATIENCE_S - 0.1).wait
    last = rules.descent("a", (0.0, 0.0, 1.0), below, 0.0, PATIENCE_S + 0.1)
    assert (last.aside, last.wait, last.why) == (None, False, "b is below it, and it can wait no longer")
