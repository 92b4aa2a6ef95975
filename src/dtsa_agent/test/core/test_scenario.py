"""Starts, targets and goals one after the other: where they lead, and that everybody computes the same."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dtsa_agent.core import Scenario, Swarm, SwarmConfig, make_scenario
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.kernel import lib, memory
from dtsa_agent.core.settings.scenario import Course, Plan, half_axes


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
    for places in ("1 2 3", "1 1 " + " ".join(map(str, range(3, 13))), "one", "9" * 5000):
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


def scenario(**changes: Any) -> Scenario:
    return make_scenario(SwarmConfig(**{"agents": 12, **changes}))


def closest(points: np.ndarray) -> float:
    distance = np.linalg.norm(points[:, :, None] - points[:, None, :], axis=0)
    return float(distance[~np.eye(points.shape[1], dtype=bool)].min(initial=np.inf))


@pytest.mark.parametrize("kind", ["exchange", "staggered", "waypoints", "streams", "stop-and-go"])
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), agents=st.integers(1, 40), data=st.data())
@example(seed=4, agents=7, data=None)
@example(seed=4, agents=1, data=None)
def test_nobody_starts_or_ends_too_close(kind: str, seed: int, agents: int, data: st.DataObject | None) -> None:
    """Odd numbers of movers fly as well."""
    moving = data.draw(st.integers(0, agents)) if data else agents
    made = scenario(scenario=kind, seed=seed, agents=agents, moving=moving)
    assert int(made.moving.sum()) == moving
    for places in (made.start, made.target):
        assert closest(places) > (0.5 if moving % 2 else 0.6)
    first = made.target if made.plan is None else made.plan.goals[0]
    if kind != "waypoints" or moving % 2 == 0:  # the odd one's start is nobody's goal, and a waypoint may lie near it
        assert (np.linalg.norm(first - made.start, axis=0)[made.moving] > 0.5).all()
    assert np.array_equal(made.target[:, ~made.moving], made.start[:, ~made.moving])
    again = scenario(scenario=kind, seed=seed, agents=agents, moving=moving)
    assert np.array_equal(made.start, again.start)
    if made.plan is not None and again.plan is not None:
        assert np.array_equal(made.plan.goals, again.plan.goals)
        assert np.array_equal(made.plan.begin, again.plan.begin)


def test_the_exchange_is_the_same_whatever_else_there_is() -> None:
    plain, staggered = scenario(seed=4), scenario(seed=4, scenario="staggered")
    assert np.array_equal(plain.start, staggered.start)
    assert np.array_equal(plain.target, staggered.target)
    assert plain.plan is None


def test_pairs_start_one_after_the_other() -> None:
    made = scenario(scenario="staggered", stagger_slots=70, moving=8, seed=3)
    assert made.plan is not None
    begin = made.plan.begin[made.moving]
    assert sorted(begin.tolist()) == [0, 0, 70, 70, 140, 140, 210, 210]
    for k in np.flatnonzero(made.moving):
        mate = np.flatnonzero((made.start == made.target[:, [k]]).all(axis=0))[0]
        assert made.plan.begin[k] == made.plan.begin[mate]


def test_streams_cross_at_right_angles() -> None:
    made = scenario(scenario="streams", agents=14, moving=12, jitter_m=0)
    way = (made.target - made.start)[:, made.moving]
    lengths = np.abs(way).max(axis=0)
    assert np.allclose(lengths, lengths[0])
    assert int((way[0] > 1).sum()) == int((way[1] > 1).sum()) == 6
    assert not way[2].any()
    along_x = made.start[:, made.moving][:, way[0] > 1]
    along_y = made.start[:, made.moving][:, way[1] > 1]
    assert along_x[0].max() < along_y[0].min() - 1.0
    assert along_y[1].max() < along_x[1].min() - 1.0


def test_waypoints_lie_in_the_shape_and_away_from_where_others_end() -> None:
    made = scenario(scenario="waypoints", agents=10, moving=6, stops=4, seed=9)
    assert made.plan is not None
    assert made.plan.goals.shape == (5, 3, 10)
    radius = np.linalg.norm(made.start[:2], axis=0).max()
    for goals in made.plan.goals[:-1]:
        mine = goals[:, made.moving]
        assert np.linalg.norm(mine[:2], axis=0).max() <= radius + 0.1
        assert np.abs(mine[2]).max() <= 0.5
        gaps = np.linalg.norm(mine[:, :, None] - made.target[:, None, :], axis=0)
        assert gaps.min() >= 0.85
        assert closest(mine) >= 0.85
    assert np.array_equal(made.plan.goals[-1], made.target)


def test_stop_and_go_shuttles_and_ends_where_the_number_of_legs_leads() -> None:
    for stops, home in ((1, True), (2, False), (3, True)):
        made = scenario(scenario="stop-and-go", stops=stops, seed=2)
        assert np.array_equal(made.target, made.start) == home
        assert made.plan is not None
        line = np.linalg.norm(made.plan.goals[0] - made.start, axis=0)
        assert np.allclose(made.path_length, (stops + 1) * line)


def one_agent(legs: int, begin: int = 0, pause: int = 0) -> Scenario:
    goals = np.zeros((legs, 3, 1))
    goals[:, 0, 0] = np.arange(1, legs + 1)
    plan = Plan(goals, np.array([begin]), np.array([pause]))
    return Scenario(np.zeros((3, 1)), goals[-1], np.array([True]), plan)


def advance(course: Course, slot: int, position: np.ndarray) -> bool:
    return bool(lib.course_advance(course.kernel, slot, memory(np.ascontiguousarray(position))))


def test_an_agent_rests_at_its_goals_and_then_goes_on() -> None:
    course = one_agent(3, begin=5, pause=4).course(np.array([0], dtype=np.int32), r_min=0.3)
    assert course is not None
    legs = []
    for slot in range(30):
        # It needs three slots to a goal, and is pushed out of it for one slot while it rests.
        leg = int(course.leg[0])
        there = slot - int(course.changed[0]) >= 3
        x = (leg + 1.0 if there else leg + 0.5) if leg >= 0 else 0.0
        if there and slot - int(course.changed[0]) == 5:
            x += 0.4
        changed = advance(course, slot, np.array([[x], [0.0], [0.0]]))
        assert changed == (course.changed[0] == slot)
        legs.append(int(course.leg[0]))
    assert legs == [-1] * 5 + [0] * 7 + [1] * 7 + [2] * 11


def test_each_agent_alone_computes_what_all_together_compute() -> None:
    made = scenario(scenario="stop-and-go", agents=6, pause_slots=20, seed=1)
    assert made.plan is not None
    together = made.course(np.arange(6, dtype=np.int32), r_min=0.3)
    alone = [made.course(np.array([k], dtype=np.int32), r_min=0.3) for k in range(6)]
    assert together is not None
    random = np.random.default_rng(0)
    for slot in range(200):
        near = random.random(6) < 0.1
        position = np.where(near, together.goal, together.goal + 5.0)
        advance(together, slot, position)
        for k, course in enumerate(alone):
            assert course is not None
            advance(course, slot, position[:, [k]])
            assert np.array_equal(course.goal[:, 0], together.goal[:, k])
    assert (together.leg == len(made.plan.goals) - 1).all()


def test_the_swarm_gets_goals_activity_and_what_all_know() -> None:
    config = SwarmConfig(agents=6, scenario="staggered", stagger_slots=10, moving=4, policy="tdma")
    for shared in (True, False):
        swarm = Swarm(config, shared_table=shared)
        made = swarm.scenario
        assert made.plan is not None
        late = int(np.flatnonzero(made.plan.begin == 10)[0])
        for slot in range(30):
            made.advance(slot, swarm)
            senders = swarm.begin(slot)
            data = swarm.frame(senders[0])
            swarm.fly(slot)
            swarm.hear(slot, data)
            swarm.end(slot)
            begun = slot >= 10
            assert np.array_equal(swarm.goal[:, late], (made.target if begun else made.start)[:, late])
            assert np.array_equal(swarm.known_goal[:, late], (made.target if begun else made.start)[:, late])
            said = begun and swarm.sent_slot[0 if shared else late, late] >= 10
            assert bool(swarm.final[late]) == begun
            if slot == 9 or (begun and not said):
                assert not swarm.active[late]
        assert swarm.active[late]
        assert not swarm.active[~made.moving].any()
        swarm.reset()
        assert swarm.course is not None
        assert (swarm.course.leg == -1).all()
        assert np.array_equal(swarm.known_goal, made.target)


def test_where_goals_are_not_known_who_rests_is_where_it_said() -> None:
    config = SwarmConfig(agents=4, scenario="waypoints", policy="tdma", r_min=0.5)
    swarm = Swarm(config, shared_table=True)
    swarm.scenario.advance(0, swarm)
    swarm.position[:, 0] = swarm.goal[:, 0] + np.array([0.3, 0.0, 0.0])
    data = swarm.frame(swarm.begin(0)[0])
    swarm.hear(0, data)
    assert not swarm.in_ap[0, 0]
    assert np.abs(swarm.sent_position[0, :, 0] - swarm.position[:, 0]).max() <= 0.001
