"""Integration: environments for learning fly what `simulate` flies, to the digit, and obey PettingZoo's rules."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import dtsa
from dtsa.env import Observer, SlotResults, batch_env, fields, parallel_env
from dtsa_bench.simulation.environment.batch import BatchEnv
from dtsa_bench.simulation.simulate import simulate

# What agents that say no more than "I send" or "I do not" leave open: whom they take for the sender.
OPEN = {"policy", "agreement_share", "equal_tables_share", "first_divergence_slot", "wall_time_s", "realtime_factor"}
SHORT: dict[str, Any] = {"agents": 6, "timeout_s": 1.5}


def tdma(observations: NDArray[np.float32], agents: int) -> NDArray[np.bool_]:
    """(..., N) the owner of the slot."""
    return fields(observations, agents)["turn_in"] == 0


def oldest(observations: NDArray[np.float32], agents: int) -> NDArray[np.bool_]:
    """(..., N) policy `age` without turns for those outside A_p: the member silent for longest, of these the first."""
    seen = fields(observations, agents)
    ids = (np.arange(agents)[:, None] + np.arange(agents)) % agents
    rank = np.where(seen["moves"] > 0, seen["silence"] * agents - ids, -np.inf)
    return (rank.argmax(axis=-1) == 0) & (rank.max(axis=-1) > -np.inf)


class Impatient:
    """A plug-in that sends by what it observes: in its own turn, and before it if the others err about it."""

    may_join = True

    def __init__(self, config: dtsa.SwarmConfig, agent: int) -> None:
        self._agent, self._agents, self._observe = agent, config.agents, Observer(config, agent)
        self.seen: list[NDArray[np.float32]] = []

    def choose(self, table: dtsa.Table, slot: int) -> int:
        observation = self._observe(table, slot)
        self.seen.append(observation.copy())
        return self._agent if impatient(observation, self._agents) else 0


def impatient(observations: NDArray[np.float32], agents: int) -> NDArray[np.bool_]:
    seen = fields(observations, agents)
    own_error = np.abs(seen["position"][..., 0]).max(axis=-1)
    return (seen["turn_in"] == 0) | ((seen["turn_in"] == 1) & (own_error > 0.001))


def flown(env: BatchEnv, rule: Any) -> list[tuple[tuple[int, ...], int, NDArray[np.float64]]]:
    """Senders, outcome and true positions of each slot until the first flight is over."""
    slots = []
    observations = env.reset()
    while not (env.terminated | env.truncated)[0]:
        observations, *_ = env.step(rule(observations, env.agents))
        flight = env.flight(0)
        slots.append((flight.senders, flight.outcome, flight.swarm.track.copy()))
    return slots


@pytest.mark.parametrize(
    ("policy", "rule", "settings"),
    [
        ("tdma", tdma, {"loss": 0.2, "seed": 3}),
        ("tdma", tdma, {"estimator": "intent", "scenario": "waypoints", "seed": 4, "slot_ms": 20.0}),
        ("age", oldest, {"return_every": 0, "moving": 4, "seed": 5}),
        ("tdma", tdma, {"agents": 12, "slot_ms": 100.0, "seed": 1, "collision_m": 1.0, "timeout_s": 9.0}),
    ],
)
def test_a_scripted_policy_flies_what_simulate_flies(policy: str, rule: Any, settings: dict[str, Any]) -> None:
    settings = SHORT | settings
    run = dtsa.run_config(policy=policy, **settings)
    expected = simulate(run, trace=True, shared_table=False)  # one table for all adds up errors in another order
    env = batch_env(run, flights=2, autoreset=False)
    slots = flown(env, rule)
    trace = expected.trace
    assert trace is not None
    assert [each[0] for each in slots] == trace.senders
    assert [each[1] for each in slots] == trace.outcomes
    np.testing.assert_array_equal(np.stack([each[2] for each in slots]), np.stack(trace.tracks))
    summary, wanted = env.ended[0].summary, expected.summary()
    assert {name: summary[name] for name in wanted if name not in OPEN} == {
        name: wanted[name] for name in wanted if name not in OPEN
    }
    assert env.terminated[0] == (wanted["end"] != "timed out")
    assert env.truncated[0] == (wanted["end"] == "timed out")


def test_a_plug_in_that_observes_is_what_flew_in_the_environment() -> None:
    made: list[Impatient] = []
    dtsa.register("policy", "impatient", lambda config, agent: made.append(Impatient(config, agent)) or made[-1])
    settings = SHORT | {"loss": 0.1, "moving": 4, "seed": 8}
    flight = dtsa.simulate(policy="impatient", **settings)
    env = batch_env(autoreset=False, flights=1, **settings)
    slots, observations = [], env.reset()
    while not env.truncated[0]:
        slots.append(observations[0].copy())
        observations, *_ = env.step(impatient(observations, env.agents))
    assert flight.summary["slots"]["collision"] > 0
    left_out = {"policy", "wall_time_s", "realtime_factor"}
    assert {k: v for k, v in env.ended[0].summary.items() if k not in left_out} == {
        k: v for k, v in flight.summary.items() if k not in left_out
    }
    for agent, plug_in in enumerate(made):
        np.testing.assert_array_equal(np.stack(plug_in.seen), np.stack([slot[agent] for slot in slots]))


def test_observations_say_what_a_table_holds() -> None:
    env = batch_env(flights=1, loss=0.3, seed=2, **SHORT)
    observations = env.reset()
    for _ in range(40):
        observations, *_ = env.step(tdma(observations, 6))
    swarm, seen = env.flight(0).swarm, fields(observations[0], 6)
    swarm.estimate(40)
    for row in range(6):
        order = [(row + k) % 6 for k in range(6)]
        sent = swarm.sent_slot[row][order]
        assert seen["age"][row].tolist() == np.where(sent < 0, -1, 39 - sent).tolist()
        assert seen["silence"][row].tolist() == (39 - swarm.last_turn[row][order]).tolist()
        assert seen["moves"][row].tolist() == swarm.in_ap[row][order].tolist()
        away = swarm.estimate_position[row][:, order] - swarm.position[:, row, None]
        np.testing.assert_allclose(seen["position"][row], away, atol=1e-5)
        speed = swarm.estimate_velocity[row][:, order] - swarm.velocity[:, row, None]
        np.testing.assert_allclose(seen["relative_velocity"][row], speed, atol=1e-6)
        np.testing.assert_allclose(seen["goal"][row], swarm.goal[:, row] - swarm.position[:, row], atol=1e-5)
    assert seen["slot"].tolist() == [40] * 6
    assert seen["turn_in"].tolist() == [(row - 40) % 6 for row in range(6)]
    assert seen["far"].tolist() == [1] * 6


def test_rewards_are_the_ages_that_the_summary_counts() -> None:
    pairs: list[tuple[int, int]] = []

    def noting(results: SlotResults) -> NDArray[np.float64]:
        counted = results.ages[0] >= 0
        pairs.append((int(results.ages[0][counted].sum()), int(counted.sum())))
        return np.full((1, 1), 7.0)

    env = batch_env(flights=1, autoreset=False, reward=noting, loss=0.2, moving=4, scenario="waypoints", **SHORT)
    flown(env, tdma)
    total, number = (sum(column) for column in zip(*pairs, strict=True))
    assert env.rewards.tolist() == [[7.0] * 6]
    assert env.ended[0].summary["waking_age_mean_slots"] == total / number


def test_a_crash_ends_the_flight_and_costs_the_penalty() -> None:
    env = batch_env(flights=1, autoreset=False, reward=dtsa.env.MeanAge(crash=500.0), collision_m=5.0, **SHORT)
    observations = env.reset()
    while not env.terminated[0]:
        observations, rewards, *_ = env.step(tdma(observations, 6))
    assert env.ended[0].summary["collided"]
    assert -520.0 < rewards[0, 0] < -499.0


def test_flights_follow_each_other_by_their_seeds() -> None:
    env = batch_env(flights=2, slots=30, **SHORT)
    observations, first = env.reset(seed=[11, 4]), env.observations.copy()
    ended = []
    for _ in range(60):
        observations, _, _, truncated = env.step(tdma(observations, 6))
        ended += env.ended
    assert [(each.flight, each.seed) for each in ended] == [(0, 11), (1, 4), (0, 5), (1, 6)]
    assert [each.summary["slots"]["total"] for each in ended] == [30] * 4
    assert ended[0].observation.shape == (6, env.observation_size)
    assert truncated.all()
    assert fields(observations, 6)["slot"].tolist() == [[0] * 6] * 2
    np.testing.assert_array_equal(env.reset(seed=[11, 4]), first)
    env.reset()  # goes on with the numbers after those
    assert [env.flight(row).run.swarm.seed for row in range(2)] == [5, 6]


@pytest.mark.parametrize(
    "settings", [{"loss": 0.2, "scenario": "waypoints"}, {"estimator": "ahead"}, {"slot_ms": 25.0}]
)
def test_flights_that_follow_are_those_of_simulate(settings: dict[str, Any]) -> None:
    class Ahead:
        """The last state heard, a tenth of a second later."""

        def __init__(self, config: dtsa.SwarmConfig, agent: int) -> None:
            pass

        def estimate(self, table: dtsa.Table, slot: int, step: int, position: Any, velocity: Any) -> None:
            position[...] = table.sent_position + 0.1 * table.sent_velocity
            velocity[...] = table.sent_velocity

    dtsa.register("estimator", "ahead", Ahead)
    settings = SHORT | {"timeout_s": 0.5, "moving": 4} | settings
    env = batch_env(flights=2, **settings)
    observations, ended = env.reset(seed=5), []
    while len(ended) < 6:
        observations, *_ = env.step(tdma(observations, 6))
        ended += env.ended
    for each in ended:
        wanted = simulate(dtsa.run_config(policy="tdma", seed=each.seed, **settings), shared_table=False).summary()
        assert {name: each.summary[name] for name in wanted if name not in OPEN} == {
            name: wanted[name] for name in wanted if name not in OPEN
        }
    assert sorted(each.seed for each in ended) == [5, 6, 7, 8, 9, 10]


def test_what_cannot_be_used_is_named() -> None:
    for settings, fault in (
        ({"policy": "tdma"}, "policy"), ({"flights": 0}, "flights"), ({"slots": True}, "slots"), ({"loss": 2}, "loss"),
    ):  # fmt: skip
        with pytest.raises(dtsa.ConfigError, match=fault):
            batch_env(**settings)
    env = batch_env(flights=1, **SHORT)
    with pytest.raises(dtsa.ConfigError, match="reset"):
        env.step(np.zeros((1, 6), dtype=bool))
    for seed in (-1, 1.5, [1, 2], [], 2**63, "7"):
        with pytest.raises(dtsa.ConfigError, match="seed"):
            env.reset(seed)  # type: ignore[arg-type]
    env.reset()
    for actions in (np.zeros(6), np.zeros((1, 6)), np.full((1, 6), 2)):
        with pytest.raises(dtsa.ConfigError, match="actions"):
            env.step(actions)
    with pytest.raises(dtsa.ConfigError, match="actions"):
        dtsa.simulate(policy="actions", **SHORT)
    env = batch_env(flights=6, reward=lambda results: results.ages.sum(axis=(1, 2)), **SHORT)
    env.reset()
    with pytest.raises(dtsa.ConfigError, match="reward"):
        env.step(np.zeros((6, 6), dtype=bool))


def test_pettingzoo_finds_nothing_wrong() -> None:
    checks = pytest.importorskip("pettingzoo.test")
    from pettingzoo.test.render_test import render_test
    from pettingzoo.utils.conversions import parallel_to_aec

    checks.parallel_api_test(parallel_env(slots=40, **SHORT), num_cycles=100)
    checks.parallel_seed_test(lambda: parallel_env(slots=40, **SHORT), num_cycles=60)
    render_test(lambda render_mode: parallel_to_aec(parallel_env(agents=2, slots=3, render_mode=render_mode)))


def test_the_parallel_form_flies_the_same() -> None:
    pytest.importorskip("pettingzoo")
    env = parallel_env(loss=0.1, render_mode="rgb_array", **SHORT)
    observations, _ = env.reset(seed=6)
    empty = env.render()
    while env.agents:
        assert all(env.observation_space(agent).contains(seen) for agent, seen in observations.items())
        actions = {agent: int(fields(seen, 6)["turn_in"] == 0) for agent, seen in observations.items()}
        observations, rewards, terminated, truncated, infos = env.step(actions)
    wanted = dtsa.simulate(policy="tdma", loss=0.1, seed=6, **SHORT).summary  # with loss each has a table of its own
    summary = infos["agent_6"]["summary"]
    assert {name: summary[name] for name in wanted if name not in OPEN} == {
        name: wanted[name] for name in wanted if name not in OPEN
    }
    assert set(rewards) == set(terminated) == set(truncated) == set(env.possible_agents)
    assert env.step({}) == ({}, {}, {}, {}, {})
    picture = env.render()
    assert isinstance(picture, np.ndarray)
    assert picture.shape == (480, 480, 3)
    assert picture.dtype == np.uint8
    assert (picture != empty).any()


def test_a_missing_action_is_named_and_the_last_slot_can_be_read() -> None:
    pytest.importorskip("pettingzoo")
    env = parallel_env(render_mode="ansi", **SHORT)
    env.reset()
    assert env.render() == "slot 0 begins"
    with pytest.raises(dtsa.ConfigError, match="agent_2"):
        env.step({"agent_1": 1})
    env.step(dict.fromkeys(env.agents, 0) | {"agent_3": 1})
    assert env.render() == "slot 0: success, sent by 3"
    with pytest.raises(dtsa.ConfigError, match="render_mode"):
        parallel_env(render_mode="window")


def test_without_pettingzoo_the_arrays_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pettingzoo", None)
    monkeypatch.delitem(sys.modules, "dtsa_bench.simulation.environment.parallel", raising=False)
    assert batch_env(flights=1, **SHORT).reset().shape == (1, 6, 64)
    with pytest.raises(dtsa.ConfigError, match=r"pettingzoo: .* an installed PettingZoo"):
        parallel_env(**SHORT)


def test_the_example_flies_tdma(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pettingzoo")
    runpy.run_path(str(Path(__file__).parents[4] / "examples" / "environment.py"))
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith("completed after ")
    by_actions, by_policy = second.partition(": ")[2].split(" slots, of policy tdma in `simulate`: ")
    assert by_actions == by_policy
