"""The compiled avoiders against slow, plain versions of their formulas, and what every avoider promises."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dtsa_agent.core import _kernel
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.flight_models import FLIGHT_MODELS, KINDS, AvoiderParams, FlightModel, flight_model

MODELS = tuple(FLIGHT_MODELS)


@dataclasses.dataclass
class Case:
    """One question to an avoider."""

    index: int
    position: np.ndarray  # (3, N)
    velocity: np.ndarray  # (3, N)
    goal: np.ndarray  # (3,)
    age: np.ndarray  # (N,)


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
    return model.command(i, case.position[:, i], case.velocity[:, i], case.goal, case.position, case.velocity, age)


# --- plain references -----------------------------------------------------------------------------


def limited(vector: np.ndarray, largest: float) -> np.ndarray:
    norm = float(np.linalg.norm(vector))
    return vector if norm <= largest else vector * (largest / norm)


def preferred(params: AvoiderParams, case: Case) -> np.ndarray:
    to_goal = case.goal - case.position[:, case.index]
    distance = float(np.linalg.norm(to_goal))
    return to_goal / distance * min(params.v_max, params.gain * distance) if distance else np.zeros(3)


def margin(params: AvoiderParams, age: np.ndarray | None, j: int) -> float:
    return 0.0 if age is None else min(params.margin_max, params.margin_rate * age[j])


def half_planes(params: AvoiderParams, case: Case, age: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """n (m, 3) and b (m,), in the words of RVO2-3D."""
    i = case.index
    normals, bounds = [], []
    for j in range(case.position.shape[1]):
        r = case.position[:, j] - case.position[:, i]
        radius = params.radius + margin(params, age, j)
        if j == i or not float(np.linalg.norm(r)) < radius + 2 * params.v_max * params.horizon:
            continue
        relative = case.velocity[:, i] - case.velocity[:, j]
        distance2 = float(r @ r)
        if distance2 <= radius**2:
            w = relative - r / params.period
            depth = radius / params.period - np.linalg.norm(w)
        else:
            w = relative - r / params.horizon
            if w @ r < 0 and (w @ r) ** 2 > radius**2 * (w @ w):
                depth = radius / params.horizon - np.linalg.norm(w)
            else:
                b = float(r @ relative)
                cross = np.cross(r, relative)
                c = float(relative @ relative) - float(cross @ cross) / (distance2 - radius**2)
                t = (b + math.sqrt(max(0.0, b * b - distance2 * c))) / distance2
                w = relative - t * r
                depth = radius * t - np.linalg.norm(w)
        n = w / np.linalg.norm(w)
        normals.append(n)
        bounds.append(n @ (case.velocity[:, i] + depth * n / 2))
    return np.array(normals).reshape(-1, 3), np.array(bounds)


def soft_gradient(v: np.ndarray, wish: np.ndarray, n: np.ndarray, b: np.ndarray, rho: float) -> np.ndarray:
    return (v - wish) - rho * (np.maximum(0.0, b - n @ v) @ n if len(b) else 0.0)


def soft_minimum(wish: np.ndarray, n: np.ndarray, b: np.ndarray, rho: float) -> np.ndarray:
    """Minimiser of |v - wish|^2 / 2 + rho / 2 sum max(0, b - n.v)^2 by damped Newton steps.

    The function is strongly convex with modulus 1, so its gradient bounds the distance to the minimiser.
    """

    def value(v: np.ndarray) -> float:
        return float((v - wish) @ (v - wish) / 2 + rho / 2 * np.sum(np.maximum(0.0, b - n @ v) ** 2))

    v = wish.copy()
    for _ in range(300):
        gradient = soft_gradient(v, wish, n, b, rho)
        if np.linalg.norm(gradient) < 1e-12 * (1 + rho):
            break
        active = n[b - n @ v > 0]
        step = np.linalg.solve(np.eye(3) + rho * active.T @ active, -gradient)
        t = 1.0
        while value(v + t * step) > value(v) + 1e-4 * t * float(gradient @ step) and t > 1e-12:
            t /= 2
        v = v + t * step
    return v


def orca_reference(params: AvoiderParams, case: Case, age: np.ndarray | None) -> np.ndarray:
    x, y, z = preferred(params, case)
    wish = limited(np.array([x + params.bias * y, y - params.bias * x, z]), params.v_max)
    n, b = half_planes(params, case, age)
    best = soft_minimum(wish, n, b, params.softness)
    assert np.linalg.norm(soft_gradient(best, wish, n, b, params.softness)) < 1e-9
    return limited(best, params.v_max)


def potential_reference(params: AvoiderParams, case: Case, age: np.ndarray | None) -> np.ndarray:
    result = preferred(params, case)
    for j in range(case.position.shape[1]):
        away = case.position[:, case.index] - case.position[:, j]
        d = float(np.linalg.norm(away))
        reach, core = params.influence + margin(params, age, j), params.core + margin(params, age, j)
        if j == case.index or d >= reach:
            continue
        f = min(params.strength * (1 / max(d - core, 0.02) - 1 / (reach - core)), 4 * params.v_max)
        e = away / d
        result = result + f * (e + params.tangential * np.array([-e[1], e[0], 0.0]))
    return limited(result, params.v_max)


def bvc_walls(params: AvoiderParams, case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Outward unit normals a (m, 3) and c (m,): the cell is a.x <= c around the agent, the box included."""
    radii = params.radius * np.array([1.0, 1.0, params.stretch_z])
    normals = [sign * np.eye(3)[axis] for axis in range(3) for sign in (-1, 1)]
    bounds = [params.horizon * params.v_max] * 6
    for j in range(case.position.shape[1]):
        if j == case.index:
            continue
        q = (case.position[:, j] - case.position[:, case.index]) / radii
        a = q / radii / np.linalg.norm(q)
        normals.append(a / np.linalg.norm(a))
        bounds.append(float((np.linalg.norm(q) / 2 - 1) / np.linalg.norm(a)))
    return np.array(normals), np.array(bounds)


# --- the compiled kernel computes what the formulas say -------------------------------------------

orca_params = st.builds(
    AvoiderParams,
    radius=st.floats(0.2, 0.6),
    horizon=st.floats(0.5, 3),
    softness=st.sampled_from([1.0, 30.0, 300.0]),
    bias=st.floats(-0.3, 0.3),
    margin_rate=st.sampled_from([0.0, 0.05, 0.5]),
)


@settings(max_examples=150, deadline=None)
@given(cases, orca_params, st.booleans())
def test_orca_minimises_the_soft_problem(case: Case, params: AvoiderParams, aged: bool) -> None:
    model = dataclasses.replace(FLIGHT_MODELS["orca"], avoider=params)
    age = case.age if aged else None
    for j in range(case.position.shape[1]):
        # the cone is badly conditioned where the neighbour's sphere just touches
        gap = np.linalg.norm(case.position[:, j] - case.position[:, case.index]) - params.radius
        assume(j == case.index or abs(gap - margin(params, age, j)) > 1e-4)
    expected = orca_reference(params, case, age)
    assert command(model, case, age) == pytest.approx(expected, abs=1e-9)


def test_orca_agrees_with_hildreth_sweeps() -> None:
    model = FLIGHT_MODELS["orca"]
    rho = model.avoider.softness
    for seed in range(20):
        case = make_case(seed, 12, 1.2)
        x, y, z = preferred(model.avoider, case)
        v = limited(np.array([x + model.avoider.bias * y, y - model.avoider.bias * x, z]), model.avoider.v_max)
        n, b = half_planes(model.avoider, case, None)
        dual = np.zeros(len(b))
        for _ in range(3000):
            for j in range(len(b)):
                new = max(0.0, dual[j] + (b[j] - n[j] @ v - dual[j] / rho) / (1 + 1 / rho))
                v = v + (new - dual[j]) * n[j]
                dual[j] = new
        assert command(model, case) == pytest.approx(limited(v, model.avoider.v_max), abs=1e-6)


@pytest.mark.parametrize("name", ["potential", "jerky"])
@settings(max_examples=100, deadline=None)
@given(case=cases, aged=st.booleans(), rate=st.sampled_from([0.0, 0.1]))
def test_potential_adds_the_forces(name: str, case: Case, aged: bool, rate: float) -> None:
    model = flight_model(name, {"margin_rate": rate})
    age = case.age if aged else None
    assert command(model, case, age) == pytest.approx(potential_reference(model.avoider, case, age), abs=1e-9)


@pytest.mark.parametrize("name", ["bvc", "bvc-firmware"])
@settings(max_examples=100, deadline=None)
@given(case=cases)
def test_bvc_flies_to_the_nearest_point_of_its_cell(name: str, case: Case) -> None:
    params = dataclasses.replace(FLIGHT_MODELS[name].avoider, gain=0.05, sidestep=1e-6)
    model = dataclasses.replace(FLIGHT_MODELS[name], avoider=params)
    a, c = bvc_walls(params, case)
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


@given(case=cases)
def test_none_flies_straight(case: Case) -> None:
    model = FLIGHT_MODELS["none"]
    assert command(model, case) == pytest.approx(preferred(model.avoider, case), abs=1e-12)


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
    best = _kernel.vector_level()
    results = []
    try:
        for level in (0, best):
            _kernel.vector_level(level)
            results.append(command(model, case, case.age if aged else None).tobytes())
    finally:
        _kernel.vector_level(best)
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
    result = model.command(i, case.position[:, i], case.velocity[:, i], case.goal, changed.position, changed.velocity)
    assert result.tobytes() == expected.tobytes()
    nan = np.full((3, 1), np.nan)
    wider = [np.hstack((a, nan)) for a in (case.position, case.velocity)]
    result = model.command(i, case.position[:, i], case.velocity[:, i], case.goal, *wider)
    assert result.tobytes() == expected.tobytes()


@pytest.mark.parametrize("name", ["orca", "potential", "jerky", "bvc"])
def test_two_agents_at_one_point_part(name: str) -> None:
    model = FLIGHT_MODELS[name]
    both = np.zeros((3, 2))
    commands = [model.command(i, both[:, i], both[:, i], np.zeros(3), both, both) for i in (0, 1)]
    assert all(np.all(np.isfinite(c)) for c in commands)
    if name == "orca":
        assert commands[0][0] < -0.1
        assert commands[1][0] > 0.1


@pytest.mark.parametrize("name", MODELS)
def test_all_agents_at_once_give_the_same_bits(name: str) -> None:
    model = FLIGHT_MODELS[name]
    case = make_case(3, 30, 2.0)
    goals = np.random.default_rng(1).uniform(-9, 9, (3, 30))
    out = np.empty((3, 30))
    _kernel.avoid_all(
        model.kind,
        model.avoider.to_dict(),
        case.position,
        case.velocity,
        goals,
        case.position,
        case.velocity,
        None,
        out,
    )
    for i in range(30):
        one = model.command(i, case.position[:, i], case.velocity[:, i], goals[:, i], case.position, case.velocity)
        assert one.tobytes() == np.ascontiguousarray(out[:, i]).tobytes()


def test_margin_grows_with_age_up_to_its_limit() -> None:
    position = np.array([[0.0, 1.2], [0.0, 0.02], [0.0, 0.0]])
    velocity = np.array([[1.0, -1.0], [0.0, 0.0], [0.0, 0.0]])
    goal = np.array([5.0, 0.0, 0.0])
    model = flight_model("orca", {"margin_rate": 0.2, "margin_max": 0.3})
    fresh, old, older, oldest = (
        model.command(0, position[:, 0], velocity[:, 0], goal, position, velocity, np.full(2, age))
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
    velocity, out = np.zeros((3, movers)), np.zeros((3, movers))
    first, second = np.triu_indices(movers, 1)
    nearest = math.inf
    for _ in range(1200):
        _kernel.avoid_all(model.kind, model.avoider.to_dict(), position, velocity, goal, position, velocity, None, out)
        model.vehicle.step(0.01, position, velocity, out)
        nearest = min(nearest, np.linalg.norm(position[:, first] - position[:, second], axis=0).min())
        if np.all(np.linalg.norm(position - goal, axis=0) < 0.3):
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


def test_wrong_arrays_are_refused() -> None:
    values, good, table = FLIGHT_MODELS["orca"].avoider.to_dict(), np.zeros(3), np.zeros((3, 4))
    out = np.zeros(3)
    for bad in (np.zeros(2), np.zeros(3, dtype=np.float32), np.zeros(3, dtype=np.int64)):
        with pytest.raises(ValueError, match="position"):
            _kernel.avoid_command(0, values, 0, bad, good, good, table, table, None, out)
    with pytest.raises(ValueError, match="others_v"):
        _kernel.avoid_command(0, values, 0, good, good, good, table, np.zeros((3, 5)), None, out)
    with pytest.raises(ValueError, match="age_s"):
        _kernel.avoid_command(0, values, 0, good, good, good, table, table, np.zeros(3), out)
    with pytest.raises(ValueError, match="kind"):
        _kernel.avoid_command(4, values, 0, good, good, good, table, table, None, out)
    with pytest.raises(KeyError, match="softness"):
        _kernel.avoid_command(
            0,
            {"v_max": 1.0, "gain": 1.0, "radius": 1.0, "horizon": 1.0},
            0,
            good,
            good,
            good,
            table,
            table,
            None,
            out,
        )
