"""Agents of any environment know of each other what the channel has carried."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("pettingzoo")
pytest.importorskip("mpe2")

from gymnasium.spaces import Box, Discrete
from mpe2 import simple_spread_v3
from pettingzoo import ParallelEnv
from pettingzoo.test import parallel_api_test, parallel_seed_test

import dtsa.env
from dtsa_agent.core.errors import ConfigError

NAMES = ["agent_0", "agent_1", "agent_2"]


def of_others(agent: str, other: str) -> slice:
    """Positions of the others in observations of simple_spread with three agents."""
    first = 10 + 2 * [name for name in NAMES if name != agent].index(other)
    return slice(first, first + 2)


class Counting(ParallelEnv):  # type: ignore[type-arg]
    """Three agents; all see the number of the step, once for each agent."""

    metadata = {"name": "counting"}  # noqa: RUF012

    def __init__(self) -> None:
        self.possible_agents = list(NAMES)
        self.agents: list[str] = []
        self.step_number = 0

    def observation_space(self, agent: str) -> Any:
        return Box(0, 1000, (3,), np.float32)

    def action_space(self, agent: str) -> Any:
        return Discrete(2)

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.agents, self.step_number = list(NAMES), 0
        return self._seen(), {name: {} for name in NAMES}

    def step(self, actions: Any) -> Any:
        self.step_number += 1
        flags = dict.fromkeys(NAMES, False)
        self.actions = actions
        return self._seen(), dict.fromkeys(NAMES, 0.0), flags, flags, {name: {"step": 1} for name in NAMES}

    def _seen(self) -> dict[str, Any]:
        return {name: np.full(3, self.step_number, np.float32) for name in self.agents}


def owned(agent: str, other: str) -> list[int]:
    return [NAMES.index(other)]


@pytest.mark.parametrize("access", ["unlimited", "tdma", "lease", "csma", None])
def test_an_environment_of_others_passes_the_tests_of_pettingzoo(access: str | None) -> None:
    """With parts of observations, or None: with messages that agents choose."""

    def make() -> Any:
        env = simple_spread_v3.parallel_env(max_cycles=30)
        if access is None:
            return dtsa.env.channel(env, space=Box(-1, 1, (2,), np.float32), loss=0.2)
        return dtsa.env.channel(env, of_others, loss=0.2, access=access)

    parallel_api_test(make(), num_cycles=60)
    parallel_seed_test(make, num_cycles=20)


@pytest.mark.parametrize("access", ["unlimited", "lease"])
def test_receivers_see_the_last_value_that_has_come(access: str) -> None:
    env = dtsa.env.channel(Counting(), owned, loss=0.4, access=access)
    observations, infos = env.reset(seed=3)
    seen = set()
    for step in range(100):
        for row, name in enumerate(NAMES):
            ages = infos[name]["age"]
            assert list(ages) == [other for other in NAMES if other != name]
            assert observations[name][row] == step
            for other, age in ages.items():
                assert observations[name][NAMES.index(other)] == (step - age if age >= 0 else 0)
            seen.update(ages.values())
        observations, *_, infos = env.step({})
    assert {0, 1, 2} <= seen
    assert infos["agent_0"]["step"] == 1


def test_what_comes_late_is_seen_late_and_a_map_of_indices_does_too() -> None:
    indices = {name: {other: owned(name, other) for other in NAMES if other != name} for name in NAMES[:1]}
    env = dtsa.env.channel(Counting(), indices, delay_ms=250, step_ms=100)
    env.reset(seed=1)
    for _ in range(7):
        observations, *_, infos = env.step({})
    assert infos["agent_0"]["age"] == {"agent_1": 2, "agent_2": 2}
    assert observations["agent_0"].tolist() == [7, 5, 5]
    assert observations["agent_1"].tolist() == [7, 7, 7]


def test_a_slot_that_begins_with_a_step_carries_what_is_sent_in_it() -> None:
    """A step has a slot for each agent: all are heard in the step in which they send, the first one too."""
    env = dtsa.env.channel(Counting(), owned, access="tdma", slot_ms=10, step_ms=30)
    env.reset(seed=1)
    for _ in range(5):
        *_, infos = env.step({})
        assert {age for name in NAMES for age in infos[name]["age"].values()} == {0}


def test_agents_choose_what_they_send() -> None:
    plain = Counting()
    env = dtsa.env.channel(plain, space=Box(0, 1000, (1,), np.float32), loss=0.3)
    observations, infos = env.reset(seed=2)
    assert infos["agent_0"]["age"] == {"agent_1": -1, "agent_2": -1}
    for step in range(1, 60):
        value = np.array([step], np.float32)
        observations, *_, infos = env.step({name: {"action": 1, "message": value} for name in NAMES})
        value[0] = -1  # what was sent is what it was when it was sent
        for name in NAMES:
            assert env.observation_space(name).contains(observations[name])
            for other, age in infos[name]["age"].items():
                assert observations[name]["messages"][other] == (step - age if age >= 0 else 0)
    assert plain.actions == dict.fromkeys(NAMES, 1)


def test_losses_go_by_the_seed_and_distance_counts() -> None:
    def ages(seed: int | None, env: Any) -> list[Any]:
        _, infos = env.reset(seed=seed)
        return [infos, *(env.step({})[4] for _ in range(30))]

    env = dtsa.env.channel(Counting(), owned, loss=0.3, seed=5)
    assert ages(5, env) == ages(None, dtsa.env.channel(Counting(), owned, loss=0.3, seed=5)) != ages(None, env)
    far = dtsa.env.channel(Counting(), owned, range_m=5, positions=lambda env: [[0, 0], [3, 0], [9, 0]])
    assert ages(1, far)[-1]["agent_0"]["age"] == {"agent_1": 0, "agent_2": -1}


@pytest.mark.parametrize(
    ("settings", "field"),
    [({"loss": 2}, "loss"), ({"step_ms": 0}, "step_ms"), ({"size": 0}, "size"), ({"range_m": 5}, "positions"),
     ({"size": 100, "access": "tdma", "slot_ms": 0.3}, "size"), ({"messages": None}, "messages, space"),
     ({"messages": lambda a, b: [99]}, "messages['agent_0']['agent_1']"),
     ({"space": 3, "messages": None}, "messages, space"), ({"messages": 3}, "messages, space"),
     ({"messages": lambda a, b: [[1], [1, 2]]}, "messages['agent_0']['agent_1']")],
)  # fmt: skip
def test_bad_settings_are_named(settings: dict[str, Any], field: str) -> None:
    with pytest.raises(ConfigError) as caught:
        dtsa.env.channel(Counting(), **{"messages": owned, **settings})
    assert caught.value.field == field
