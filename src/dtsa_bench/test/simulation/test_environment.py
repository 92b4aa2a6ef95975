"""Integration: the environment for learning flies what `simulate` flies, to the digit, and obeys PettingZoo's rules."""

from __future__ import annotations

import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import dtsa
from dtsa.env import Observer, SlotResults, SwarmEnv, fields, parallel_env
from dtsa_bench.runs.config import RunConfig, RunLimits
from dtsa_bench.simulation import environment
from dtsa_bench.simulation.simulate import simulate
from dtsa_channel_sim import ChannelConfig

pytest.importorskip("pettingzoo")

# What agents that say no more than "I send" or "I do not" leave open: whom they take for the sender.
OPEN = {"policy", "agreement_share", "equal_tables_share", "first_divergence_slot", "wall_time_s", "realtime_factor"}
SHORT: dict[str, Any] = {"agents": 6, "timeout_s": 1.5}
Rule = Callable[[NDArray[np.float32], int], NDArray[np.bool_]]


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


def flown(env: SwarmEnv, rule: Rule, seed: int | None = None, slots: int = 10**6) -> list[Any]:
    """What each slot of a flight gave, until it is over; observations in front, as an array."""
    steps = []
    observations, _ = env.reset(seed=seed)
    while env.agents and len(steps) < slots:
        seen = np.stack(list(observations.values()))
        sends = rule(seen, len(env.agents)).astype(int).tolist()
        observations, *more = env.step(dict(zip(env.agents, sends, strict=True)))
        steps.append((seen, env.senders, env.outcome, env.swarm.track.copy(), *more))
    return steps


def assert_same(summary: dict[str, Any], wanted: dict[str, Any], left_out: set[str] = OPEN) -> None:
    assert {k: v for k, v in summary.items() if k not in left_out} == {
        k: v for k, v in wanted.items() if k not in left_out
    }


@pytest.mark.parametrize(("policy", "rule", "settings"), [
    ("tdma", tdma, {"loss": 0.2, "seed": 3}),
    ("tdma", tdma, {"estimator": "intent", "scenario": "waypoints", "seed": 4, "slot_ms": 20.0}),
    ("tdma", tdma, {"estimator": "ahead", "seed": 6, "moving": 4}),
    ("age", oldest, {"return_every": 0, "moving": 4, "seed": 5}),
    ("tdma", tdma, {"agents": 12, "slot_ms": 100.0, "seed": 1, "collision_m": 1.0, "timeout_s": 9.0}),
])  # fmt: skip
def test_a_scripted_policy_flies_what_simulate_flies(policy: str, rule: Rule, settings: dict[str, Any]) -> None:
    class Ahead:
        def __init__(self, config: dtsa.SwarmConfig, agent: int) -> None:
            pass

        def estimate(self, table: dtsa.Table, slot: int, step: int, position: Any, velocity: Any) -> None:
            position[...] = table.sent_position + 0.1 * table.sent_velocity
            velocity[...] = table.sent_velocity

    dtsa.register("estimator", "ahead", Ahead)
    settings = SHORT | settings
    expected = simulate(dtsa.run_config(policy=policy, **settings), log=True, shared_table=False)
    steps = flown(parallel_env(**settings), rule)
    log = expected.log
    assert [step[1] for step in steps] == log.senders()
    assert [step[2] for step in steps] == log.outcome.tolist()
    np.testing.assert_array_equal(np.stack([step[3] for step in steps]), log.position)
    _, terminated, truncated, infos = steps[-1][4:]
    wanted = expected.summary()
    assert_same(infos["agent_1"]["summary"], wanted)
    assert infos["agent_1"]["summary"]["agreement_share"] is None
    assert set(terminated.values()) == {wanted["end"] != "timed out"}
    assert set(truncated.values()) == {wanted["end"] == "timed out"}


def test_a_run_has_the_seed_of_its_channel() -> None:
    channel = ChannelConfig(agents=6, loss=0.2, seed=0)
    run = RunConfig(dtsa.SwarmConfig(agents=6, policy="tdma", seed=5), channel, RunLimits(timeout_s=1.5))
    assert_same(flown(parallel_env(run), tdma)[-1][-1]["agent_1"]["summary"], simulate(run).summary())


def test_a_plug_in_that_observes_is_what_flew_in_the_environment() -> None:
    made: list[Impatient] = []
    dtsa.register("policy", "impatient", lambda config, agent: made.append(Impatient(config, agent)) or made[-1])
    settings = SHORT | {"loss": 0.1, "moving": 4, "seed": 8}
    flight = dtsa.simulate(policy="impatient", **settings)
    steps = flown(parallel_env(**settings), impatient)
    assert flight.summary["slots"]["collision"] > 0
    summary = steps[-1][-1]["agent_2"]["summary"]
    assert_same(summary, flight.summary, {"policy", "agreement_share", "wall_time_s", "realtime_factor"})
    for agent, plug_in in enumerate(made):
        np.testing.assert_array_equal(np.stack(plug_in.seen), np.stack([step[0][agent] for step in steps]))


def test_observations_say_what_a_table_holds() -> None:
    env = parallel_env(loss=0.3, seed=2, **SHORT)
    seen = fields(flown(env, tdma, slots=41)[-1][0], 6)
    env = parallel_env(loss=0.3, seed=2, **SHORT)
    flown(env, tdma, slots=40)
    swarm = env.swarm
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

    def noting(results: SlotResults) -> float:
        counted = results.ages >= 0
        pairs.append((int(results.ages[counted].sum()), int(counted.sum())))
        return 7.0

    steps = flown(parallel_env(reward=noting, loss=0.2, moving=4, scenario="waypoints", **SHORT), tdma)
    total, number = (sum(column) for column in zip(*pairs, strict=True))
    *_, rewards, _, _, infos = steps[-1]
    assert list(rewards.values()) == [7.0] * 6
    assert infos["agent_3"]["summary"]["waking_age_mean_slots"] == total / number


def test_a_crash_ends_a_flight_and_flights_follow_each_other_by_their_seeds() -> None:
    env = parallel_env(reward=dtsa.env.MeanAge(crash=500.0), collision_m=5.0, **SHORT)
    *_, rewards, terminated, _, infos = flown(env, tdma)[-1]
    assert infos["agent_1"]["summary"]["collided"]
    assert set(terminated.values()) == {True}
    assert all(-520.0 < worth < -499.0 for worth in rewards.values())
    env = parallel_env(slots=30, **SHORT)
    first = flown(env, tdma, seed=11)
    assert set(first[-1][-2].values()) == {True}
    assert first[-1][-1]["agent_1"]["summary"]["slots"]["total"] == 30
    env.reset()  # goes on with the number after that
    assert env.run.swarm.seed == env.run.air.seed == 12
    again = flown(env, tdma, seed=11)
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one[0], other[0])


def test_what_cannot_be_used_or_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for settings, fault in (
        ({"policy": "tdma"}, "policy"), ({"slots": True}, "slots"), ({"loss": 2}, "loss"),
        ({"render_mode": "window"}, "render_mode"),
    ):  # fmt: skip
        with pytest.raises(dtsa.ConfigError, match=fault):
            parallel_env(**settings)
    env = parallel_env(**SHORT)
    for seed in (-1, 1.5, 2**63, "7"):
        with pytest.raises(dtsa.ConfigError, match="seed"):
            env.reset(seed)  # type: ignore[arg-type]
    env.reset()
    for actions in ({"agent_1": 1}, dict.fromkeys(env.agents, 2)):
        with pytest.raises(dtsa.ConfigError, match="actions of agent_"):
            env.step(actions)
    with pytest.raises(dtsa.ConfigError, match="actions"):
        dtsa.simulate(policy="actions", **SHORT)
    env = parallel_env(reward=lambda results: results.ages, **SHORT)
    env.reset()
    with pytest.raises(dtsa.ConfigError, match="reward"):
        env.step(dict.fromkeys(env.agents, 0))
    monkeypatch.setattr(environment, "ParallelEnv", object)
    with pytest.raises(dtsa.ConfigError, match=r"pettingzoo: .* an installed PettingZoo"):
        parallel_env(**SHORT)


def test_pettingzoo_finds_nothing_wrong_and_the_last_slot_can_be_read() -> None:
    from pettingzoo.test import parallel_api_test, parallel_seed_test
    from pettingzoo.test.render_test import render_test
    from pettingzoo.utils.conversions import parallel_to_aec

    parallel_api_test(parallel_env(slots=40, **SHORT), num_cycles=100)
    parallel_seed_test(lambda: parallel_env(slots=40, **SHORT), num_cycles=60)
    render_test(lambda render_mode: parallel_to_aec(parallel_env(agents=2, slots=3, render_mode=render_mode)))
    env = parallel_env(render_mode="ansi", **SHORT)
    observations, _ = env.reset()
    assert env.render() == "slot 0 begins"
    assert all(env.observation_space(agent).contains(seen) for agent, seen in observations.items())
    observations, *_ = env.step(dict.fromkeys(env.agents, 0) | {"agent_3": 1})
    assert all(env.observation_space(agent).contains(seen) for agent, seen in observations.items())
    assert env.render() == "slot 0: success, sent by 3"


def test_the_examples_fly_tdma_and_as_they_were_trained(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(Path(__file__).parents[4] / "examples" / "environment.py"))
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith("completed after ")
    by_actions, by_policy = second.partition(": ")[2].split(" slots, of policy tdma in `simulate`: ")
    assert by_actions == by_policy
    learned = runpy.run_path(str(Path(__file__).parents[4] / "examples" / "learned.py"))
    first, second = (learned["train"](3, 1, population=4, flights=1) for _ in range(2))
    assert first.tolist() == second.tolist()
    record: list[tuple[int, ...]] = []
    swarm = learned["SWARMS"][2]
    learned["cost"](first, swarm, 7, record)
    dtsa.register("policy", "learned", lambda config, agent: learned["Learned"](config, agent, first))
    run = dtsa.run_config(policy="learned", seed=7, **learned["COMMON"], **swarm)
    senders = simulate(run, log=True).log.senders()
    assert len(record) > 100
    assert record == senders[: len(record)]
