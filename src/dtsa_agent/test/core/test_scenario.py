"""Starts and targets: antipodal pairs, the same in every process."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_agent.core import SwarmConfig, make_scenario
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.scenario import half_axes


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 60), st.data())
def test_movers_exchange_places_in_pairs_and_others_stay(agents: int, data: st.DataObject) -> None:
    moving = 2 * data.draw(st.integers(0, agents // 2))
    shape = data.draw(st.sampled_from(["circle", "ellipse", "ellipsoid"]))
    scenario = make_scenario(
        SwarmConfig(agents=agents, moving=moving, seed=data.draw(st.integers(0, 999)), shape=shape)
    )
    assert scenario.moving.sum() == moving
    for k in range(agents):
        at = np.flatnonzero((scenario.target[:, k] == scenario.start.T).all(axis=1))
        if not scenario.moving[k]:
            assert np.array_equal(scenario.target[:, k], scenario.start[:, k])
        else:
            assert len(at) == 1
            assert at[0] != k
            assert np.array_equal(scenario.target[:, at[0]], scenario.start[:, k])


def test_partners_are_opposite() -> None:
    for shape in ("circle", "ellipse", "ellipsoid"):
        scenario = make_scenario(SwarmConfig(agents=18, shape=shape, jitter_m=0))
        np.testing.assert_allclose(scenario.target, -scenario.start, atol=1e-3 if shape == "ellipse" else 2e-6)


def test_the_same_seed_gives_the_same_scenario_and_another_seed_another() -> None:
    a, b, c = (make_scenario(SwarmConfig(agents=18, moving=10, seed=s)) for s in (1, 1, 2))
    assert np.array_equal(a.start, b.start)
    assert np.array_equal(a.target, b.target)
    assert np.array_equal(a.moving, b.moving)
    assert not np.array_equal(a.start, c.start)


def test_shape_and_jitter() -> None:
    flat = make_scenario(SwarmConfig(agents=12, shape="ellipse", axis_x_m=1.2, axis_y_m=2.0, jitter_m=0)).start
    np.testing.assert_allclose((flat[0] / 1.2) ** 2 + (flat[1] / 2.0) ** 2, 1.0, atol=1e-3)
    assert not flat[2].any()
    ball = make_scenario(SwarmConfig(agents=12, shape="ellipsoid", axis_x_m=2.0, jitter_m=0)).start
    np.testing.assert_allclose(np.linalg.norm(ball, axis=0), 2.0, atol=1e-5)
    config = SwarmConfig(agents=40, permute=False)
    moved = make_scenario(config).start - make_scenario(SwarmConfig(agents=40, permute=False, jitter_m=0)).start
    assert 0.03 < np.abs(moved).max() <= 0.05 + 1e-6


def test_the_circle_grows_with_the_swarm() -> None:
    radii = [half_axes(SwarmConfig(agents=n, avoider="orca"))[0] for n in (2, 12, 70)]
    assert radii == pytest.approx([2.2, 2.2, 0.9 * 70 / (2 * np.pi)])


def test_ids_are_dealt_out_at_random_unless_told_otherwise() -> None:
    ordered = make_scenario(SwarmConfig(agents=12, permute=False, jitter_m=0)).start
    angle = np.unwrap(np.arctan2(ordered[1], ordered[0]))
    assert (np.diff(angle) > 0).all()
    shuffled = make_scenario(SwarmConfig(agents=12, jitter_m=0)).start
    assert not np.array_equal(ordered, shuffled)
    told = make_scenario(SwarmConfig(agents=12, jitter_m=0, places="12,11,10,9,8,7 6 5 4 3 2 1")).start
    assert np.array_equal(told, ordered[:, ::-1])
    for places in ("1 2 3", "1 1 " + " ".join(map(str, range(3, 13))), "one"):
        with pytest.raises(ConfigError, match="1 to 12, each once"):
            SwarmConfig(agents=12, places=places)


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 41), st.data())
def test_a_mover_without_a_partner_has_a_far_point_of_its_own(agents: int, data: st.DataObject) -> None:
    moving = 2 * data.draw(st.integers(0, (agents - 1) // 2)) + 1
    shape, seed = data.draw(st.sampled_from(["circle", "ellipse", "ellipsoid"])), data.draw(st.integers(0, 999))
    config = SwarmConfig(agents=agents, moving=moving, seed=seed, shape=shape, permute=data.draw(st.booleans()))
    scenario = make_scenario(config)
    assert scenario.moving.sum() == moving
    start, target = scenario.start.T, scenario.target.T
    alone = [k for k in np.flatnonzero(scenario.moving) if not (target[k] == start).all(axis=1).any()]
    assert len(alone) == 1
    (k,) = alone
    way = target[k] - start[k]
    assert np.linalg.norm(way) == pytest.approx(2 * np.linalg.norm(start[k]) + 0.9, abs=1e-5)
    others = np.delete(target, k, axis=0)
    assert not len(others) or np.linalg.norm(others - target[k], axis=1).min() > 0.6
    pairs = make_scenario(SwarmConfig(**{**config.to_dict(), "moving": moving - 1}))
    assert np.array_equal(pairs.start, scenario.start)
    assert np.array_equal(np.delete(pairs.target, k, axis=1), np.delete(scenario.target, k, axis=1))


@pytest.mark.parametrize("kind", ["exchange", "staggered", "waypoints", "streams", "stop-and-go"])
@pytest.mark.parametrize(("agents", "moving"), [(7, 7), (7, 5), (6, 3), (1, 1)])
def test_odd_numbers_of_movers_fly_in_every_scenario(kind: str, agents: int, moving: int) -> None:
    scenario = make_scenario(SwarmConfig(agents=agents, moving=moving, scenario=kind, seed=4))
    movers = scenario.moving
    assert movers.sum() == moving
    last = scenario.target if scenario.plan is None else scenario.plan.goals[0]
    assert (np.linalg.norm(last - scenario.start, axis=0)[movers] > 0.5).all()
    assert np.array_equal(scenario.target[:, ~movers], scenario.start[:, ~movers])
    for places in (scenario.start, scenario.target):
        gaps = np.linalg.norm(places[:, :, None] - places[:, None], axis=0) + 9 * np.eye(agents)
        assert gaps.min() > 0.5
