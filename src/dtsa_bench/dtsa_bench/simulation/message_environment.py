"""Environments of others whose agents know of each other what a channel carries (docs/how-to/environments.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Setting
from dtsa_channel_sim.relay.transport import RadioMessage, Transport, read_settings

try:
    from gymnasium.spaces import Box, Dict
    from pettingzoo.utils import BaseParallelWrapper
except ModuleNotFoundError:
    BaseParallelWrapper = object

MessageMap = Mapping[str, Mapping[str, Any]] | Callable[[str, str], Any]
_STEP_MS = Setting("step_ms", "float", None, "time that a step takes", unit="ms", minimum=0.001, maximum=1e6)
_SIZE = Setting("size", "int", None, "bytes of a message", minimum=1)


class MessageEnv(BaseParallelWrapper):  # type: ignore[misc]
    """Any `ParallelEnv` of PettingZoo, whose agents know of each other only what a radio channel carries.

    Either parts of observations belong to other agents (`messages`), or agents choose what they send (`space`). Every
    agent sends one message to all others when a step begins; what has come when it ends is in the observation. For the
    rest a receiver sees the last value received, at first 0. `infos[agent]["age"]` has how many steps ago each other
    agent sent what is known of it, -1: nothing has come::

        def of_others(agent, other):  # simple_spread of three agents: places of the others are numbers 10 to 13
            others = [name for name in ("agent_0", "agent_1", "agent_2") if name != agent]
            first = 10 + 2 * others.index(other)
            return slice(first, first + 2)

        env = dtsa.env.channel(simple_spread_v3.parallel_env(), of_others, loss=0.2, access="tdma", slot_ms=10)

    :param env: the environment; its agents in the order of `possible_agents` have the ids 1 to N.
    :param messages: which numbers of an agent's observation, a `Box` of shape (F,), belong to which other agent: a
        slice or indices as `messages[agent][other]`, or a function of both names; None: no numbers.
    :param space: a `Box`: what agents send. Actions are then `{"action": ..., "message": ...}`, observations
        `{"observation": ..., "messages": {other: ...}}`.
    :param step_ms: time that a step takes on the air, ms.
    :param size: bytes of each message on the air.
    :param positions: a function of `env`: where the agents are, (N, 2) or (N, 3), m, for `range_m`, `capture_db` and
        access `error`.
    :param settings: `access`, `slot_ms`, `queue`, `delay_ms`, `backoff_ms`, and those of the channel, as for the relay.
    :raises ConfigError: for a value that is not usable, or if PettingZoo is not installed.
    """

    def __init__(
        self, env: Any, messages: MessageMap | None = None, *, space: Any = None, step_ms: float = 100.0,
        size: int = 24, positions: Callable[[Any], ArrayLike] | None = None, **settings: Any,
    ) -> None:  # fmt: skip
        if BaseParallelWrapper is object:
            raise ConfigError("pettingzoo", None, "an installed PettingZoo (pip install pettingzoo)")
        super().__init__(env)
        if (messages is None) == (space is None) or not (space is None or isinstance(space, Box)):
            raise ConfigError("messages, space", (messages, space), "either messages, or a Box as space")
        self._names: list[str] = list(env.possible_agents)
        self._access, self._config = read_settings(settings, len(self._names))
        self._step_ns, self._size = round(_STEP_MS.check(step_ms) * 1e6), _SIZE.check(size)
        self._space, self._positions, self._next_seed = space, positions, self._config.seed
        if positions is None and (self._config.needs_positions or self._access.access == "error"):
            raise ConfigError("positions", None, "a function that says where agents are, as the channel needs it")
        if fault := Transport(self._access, self._config).fault_of(size):
            raise ConfigError("size", size, f"what can be sent: {fault}")
        self._spaces = {name: (env.observation_space(name), env.action_space(name)) for name in self._names}
        for name, (seen, act) in self._spaces.items() if space is not None else ():
            others = Dict({other: space for other in self._names if other != name})
            spaces = Dict({"observation": seen, "messages": others}), Dict({"action": act, "message": space})
            self._spaces[name] = spaces
        self._owners = {name: self._owners_in(name, messages) for name in self._names if space is None}

    def _owners_in(self, name: str, messages: Any) -> NDArray[np.intp]:
        """Return the row of the agent that owns each number of an observation, N: the agent itself, (F,)."""
        box = self.env.observation_space(name)
        if not isinstance(box, Box) or len(box.shape) != 1:
            raise ConfigError(f"observation_space({name!r})", box, "a Box of one dimension, or messages with a space")
        owners = np.full(box.shape, len(self._names), np.intp)
        for row, other in enumerate(self._names):
            if other == name:
                continue
            part = messages(name, other) if callable(messages) else messages.get(name, {}).get(other)
            if part is not None:
                try:
                    owners[part] = row
                except (IndexError, TypeError):
                    allowed = f"a slice or a list of indices below {box.shape[0]}"
                    raise ConfigError(f"messages[{name!r}][{other!r}]", part, allowed) from None
        return owners

    def observation_space(self, agent: str) -> Any:
        """That of the environment; with a space: a ``Dict`` of its ``observation`` and ``messages`` by agent."""
        return self._spaces[agent][0]

    def action_space(self, agent: str) -> Any:
        """That of the environment; with a space: a ``Dict`` of its ``action`` and the ``message`` to send."""
        return self._spaces[agent][1]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Begin an episode; without a seed, the losses take the one after that of the last episode."""
        self._config = replace(self._config, seed=self._next_seed if seed is None else seed)
        self._next_seed = self._config.seed + 1
        self._channel, self._step = Transport(self._access, self._config), 0
        self._newest = np.full((len(self._names), len(self._names)), -1)  # step of what [receiver] has of [sender]
        # Nothing has been received: 0, or the nearest that the space allows.
        boxes = {name: self._space or self.env.observation_space(name) for name in self._names}
        empty = {name: np.clip(np.zeros(box.shape, box.dtype), box.low, box.high) for name, box in boxes.items()}
        self._known: dict[str, Any] = {
            name: empty[name]
            if self._space is None
            else {other: empty[other] for other in self._names if other != name}
            for name in self._names
        }
        return self._exchange(*self.env.reset(seed=seed, options=options), {})

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        """Take a step: observations, rewards, terminations, truncations and infos by agent."""
        sent: dict[str, Any] = {}
        if self._space is not None:
            sent = {name: np.array(action["message"]) for name, action in actions.items()}
            actions = {name: action["action"] for name, action in actions.items()}
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        observations, infos = self._exchange(observations, infos, sent)
        return observations, rewards, terminations, truncations, infos

    def _exchange(
        self, observations: dict[str, Any], infos: dict[str, Any], sent: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Send what is new, let a step pass, and return observations and infos with what has arrived."""
        step, now_ns = self._step, self._step * self._step_ns
        self._step += 1
        present = np.array([name in observations for name in self._names])
        for row, name in enumerate(self._names):
            if name in (observations if self._space is None else sent):
                receivers = present & (np.arange(len(present)) != row)
                payload = observations if self._space is None else sent[name]
                self._channel.send(RadioMessage(row + 1, "", step, self._size, now_ns, receivers, payload))
        for message, received in self._channel.advance(now_ns + self._step_ns, self._places()):
            self._accept(message, received)
        shown: dict[str, Any] = {}  # another dictionary: what is on the air stays as it is
        ages = np.where(self._newest < 0, -1, step - self._newest).tolist()
        for row, name in enumerate(self._names):
            if name in observations and self._space is None:
                fresh = np.append(self._newest[row] == step, True)[self._owners[name]]
                self._known[name] = shown[name] = np.where(fresh, observations[name], self._known[name])
            elif name in observations:
                shown[name] = {"observation": observations[name], "messages": dict(self._known[name])}
            if name in infos:
                age = dict(zip(self._names, ages[row], strict=True))
                del age[name]
                infos[name] = {**infos[name], "age": age}
        return shown, infos

    def _places(self) -> NDArray[np.float64] | None:
        """Return where agents are, (3, N), m."""
        if self._positions is None:
            return None
        given = np.asarray(self._positions(self.env), np.float64)
        if given.shape not in ((len(self._names), 2), (len(self._names), 3)):
            raise ConfigError("positions", f"shape {given.shape}", f"({len(self._names)}, 2) or (.., 3), m")
        return np.pad(given.T, ((0, 3 - given.shape[1]), (0, 0)))

    def _accept(self, message: RadioMessage, received: NDArray[np.bool_]) -> None:
        """Let the receivers of a message know what is in it, unless they have a newer one."""
        column = message.sender - 1
        news = received & (self._newest[:, column] < message.number)
        self._newest[news, column] = message.number
        for row in np.flatnonzero(news).tolist():
            name = self._names[row]
            if self._space is not None:
                self._known[name][self._names[column]] = message.payload
            elif message.number < self._step - 1 and name in message.payload:  # newer ones are in the observations
                owned = self._owners[name] == column
                self._known[name] = np.where(owned, message.payload[name], self._known[name])
