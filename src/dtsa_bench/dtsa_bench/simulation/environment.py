"""A flight whose agents send as somebody else says: an environment for learning (docs/how-to/learning.md).

An observation is made of an agent's table and of its own state alone: a policy that flies as a plug-in has the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dtsa_agent.core import ConfigError, Swarm, SwarmConfig, make_scenario
from dtsa_agent.core.kernel import lib
from dtsa_agent.core.plugins import PluginSwarm, Table
from dtsa_agent.core.registry import POLICIES, REASONS
from dtsa_agent.keys import with_key
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.runs.metrics import COMPLETED, CRASHED, FlightMetrics
from dtsa_channel_sim import OUTCOMES, Channel

from .simulate import complete_slot

try:
    from gymnasium.spaces import Box, Discrete
    from pettingzoo import ParallelEnv
except ModuleNotFoundError:  # what a plug-in needs is here without them
    ParallelEnv = object

POLICY = "actions"  # what the setting `policy` says in an environment
#: Numbers about the agent itself, by name: first position and count.
OWN = {"slot": (0, 1), "turn_in": (1, 1), "frame": (2, 1), "far": (3, 1), "goal": (4, 3), "velocity": (7, 3)}
#: Planes of N numbers, one an agent, by name: first plane and count.
PLANES = {"age": (0, 1), "silence": (1, 1), "moves": (2, 1), "position": (3, 3), "relative_velocity": (6, 3)}
_OWN_SIZE, _PLANE_COUNT = lib.SWARM_OBSERVED_OWN, lib.SWARM_OBSERVED_PLANES


def fields(observations: NDArray[np.float32], agents: int) -> dict[str, NDArray[np.float32]]:
    """Windows on the parts of observations, by name.

    :param observations: (..., F), any number of them.
    :param agents: number of agents N.
    :returns: ``slot``, ``turn_in``, ``frame``, ``far`` (...), ``goal``, ``velocity`` (..., 3), ``age``, ``silence``,
        ``moves`` (..., N), ``position``, ``relative_velocity`` (..., 3, N).
    """
    planes = observations[..., _OWN_SIZE:].reshape(*observations.shape[:-1], _PLANE_COUNT, agents)
    own = {name: observations[..., at] if n == 1 else observations[..., at : at + n] for name, (at, n) in OWN.items()}
    return own | {
        name: planes[..., at, :] if n == 1 else planes[..., at : at + n, :] for name, (at, n) in PLANES.items()
    }


class Observer:
    """Observations of one agent that flies as a plug-in, bit for bit those that the environment gives to that agent.

    It is made of what the plug-in's factory was given, and called with what its ``choose`` is given; returns (F,).
    """

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        del config, agent

    def __call__(self, table: Table, slot: int) -> NDArray[np.float32]:
        return table.observation(slot)


@dataclass(frozen=True, slots=True)
class SlotResults:
    """What the last slot of a flight of N agents brought; read only."""

    slot: int
    sent: NDArray[np.bool_]  # (N,) who sent
    outcome: str  # of OUTCOMES: idle, success, collision
    ages: NDArray[np.int64]  # (N, N) age from waking on, slots, of what [observer] knows of [agent]; -1: none counts
    crashed: bool  # two agents came too close
    completed: bool  # all had arrived, and the tail is over
    position: NDArray[np.float64]  # (3, N) m, frame map, true, at the slot's end


Reward = Callable[[SlotResults], ArrayLike]


class MeanAge:
    """The default: minus the mean age from waking on, over pairs, in slots; a crash costs a penalty on top.

    In slots in which nobody flies it is 0. `waking_age_mean_slots` is the mean of the same ages over all pairs of all
    slots.

    :param crash: penalty. It has to exceed what the rest of a flight may cost: a crash ends the flight.
    """

    def __init__(self, crash: float = 10_000.0) -> None:
        self.crash = crash

    def __call__(self, results: SlotResults) -> float:
        """The same for all agents."""
        counted = results.ages[results.ages >= 0]
        return -float(counted.mean() if len(counted) else 0.0) - self.crash * results.crashed


class Actions:
    """The policy of agents in an environment: the kernel counts for them what it counts for a plug-in."""

    may_join = True

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        del config, agent

    def choose(self, table: Table, slot: int) -> int:
        """Never called in an environment: its actions say which agents send."""
        raise ConfigError("policy", POLICY, "another one: this one flies in dtsa.env only")


class SwarmEnv(ParallelEnv):  # type: ignore[misc]
    """A swarm whose agents say in each slot whether they send: 1, or 0. All of them are there until the flight is over.

    :param run: what is flown; its policy does not count, its seed is that of the first flight.
    :param reward: what a slot was worth: (N,), or one number for all agents, of :class:`SlotResults`.
    :param slots: a flight that is not over after so many slots is truncated; None: at its ``timeout_s``.
    :param render_mode: ``ansi``: `render` gives a line on the last slot; ``human``: it prints that line.
    :raises ConfigError: for a value that is not usable, or if PettingZoo is not installed.
    """

    metadata: ClassVar = {"name": "dtsa_v0", "render_modes": ["ansi", "human"], "is_parallelizable": True}

    def __init__(
        self, run: RunConfig, *, reward: Reward | None = None, slots: int | None = None, render_mode: str | None = None
    ) -> None:
        if ParallelEnv is object:
            raise ConfigError("pettingzoo", None, "an installed PettingZoo (pip install pettingzoo)")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigError("render_mode", render_mode, "None, ansi, human")
        if slots is not None and (isinstance(slots, bool) or not isinstance(slots, int) or slots < 1):
            raise ConfigError("slots", slots, "a whole number from 1 on")
        if POLICY not in POLICIES.registered:
            POLICIES.register(POLICY, Actions)
        self.run, self.render_mode = replace(run, swarm=replace(run.swarm, policy=POLICY)), render_mode
        self._reward: Reward = MeanAge() if reward is None else reward
        self._limit, self._next_seed, count = slots, run.swarm.seed, run.swarm.agents
        self.possible_agents = [f"agent_{agent}" for agent in range(1, count + 1)]
        self.agents: list[str] = []
        low, high = (np.full(_OWN_SIZE + _PLANE_COUNT * count, limit, np.float32) for limit in (-np.inf, np.inf))
        for name, least, most in (
            ("slot", 0, np.inf), ("turn_in", 0, count - 1), ("frame", 0, 1), ("far", 0, 1), ("age", -1, np.inf),
            ("silence", 0, np.inf), ("moves", 0, 1),
        ):  # fmt: skip
            fields(low, count)[name][...], fields(high, count)[name][...] = least, most
        self.observation_spaces = {name: Box(low, high, dtype=np.float32) for name in self.possible_agents}
        self.action_spaces = {name: Discrete(2) for name in self.possible_agents}

    def observation_space(self, agent: str) -> Any:
        """What an agent has heard, as numbers."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        """1: it sends, 0: it is silent."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Begin a flight; returns observations and (empty) infos by agent.

        :param seed: its seed, as in `simulate`; None: the one after that of the last flight.
        """
        seed = self._next_seed if seed is None else seed
        swarm_config = replace(self.run.swarm, seed=seed)
        air_seed = (seed + self.run.air.seed - self.run.swarm.seed) % 2**63  # as far apart as in the run given
        self.run = run = replace(self.run, swarm=swarm_config, channel=replace(self.run.air, seed=air_seed))
        self._next_seed = seed + 1
        #: What no agent knows, to look at: the scenario, the swarm, the metrics of the flight under way.
        self.scenario = make_scenario(run.swarm)
        has_plug_ins = any(kind != "policy" for kind, _ in run.swarm.plug_ins)
        swarm = (PluginSwarm if has_plug_ins else Swarm)(run.swarm, self.scenario)
        swarm.reason[:] = REASONS.index("plugin")
        self.swarm, self.metrics = with_key(swarm), FlightMetrics(run, self.scenario)
        self.slot = 0  # the one that begins
        self.senders: tuple[int, ...] = ()  # ids, of the last slot
        self.outcome = 0  # of the last slot, index into OUTCOMES
        self._channel, self._length = Channel(run.air), run.swarm.frame_length
        self.scenario.advance(0, self.swarm)
        self.agents = self.possible_agents[:]
        return self._observations(), {agent: {} for agent in self.agents}

    def step(self, actions: Mapping[str, Any]) -> tuple[dict[str, Any], ...]:
        """Flies one slot.

        :param actions: 1 or 0 by agent; one of those that send must be there for each.
        :returns: observations, rewards, terminations (crashed or complete), truncations (not over within the limit) and
            infos by agent; with the last slot each info has the flight's ``summary``.
        :raises ConfigError: for an action that is missing or another one, or a reward of another shape.
        """
        names, slot, swarm = self.agents, self.slot, self.swarm
        if not names:
            return {}, {}, {}, {}, {}
        for agent in names:
            if agent not in actions or actions[agent] not in (0, 1):
                raise ConfigError(f"actions of {agent}", actions.get(agent), "0 or 1")
        sent = np.fromiter((actions[agent] for agent in names), np.bool_, len(names)) & (swarm.present > 0)
        swarm.sends[...] = sent
        swarm.chosen[...] = np.where(sent, swarm.ids, 0)  # a silent agent says nothing of whom it takes for the sender
        senders, woken = swarm.emit(slot), self.metrics.woken.copy()
        self.metrics.compare_tables(slot, swarm.table_hash, swarm.chosen)
        verdict, over = complete_slot(swarm, self._channel, self.metrics, slot, senders, self._length)
        self.slot, self.senders, self.outcome = slot + 1, verdict.senders, verdict.outcome
        known = np.maximum(swarm.sent_slot, woken - 1)  # of nobody since it has woken: the slot before
        ages = np.where(self.scenario.moving & (woken >= 0), slot - known, -1)
        np.fill_diagonal(ages, -1)
        results = SlotResults(
            slot, sent, OUTCOMES[verdict.outcome], ages,
            self.metrics.crash_slot == self.slot, over == COMPLETED, swarm.position,
        )  # fmt: skip
        worth = np.asarray(self._reward(results), dtype=np.float64)
        if worth.shape not in ((), (len(names),)):
            raise ConfigError("reward", f"an array of shape {worth.shape}", f"a number, or {len(names)} of them")
        rewards = dict(zip(names, np.broadcast_to(worth, len(names)).tolist(), strict=True))
        terminated = over in (CRASHED, COMPLETED)
        truncated = not terminated and (bool(over) or self.slot == self._limit)
        info: dict[str, Any] = {}
        if terminated or truncated:
            # Actions do not say which agent is expected to send: there is no agreement about it.
            own = {"malformed": swarm.malformed, "foreign": swarm.foreign, "agreement_share": None}
            info, self.agents = {"summary": self.metrics.summary(None) | own}, []
        if not over:
            self.scenario.advance(slot + 1, swarm)
        flags = dict.fromkeys(names, terminated), dict.fromkeys(names, truncated)
        return self._observations(), rewards, *flags, {agent: dict(info) for agent in names}

    def _observations(self) -> dict[str, NDArray[np.float32]]:
        return dict(zip(self.possible_agents, self.swarm.observations(self.slot), strict=True))

    def render(self) -> str | None:
        """A line on the last slot, which mode ``human`` prints."""
        senders = ", ".join(map(str, self.senders)) or "no agent"
        line = f"slot {self.slot - 1}: {OUTCOMES[self.outcome]}, sent by {senders}" if self.slot else "slot 0 begins"
        if self.render_mode == "human":
            print(line)
        return line if self.render_mode == "ansi" else None

    def close(self) -> None:
        """There is nothing to close."""
