"""Agents in slots: who sends, what everybody believes, and what the options of DTSA do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from slot_helpers import one_slot

from dtsa_agent.core import REASONS, ConfigError, Swarm, SwarmConfig, encode_frame
from dtsa_agent.core.frame import Frame

COLLISION_FREE = ("tdma", "dtsa", "age", "innovation")


def fly(slots: int, **settings: Any) -> tuple[Swarm, list[list[int]]]:
    swarm = Swarm(SwarmConfig(**settings))
    return swarm, [list(one_slot(swarm, slot)) for slot in range(slots)]


@pytest.mark.parametrize("agents", [2, 3, 12, 18, 40])
@pytest.mark.parametrize("policy", COLLISION_FREE)
@settings(max_examples=5, deadline=None)
@given(data=st.data())
def test_never_two_senders_and_everyone_agrees(policy: str, agents: int, data: st.DataObject) -> None:
    """Every agent has a table of its own here, fed by what it hears only."""
    moving = 2 * data.draw(st.integers(0, agents // 2))
    swarm = Swarm(SwarmConfig(
        agents=agents, moving=moving, policy=policy, seed=data.draw(st.integers(0, 10**6)),
        estimator=data.draw(st.sampled_from(["hold", "linear", "intent"])),
        selection=data.draw(st.sampled_from(["candidates", "pairwise"])),
        epsilon=data.draw(st.sampled_from([0.0, 0.1, 0.5, 1.0])), boot_round=data.draw(st.booleans()),
        age_cap=data.draw(st.sampled_from([0.0, 1.0, 1.5, 10.0])), return_every=data.draw(st.sampled_from([0, 1, 20])),
    ))  # fmt: skip
    for slot in range(min(700, 6 * agents + 250)):
        senders = list(one_slot(swarm, slot))
        assert len(senders) <= 1
        assert (swarm.chosen == swarm.chosen[0]).all()
        assert (swarm.digest == swarm.digest[0]).all()
        assert senders == ([int(swarm.chosen[0])] if swarm.chosen[0] else [])


def test_age_is_round_robin_over_a_p() -> None:
    swarm, senders = fly(80, agents=6, moving=2, policy="age", return_every=0)
    movers = sorted(int(k) + 1 for k in np.flatnonzero(swarm.scenario.moving))
    assert sorted(s[0] for s in senders[:6]) == [1, 2, 3, 4, 5, 6]
    assert senders[10:20] in ([[movers[0]], [movers[1]]] * 5, [[movers[1]], [movers[0]]] * 5)


def test_innovation_hears_an_agent_that_turns_more_often_than_one_that_flies_straight() -> None:
    swarm = Swarm(SwarmConfig(agents=6, moving=6, policy="innovation", avoider="none", axis_x_m=50.0))
    senders = []
    for slot in range(300):
        swarm.velocity[:] = 1.0
        swarm.velocity[0, 2] = 1.5 if slot // 7 % 2 else 0.5  # agent 3
        senders += one_slot(swarm, slot)
    heard = [senders[20:].count(agent) for agent in range(1, 7)]
    assert heard[2] > 1.5 * max(heard[:2] + heard[3:])
    assert min(heard) > 5


def test_without_boot_round_and_age_cap_the_literal_text_starves() -> None:
    """Only the first sender has g > 0 and keeps the channel; with the additions everyone is heard."""
    literal = {"boot_round": False, "age_cap": 0.0, "return_every": 0, "selection": "pairwise"}
    _, senders = fly(300, agents=12, policy="dtsa", avoider="none", **literal)
    assert len({s[0] for s in senders if s}) < 12
    _, senders = fly(300, agents=12, policy="dtsa", avoider="none")
    assert len({s[0] for s in senders if s}) == 12


@pytest.mark.parametrize("cap", [1.0, 1.5, 3.0])
def test_nobody_in_a_p_is_silent_for_longer_than_the_age_cap(cap: float) -> None:
    swarm = Swarm(SwarmConfig(agents=10, policy="dtsa", age_cap=cap, return_every=0))
    worst = 0
    for slot in range(300):
        one_slot(swarm, slot)
        silent = slot - swarm.last_turn[0][swarm.in_ap[0] == 1]
        worst = max(worst, int(silent.max(initial=0))) if slot > 20 else 0
    # Ten agents may reach the cap at the same time: the last of them waits for the other nine.
    assert worst <= cap * 10 + 10


def test_hoverers_leave_a_p_and_come_to_rest_at_their_targets() -> None:
    swarm, _ = fly(12, agents=12, moving=2, policy="dtsa")
    for table in range(12):
        assert np.array_equal(swarm.in_ap[table].astype(bool), swarm.scenario.moving)
        outside = ~swarm.scenario.moving
        assert np.array_equal(swarm.sent_position[table][:, outside], swarm.scenario.target[:, outside])
        assert not swarm.sent_velocity[table][:, outside].any()


def test_arrived_agents_leave_a_p_and_return_when_they_are_pushed_away() -> None:
    swarm, _ = fly(900, agents=4, moving=4, policy="dtsa")
    assert not swarm.in_ap.any()
    swarm.position[:, 1] = swarm.goal[:, 1] + np.array([1.0, 0.0, 0.0])
    returned = []
    for slot in range(900, 1100):
        one_slot(swarm, slot)
        if swarm.in_ap[0, 1]:
            returned.append(slot)
            assert swarm.in_ap[:, 1].all()
            break
    assert returned
    assert returned[0] <= 900 + 20 * 4
    assert REASONS[swarm.reason[0]] == "return"


def test_an_empty_a_p_uses_the_return_slots_only() -> None:
    swarm = Swarm(SwarmConfig(agents=5, moving=0, policy="dtsa"))
    senders = [list(one_slot(swarm, slot)) for slot in range(205)]
    used = [slot for slot, who in enumerate(senders) if who]
    assert used == [0, 1, 2, 3, 4, *range(19, 205, 20)]
    assert {senders[slot][0] for slot in used[5:]} == {1, 2, 3, 4, 5}


def test_counters_follow_the_equation() -> None:
    """eq:secondary: zero for the sender of the slot before, one more for everybody else."""
    swarm = Swarm(SwarmConfig(agents=6, policy="dtsa"))
    expected = np.zeros(6, dtype=np.int64)
    for slot in range(150):
        one_slot(swarm, slot)
        expected += 1
        if swarm.chosen[0]:
            expected[int(swarm.chosen[0]) - 1] = 0
        assert np.array_equal(slot - swarm.last_turn[0], expected)


@pytest.mark.parametrize("estimator", ["hold", "linear"])
def test_estimates_follow_the_equation(estimator: str) -> None:
    """eq:estimate, also for the own entry: from the last sent, quantised state, never from the true one."""
    swarm, _ = fly(47, agents=6, policy="tdma", estimator=estimator, slot_ms=20)
    swarm.estimate(47)
    age = (47 - swarm.sent_slot[0]) * 0.02
    factor = age if estimator == "linear" else 0.0
    expected = swarm.sent_position[0] + factor * swarm.sent_velocity[0]
    np.testing.assert_allclose(swarm.estimate_position[0], expected, rtol=0, atol=1e-12)
    steps = swarm.sent_position / 0.002
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    swarm.estimate(47, 1)
    half_slot = 0.01 if estimator == "linear" else 0.0
    np.testing.assert_allclose(swarm.estimate_position[0], expected + half_slot * swarm.sent_velocity[0], atol=1e-12)


def test_intent_predicts_an_unhindered_vehicle_exactly() -> None:
    """With the commanded velocity in the frame, only quantisation is left of the error while the command stands."""
    config = SwarmConfig(
        agents=8, policy="tdma", estimator="intent", avoider="none", axis_x_m=40, options={"a_max": 50}
    )
    errors = {}
    for name in ("intent", "linear"):
        swarm = Swarm(SwarmConfig(**{**config.to_dict(), "estimator": name}))
        errors[name] = 0.0
        for slot in range(32):
            one_slot(swarm, slot)
            if slot >= 8:
                swarm.estimate(slot + 1)
                errors[name] = max(errors[name], float(np.abs(swarm.estimate_position[0] - swarm.position).max()))
    assert errors["intent"] < 0.0025
    assert errors["linear"] > 0.01


def test_the_oracle_knows_the_truth() -> None:
    swarm, _ = fly(30, agents=4, policy="tdma", estimator="oracle")
    swarm.estimate(30)
    assert np.array_equal(swarm.estimate_position[0], swarm.position)


def test_aloha_sends_with_probability_one_over_n_p() -> None:
    config = SwarmConfig(agents=10, policy="aloha", avoider="none", axis_x_m=100, extent_m=110, seed=5)
    swarm, counts = Swarm(config), np.zeros(4, dtype=int)
    for slot in range(4000):
        counts[min(len(one_slot(swarm, slot)), 3)] += 1
    share = counts / counts.sum()
    # Binomial(10, 0.1): 0.349 silent, 0.387 alone.
    assert share[0] == pytest.approx(0.349, abs=0.03)
    assert share[1] == pytest.approx(0.387, abs=0.03)


def test_frames_from_elsewhere_are_counted_and_change_nothing() -> None:
    swarm, _ = fly(20, agents=4, policy="dtsa")
    before = swarm.sent_position.copy(), swarm.digest.copy(), swarm.sent_slot.copy()
    good = Frame(2, 20, 1, (9.0, 9.0, 9.0), (1.0, 0.0, 0.0))
    for data in (b"", b"\xff" * 19, encode_frame(good)[:-1], bytes(60)):
        assert not swarm.hear(20, data)
    assert swarm.malformed == 4
    assert not swarm.hear(20, encode_frame(Frame(5, 20, 1, good.position, good.velocity)))
    assert not swarm.hear(20, encode_frame(Frame(2, 3, 1, good.position, good.velocity)))
    assert not swarm.hear(20, encode_frame(Frame(2, 21, 1, good.position, good.velocity)))
    assert swarm.foreign == 3
    swarm.decide(20)
    assert np.array_equal(before[0], swarm.sent_position)
    assert np.array_equal(before[2], swarm.sent_slot)
    assert swarm.hear(20, encode_frame(good))
    assert swarm.sent_position[0, :, 1].tolist() == [9.0, 9.0, 9.0]


def test_absent_agents_neither_send_nor_fly() -> None:
    swarm = Swarm(SwarmConfig(agents=4, policy="tdma"))
    for slot in range(8):
        one_slot(swarm, slot)
    swarm.present[2] = 0
    place = swarm.position[:, 2].copy()
    senders = [list(one_slot(swarm, slot)) for slot in range(8, 24)]
    assert [3] not in senders
    assert [] in senders
    assert np.array_equal(swarm.position[:, 2], place)


@pytest.mark.parametrize("ids", [[0], [5], [2, 1], [1, 1]])
def test_ids_that_do_not_exist_are_refused(ids: list[int]) -> None:
    with pytest.raises(ConfigError, match="local"):
        Swarm(SwarmConfig(agents=4), local=ids)
