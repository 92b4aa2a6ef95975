"""One flight as a `ParallelEnv` of PettingZoo."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from dtsa_agent.core import ConfigError
from dtsa_bench.runs.config import RunConfig
from dtsa_channel_sim import OUTCOMES

from .batch import BatchEnv
from .flight import ActedFlight
from .observation import bounds
from .reward import Reward

Observations = dict[str, NDArray[np.float32]]
RENDER_MODES = ("rgb_array", "ansi", "human")


class SwarmEnv(ParallelEnv):  # type: ignore[misc]
    """A swarm whose agents say in each slot whether they send: 1, or 0. All of them are there until the flight is over.

    :param run: what is flown; its policy does not count, its seed is that of the first flight.
    :param reward: what a slot was worth; None: minus the mean age from waking on, and a penalty for a crash.
    :param slots: a flight that is not over after so many slots is truncated; None: at its ``timeout_s``.
    :param render_mode: ``rgb_array``: the flight so far, seen from above; ``ansi``: a line on the last slot;
        ``human``: `render` prints that line.
    :raises ConfigError: for a value that is not usable.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "dtsa_v0", "render_modes": list(RENDER_MODES), "is_parallelizable": True, "render_fps": 10,
    }  # fmt: skip

    def __init__(
        self,
        run: RunConfig,
        *,
        reward: Reward | None = None,
        slots: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, *RENDER_MODES):
            raise ConfigError("render_mode", render_mode, f"None, {', '.join(RENDER_MODES)}")
        self.render_mode = render_mode
        self._batch = BatchEnv(run, 1, reward=reward, slots=slots, autoreset=False)
        self.possible_agents = [f"agent_{agent}" for agent in range(1, self._batch.agents + 1)]
        self.agents: list[str] = []
        low, high = bounds(self._batch.agents)
        self.observation_spaces = {name: Box(low, high, dtype=np.float32) for name in self.possible_agents}
        self.action_spaces = {name: Discrete(2) for name in self.possible_agents}
        self._track: list[NDArray[np.float64]] = []

    @property
    def flight(self) -> ActedFlight:
        """The flight under way, to look at: its scenario, its swarm, its metrics."""
        return self._batch.flight(0)

    def observation_space(self, agent: str) -> Box:
        """What an agent has heard, as numbers.

        :param agent: its name.
        """
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Discrete:
        """1: it sends, 0: it is silent.

        :param agent: its name.
        """
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observations, dict[str, dict[str, Any]]]:
        """Begins a flight.

        :param seed: its seed, as in `simulate`; None: the one after that of the last flight.
        :param options: there are none.
        :returns: observations and (empty) infos by agent.
        """
        observations = self._batch.reset(seed)
        self.agents = self.possible_agents[:]
        self._track = [self.flight.scenario.start[None].copy()]
        return self._by_agent(observations), {agent: {} for agent in self.agents}

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[Observations, dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Flies one slot.

        :param actions: 1 or 0 by agent; one of those that send must be there for each.
        :returns: observations, rewards, terminations (crashed or complete), truncations (not over within the limit) and
            infos by agent; with the last slot each info has the flight's ``summary``.
        :raises ConfigError: for an action that is missing or another one.
        """
        names = self.agents
        if not names:
            return {}, {}, {}, {}, {}
        try:
            said = np.array([[actions[agent] for agent in names]])
        except KeyError as error:
            raise ConfigError("actions", f"none for {error.args[0]}", "one for each agent") from None
        observations, rewards, terminated, truncated = self._batch.step(said)
        if self.render_mode == "rgb_array":
            self._track.append(self.flight.swarm.track.copy())
        crashed_or_complete, late = bool(terminated[0]), bool(truncated[0])
        infos: dict[str, dict[str, Any]] = {agent: {} for agent in names}
        if crashed_or_complete or late:
            infos = {agent: {"summary": self._batch.ended[0].summary} for agent in names}
            self.agents = []
        return (
            self._by_agent(observations),
            dict(zip(names, rewards[0].tolist(), strict=True)),
            dict.fromkeys(names, crashed_or_complete),
            dict.fromkeys(names, late),
            infos,
        )

    def render(self) -> NDArray[np.uint8] | str | None:
        """The flight so far: (H, W, 3) from above, or a line on the last slot, as ``render_mode`` says; else None."""
        if self.render_mode == "rgb_array":
            from .picture import from_above  # Matplotlib takes longer to load than all the rest

            pair = self.flight.metrics.collided_pair
            return from_above(self.flight.scenario, np.concatenate(self._track), pair)
        if self.render_mode == "ansi":
            return self._line()
        if self.render_mode == "human":
            print(self._line())
        return None

    def _line(self) -> str:
        flight = self.flight
        if not flight.slot:
            return "slot 0 begins"
        senders = ", ".join(map(str, flight.senders)) or "nobody"
        return f"slot {flight.slot - 1}: {OUTCOMES[flight.outcome]}, sent by {senders}"

    def close(self) -> None:
        """There is nothing to close."""

    def _by_agent(self, observations: NDArray[np.float32]) -> Observations:
        return dict(zip(self.possible_agents, observations[0].copy(), strict=True))
