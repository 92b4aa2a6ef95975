"""The compiled avoiders and the vehicle against the formulas, and what every avoider promises."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import plain_avoiders
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from kernel_parts import avoid
from plain_avoiders import Case

from dtsa_agent.core import Swarm, SwarmConfig
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.kernel import lib
from dtsa_agent.core.settings.flight_models import FLIGHT_MODELS, FlightModel, VehicleParams, flight_model

MODELS = tuple(FLIGHT_MODELS)


def make_case(seed: int, count: int, size: float, speed: float = 1.5) -> Case:
    random = np.random.default_rng(seed)
    position = random.uniform(-size, size, (3, count))
    velocity = random.uniform(-speed, speed, (3, count)) / math.sqrt(3)
    return Case(int(random.integers(count)), position, velocity, random.uniform(-9, 9, 3), random.uniform(0, 2, count))


cases = st.builds(
    make_case, seed=st.integers(0, 2**32 - 1), count=st.integers(1, 45),
    size=st.sampled_from([0.3, 0.8, 1.5, 3.0, 8.0]), speed=st.sampled_from([0.0, 1.5, 3.0]),
)  # fmt: skip


def command(model: FlightModel, case: Case, age: np.ndarray | None = None) -> np.ndarray:
    i = case.index
    return avoid(model, i, case.position[:, i], case.velocity[:, i], case.goal, case.position, case.velocity, age)


MARGINS = st.fixed_dictionaries({"margin_rate": st.sampled_from([0.0, 0.1])})
ORCA = st.fixed_dictionaries({
    "radius": st.floats(0.2, 0.6), "horizon": st.floats(0.5, 3), "softness": st.sampled_from([1.0, 30.0, 300.0]),
    "bias": st.floats(-0.3, 0.3), "margin_rate": st.sampled_from([0.0, 0.05, 0.5]),
})  # fmt: skip


def off_the_edges(model: FlightModel, case: Case, age: np.ndarray | None) -> bool:
    """Whether no neighbour's sphere just touches: a hair decides there, in both."""
    ages = 0 * case.age if age is None else age
    wider = np.minimum(model.avoider.margin_max, model.avoider.margin_rate * ages)
    gaps = np.linalg.norm(case.position - case.position[:, [case.index]], axis=0) - model.avoider.radius - wider
    return not (np.abs(np.delete(gaps, case.index)) < 1e-3).any()


@pytest.mark.parametrize(("name", "options"), [*((name, MARGINS) for name in MODELS), ("orca", ORCA)])
@settings(max_examples=150, deadline=None)
@given(case=cases, aged=st.booleans(), data=st.data())
def test_commands_are_what_formulas_say(name: str, options: Any, case: Case, aged: bool, data: st.DataObject) -> None:
    model, age = flight_model(name, data.draw(options)), case.age if aged else None
    assume(off_the_edges(model, case, age))
    # Stiff penalties multiply what rounding does, the walls of bvc by 1e6.
    tolerance = 1e-9 if "bvc" in name or options is ORCA else 1e-12
    assert command(model, case, age) == pytest.approx(plain_avoiders.command(model, case, age), abs=tolerance)


@pytest.mark.parametrize("name", MODELS)
@settings(max_examples=60, deadline=None)
@given(case=cases, aged=st.booleans())
def test_same_finite_bits_within_v_max_with_and_without_avx2(name: str, case: Case, aged: bool) -> None:
    model = flight_model(name, {"margin_rate": 0.1})
    best = lib.avoid_vector_level(-1)
    results = []
    try:
        for level in (0, best):
            lib.avoid_vector_level(level)
            results.append(command(model, case, case.age if aged else None))
    finally:
        lib.avoid_vector_level(best)
    assert results[0].tobytes() == results[1].tobytes()
    assert np.linalg.norm(results[0]) <= model.avoider.v_max * (1 + 1e-12)  # and finite


@pytest.mark.parametrize("name", MODELS)
@settings(max_examples=30, deadline=None)
@given(case=cases)
def test_own_entry_and_unknown_neighbours_are_ignored(name: str, case: Case) -> None:
    model = FLIGHT_MODELS[name]
    expected = command(model, case)
    changed = dataclasses.replace(case, position=case.position.copy(), velocity=case.velocity.copy())
    changed.position[:, case.index] = changed.velocity[:, case.index] = 77.0
    i = case.index
    result = avoid(model, i, case.position[:, i], case.velocity[:, i], case.goal, changed.position, changed.velocity)
    assert result.tobytes() == expected.tobytes()
    nan = np.full((3, 1), np.nan)
    wider = [np.hstack((a, nan)) for a in (case.position, case.velocity)]
    result = avoid(model, i, case.position[:, i], case.velocity[:, i], case.goal, *wider)
    assert result.tobytes() == expected.tobytes()


@pytest.mark.parametrize("name", ["orca", "potential", "jerky", "bvc"])
def test_two_agents_at_one_point_part(name: str) -> None:
    model = FLIGHT_MODELS[name]
    both = np.zeros((3, 2))
    commands = [avoid(model, i, both[:, i], both[:, i], np.zeros(3), both, both) for i in (0, 1)]
    assert all(np.all(np.isfinite(c)) for c in commands)
    if name == "orca":
        assert commands[0][0] < -0.1
        assert commands[1][0] > 0.1


@pytest.mark.parametrize("name", MODELS)
def test_all_agents_at_once_give_the_same_bits(name: str) -> None:
    model = FLIGHT_MODELS[name]
    case = make_case(3, 30, 2.0)
    goals = np.random.default_rng(1).uniform(-9, 9, (3, 30))
    swarm = Swarm(SwarmConfig(agents=30, avoider=name, estimator="oracle"), shared_table=True)
    swarm.position[:], swarm.velocity[:], swarm.goal[:] = case.position, case.velocity, goals
    swarm.steer(0, 0)
    for i in range(30):
        one = avoid(model, i, case.position[:, i], case.velocity[:, i], goals[:, i], case.position, case.velocity)
        assert one.tobytes() == swarm.command[:, i].tobytes()


@pytest.mark.parametrize(("name", "shortest"), [("orca", 0.25), ("potential", 0.35), ("bvc", 0.22), ("jerky", 0.25)])
def test_exchange_with_perfect_knowledge_is_safe(name: str, shortest: float) -> None:
    model, movers = FLIGHT_MODELS[name], 12
    random = np.random.default_rng(5)
    angle = 2 * np.pi * np.arange(movers) / movers
    radius = max(model.min_radius, model.spacing * movers / 2 / np.pi)
    position = radius * np.stack((np.cos(angle), np.sin(angle), 0 * angle)) + random.uniform(-0.05, 0.05, (3, movers))
    goal = np.roll(position, movers // 2, axis=1).copy()
    swarm = Swarm(SwarmConfig(agents=movers, avoider=name, estimator="oracle"), shared_table=True)
    assert swarm.config.slot_s == 0.01
    assert swarm.config.steps == 1
    swarm.position[:], swarm.goal[:] = position, goal
    first, second = np.triu_indices(movers, 1)
    nearest = math.inf
    for _ in range(1200):
        swarm.fly(0)
        nearest = min(nearest, np.linalg.norm(swarm.position[:, first] - swarm.position[:, second], axis=0).min())
        if np.all(np.linalg.norm(swarm.position - goal, axis=0) < 0.3):
            break
    else:
        pytest.fail("did not arrive within 12 s")
    assert nearest > shortest


def test_options_replace_values_of_all_groups() -> None:
    model = flight_model("orca", {"v_max": 1, "tau": 0.5, "spacing": 2.0})
    assert (model.avoider.v_max, model.vehicle.tau, model.spacing) == (1.0, 0.5, 2.0)
    assert FLIGHT_MODELS["orca"].avoider.v_max == 1.5


@pytest.mark.parametrize(("name", "options", "field"), [
    ("orcas", {}, "avoider"), ("orca", {"speed": 1.0}, "options.speed"), ("orca", {"v_max": 0.0}, "v_max"),
    ("orca", {"v_max": math.nan}, "v_max"), ("orca", {"v_max": "fast"}, "v_max"), ("orca", {"v_max": True}, "v_max"),
    ("orca", {"tau": -1.0}, "tau"), ("orca", {"spacing": 0.0}, "spacing"), ("potential", {"core": 1.31}, "core"),
])  # fmt: skip
def test_bad_settings_are_named(name: str, options: dict, field: str) -> None:
    with pytest.raises(ConfigError) as caught:
        flight_model(name, options)
    assert caught.value.field == field


vectors = st.lists(st.floats(-5, 5), min_size=3, max_size=3).map(np.array)


@given(vectors, vectors, vectors, st.sampled_from(sorted(FLIGHT_MODELS)), st.sampled_from([0.002, 0.01]))
def test_step_follows_the_formula(p: np.ndarray, v: np.ndarray, c: np.ndarray, name: str, dt: float) -> None:
    """Semi-implicit Euler: the position moves with the new velocity. Estimator ``intent`` relies on it."""
    params = FLIGHT_MODELS[name].vehicle
    a = (c - v) / params.tau
    size = math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    new_v = v + dt * (params.a_max / size if size > params.a_max else 1.0) * a
    new_p = p + dt * new_v
    params.step(dt, p, v, c)
    assert (p.tobytes(), v.tobytes()) == (new_p.tobytes(), new_v.tobytes())  # bit for bit


def test_many_vehicles_step_like_single_ones() -> None:
    params = VehicleParams()
    random = np.random.default_rng(2)
    p, v, c = random.normal(size=(3, 3, 23))
    singles = []
    for k in range(23):
        one_p, one_v = p[:, k].copy(), v[:, k].copy()
        params.step(0.01, one_p, one_v, c[:, k].copy())
        singles.append((one_p.tobytes(), one_v.tobytes()))
    params.step(0.01, p, v, c)
    assert singles == [(p[:, k].tobytes(), v[:, k].tobytes()) for k in range(23)]


def test_wrong_arrays_are_refused() -> None:
    params = VehicleParams(tau=0.1, a_max=2.0)
    for shapes in (((3,), (6,), (3,)), ((3, 2), (3, 2), (3,)), ((6,), (6,), (6,))):
        with pytest.raises(ValueError, match="shapes"):
            params.step(0.01, *map(np.zeros, shapes))
    frozen = np.zeros(3)
    frozen.flags.writeable = False
    with pytest.raises(ValueError, match="read-only"):
        params.step(0.01, frozen, np.zeros(3), np.zeros(3))
