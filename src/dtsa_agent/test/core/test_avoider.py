"""The compiled avoiders against the formulas, and what every avoider promises."""

from __future__ import annotations

import dataclasses
import math

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
from dtsa_agent.core.settings.flight_models import FLIGHT_MODELS, KINDS, AvoiderParams, FlightModel, flight_model

MODELS = tuple(FLIGHT_MODELS)


def make_case(seed: int, count: int, size: float, speed: float = 1.5) -> Case:
    random = np.random.default_rng(seed)
    position = random.uniform(-size, size, (3, count))
    velocity = random.uniform(-speed, speed, (3, count)) / math.sqrt(3)
    return Case(int(random.integers(count)), position, velocity, random.uniform(-9, 9, 3), random.uniform(0, 2, count))


cases = st.builds(
    make_case,
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 45),
    size=st.sampled_from([0.3, 0.8, 1.5, 3.0, 8.0]),
    speed=st.sampled_from([0.0, 1.5, 3.0]),
)


def command(model: FlightModel, case: Case, age: np.ndarray | None = None) -> np.ndarray:
    i = case.index
    return avoid(model, i, case.position[:, i], case.velocity[:, i], case.goal, case.position, case.velocity, age)


# --- the compiled kernel computes what the formulas say -------------------------------------------

orca_params = st.builds(
    AvoiderParams,
    radius=st.floats(0.2, 0.6),
    horizon=st.floats(0.5, 3),
    softness=st.sampled_from([1.0, 30.0, 300.0]),
    bias=st.floats(-0.3, 0.3),
    margin_rate=st.sampled_from([0.0, 0.05, 0.5]),
)


def off_the_edges(model: FlightModel, case: Case, age: np.ndarray | None) -> bool:
    """Whether no neighbour's sphere just touches: a hair decides there, in both."""
    ages = 0 * case.age if age is None else age
    wider = np.minimum(model.avoider.margin_max, model.avoider.margin_rate * ages)
    gaps = np.linalg.norm(case.position - case.position[:, [case.index]], axis=0) - model.avoider.radius - wider
    return not (np.abs(np.delete(gaps, case.index)) < 1e-3).any()


@settings(max_examples=150, deadline=None)
@given(cases, orca_params, st.booleans())
def test_orca_minimises_the_soft_problem(case: Case, params: AvoiderParams, aged: bool) -> None:
    model, age = dataclasses.replace(FLIGHT_MODELS["orca"], avoider=params), case.age if aged else None
    assume(off_the_edges(model, case, age))
    assert command(model, case, age) == pytest.approx(plain_avoiders.command(model, case, age), abs=1e-9)


@pytest.mark.parametrize("name", MODELS)
@settings(max_examples=100, deadline=None)
@given(case=cases, aged=st.booleans(), rate=st.sampled_from([0.0, 0.1]))
def test_avoiders_command_what_the_formulas_say(name: str, case: Case, aged: bool, rate: float) -> None:
    model, age = flight_model(name, {"margin_rate": rate}), case.age if aged else None
    assume(off_the_edges(model, case, age))
    tolerance = 1e-9 if "bvc" in name else 1e-12  # its walls are stiff: 1e6 times what rounding does
    assert command(model, case, age) == pytest.approx(plain_avoiders.command(model, case, age), abs=tolerance)


@pytest.mark.parametrize("name", ["bvc", "bvc-firmware"])
@settings(max_examples=100, deadline=None)
@given(case=cases)
def test_bvc_flies_to_the_nearest_point_of_its_cell(name: str, case: Case) -> None:
    params = dataclasses.replace(FLIGHT_MODELS[name].avoider, gain=0.05, sidestep=1e-6)
    model = dataclasses.replace(FLIGHT_MODELS[name], avoider=params)
    normals, bounds = plain_avoiders.bvc_walls(case, params, 0 * case.age)
    a, c = -normals, -bounds
    goal = case.goal - case.position[:, case.index]
    target = command(model, case) / params.gain  # the gain is so small that no speed limit acts
    assume(np.all(c > 1e-3))  # in its own cell: the cell is not empty
    assert np.all(a @ target <= c + 1e-4)
    # nearest: no other point of the cell lies further in the direction of the goal (variational inequality)
    pull = goal - target
    touched = a[a @ target > c - 1e-4]
    if np.linalg.norm(pull) > 1e-3:
        weights = np.linalg.lstsq(touched.T, pull, rcond=None)[0] if len(touched) <= 3 else None
        assert len(touched) > 0
        if weights is not None:
            assert touched.T @ weights == pytest.approx(pull, abs=1e-3 * np.linalg.norm(pull) + 1e-6)
            assert np.all(weights > -1e-3 * np.linalg.norm(pull))


def test_bvc_stays_when_its_cell_is_empty() -> None:
    position = np.array([[0.0, 0.2, -0.2], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    case = Case(0, position, np.zeros((3, 3)), np.array([3.0, 0.0, 0.0]), np.zeros(3))
    assert command(FLIGHT_MODELS["bvc"], case) == pytest.approx(np.zeros(3), abs=1e-12)


def test_bvc_steps_to_its_right_in_front_of_a_wall() -> None:
    position = np.array([[0.0, 0.4], [0.0, 0.0], [0.0, 0.0]])
    case = Case(0, position, np.zeros((3, 2)), np.array([3.0, 0.0, 0.0]), np.zeros(2))
    assert command(FLIGHT_MODELS["bvc"], case)[1] < -0.1
    far = dataclasses.replace(case, position=np.array([[0.0, 2.0], [0.0, 0.0], [0.0, 0.0]]))
    assert command(FLIGHT_MODELS["bvc"], far)[1] == pytest.approx(0.0, abs=1e-9)


# --- what all avoiders promise --------------------------------------------------------------------


@pytest.mark.parametrize("name", MODELS)
@settings(max_examples=60, deadline=None)
@given(case=cases, aged=st.booleans())
def test_commands_are_finite_and_within_v_max(name: str, case: Case, aged: bool) -> None:
    model = flight_model(name, {"margin_rate": 0.1})
    result = command(model, case, case.age if aged else None)
    assert np.all(np.isfinite(result))
    assert np.linalg.norm(result) <= model.avoider.v_max * (1 + 1e-12)


@pytest.mark.parametrize("name", MODELS)
@settings(max_examples=60, deadline=None)
@given(case=cases, aged=st.booleans())
def test_same_bits_with_and_without_avx2(name: str, case: Case, aged: bool) -> None:
    model = flight_model(name, {"margin_rate": 0.1})
    best = lib.avoid_vector_level(-1)
    results = []
    try:
        for level in (0, best):
            lib.avoid_vector_level(level)
            results.append(command(model, case, case.age if aged else None).tobytes())
    finally:
        lib.avoid_vector_level(best)
    assert results[0] == results[1]


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


def test_margin_grows_with_age_up_to_its_limit() -> None:
    position = np.array([[0.0, 1.2], [0.0, 0.02], [0.0, 0.0]])
    velocity = np.array([[1.0, -1.0], [0.0, 0.0], [0.0, 0.0]])
    goal = np.array([5.0, 0.0, 0.0])
    model = flight_model("orca", {"margin_rate": 0.2, "margin_max": 0.3})
    fresh, old, older, oldest = (
        avoid(model, 0, position[:, 0], velocity[:, 0], goal, position, velocity, np.full(2, age))
        for age in (0.0, 0.5, 1.5, 9.0)
    )
    assert fresh[1] > old[1] > older[1]  # evades more widely
    assert older.tobytes() == oldest.tobytes()


@pytest.mark.parametrize(
    ("name", "movers", "shortest"),
    [("orca", 12, 0.25), ("potential", 12, 0.35), ("bvc", 12, 0.22), ("jerky", 12, 0.25)],
)
def test_exchange_with_perfect_knowledge_is_safe(name: str, movers: int, shortest: float) -> None:
    model = FLIGHT_MODELS[name]
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


# --- named models and bad input -------------------------------------------------------------------


def test_kinds_match_the_kernel() -> None:
    assert [FLIGHT_MODELS[name].kind for name in ("orca", "potential", "bvc", "none")] == [0, 1, 2, 3]
    assert len(KINDS) == 4


def test_options_replace_values_of_all_groups() -> None:
    model = flight_model("orca", {"v_max": 1, "tau": 0.5, "spacing": 2.0})
    assert (model.avoider.v_max, model.vehicle.tau, model.spacing) == (1.0, 0.5, 2.0)
    assert FLIGHT_MODELS["orca"].avoider.v_max == 1.5


@pytest.mark.parametrize(
    ("name", "options", "field"),
    [
        ("orcas", {}, "avoider"),
        ("orca", {"speed": 1.0}, "options.speed"),
        ("orca", {"v_max": 0.0}, "v_max"),
        ("orca", {"v_max": math.nan}, "v_max"),
        ("orca", {"v_max": "fast"}, "v_max"),
        ("orca", {"v_max": True}, "v_max"),
        ("orca", {"tau": -1.0}, "tau"),
        ("orca", {"spacing": 0.0}, "spacing"),
        ("potential", {"core": 1.31}, "core"),
    ],
)
def test_bad_settings_are_named(name: str, options: dict, field: str) -> None:
    with pytest.raises(ConfigError) as caught:
        flight_model(name, options)
    assert caught.value.field == field
