"""Environments of others whose agents know of each other what a channel carries (docs/how-to/relay.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Setting
from dtsa_channel_sim.relay.transport import MessageChannel, RadioMessage, Transport

try:
    from gymnasium.spaces import Box, Dict
    from pettingzoo.utils import BaseParallelWrapper
except ModuleNotFoundError:
    BaseParallelWrapper = object

MessageMap = Mapping[str, Mapping[str, Any]] | Callable[[str, str], Any]
_STEP_MS = Setting("step_ms", "float", None, "time that a step takes", unit="ms", minimum=0.001, maximum=1e6)
_SIZE = Setting("size", "int", None, "bytes of a message", minimum=1)


class MessageEnv(BaseParallelWrapper):  # type: ignore[misc]
    """Any `ParallelEnv` of PettingZoo, with a radio channel between its agents.

    Either parts of observations belong to other agents (`messages`), or agents choose what they send (`space`). Each
    agent sends one message to all others when a step begins; what has come when it ends is in the observation, else
    the last value received, at first 0. `infos[agent]["age"]` has how many steps ago each other agent sent what is
    known of it, -1: nothing has come.

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
        if isinstance(messages, Mapping | Callable) == isinstance(space, Box) or None not in (messages, space):
            raise ConfigError("messages, space", (messages, space), "either messages, or a Box as space")
        self._names: list[str] = list(env.possible_agents)
        self._config = MessageChannel.of(settings, len(self._names))
        self._step_ns, self._size = round(_STEP_MS.check(step_ms) * 1e6), _SIZE.check(size)
        self._space, self._positions, self._next_seed = space, positions, self._config.seed
        if positions is None and (self._config.needs_positions or self._config.access == "error"):
            raise ConfigError("positions", None, "a function that returns where agents are, as the channel needs it")
        Transport(self._config).check_length(self._size, "size")
        self._spaces: dict[str, tuple[Any, Any]] = {}  # of observations and actions
        self._parts: dict[str, dict[str, Any]] = {name: {} for name in self._names}  # known, of what others send
        self._first: dict[str, Any] = {}  # what is known at first: 0, or the nearest values that the space allows
        for name in self._names:
            observation, action = env.observation_space(name), env.action_space(name)
            box = observation if space is None else space
            if not isinstance(box, Box) or (space is None and len(box.shape) != 1):
                allowed = "a Box of one dimension, or messages with a space"
                raise ConfigError(f"observation_space({name!r})", box, allowed)
            self._first[name] = np.clip(np.zeros(box.shape, box.dtype), box.low, box.high)
            for other in [other for other in self._names if other != name]:
                part: Any = ...
                if messages is not None:
                    part = messages(name, other) if callable(messages) else messages.get(name, {}).get(other)
                if part is None:
                    continue
                try:
                    self._parts[name][other] = part if part is ... or isinstance(part, slice) else np.asarray(part)
                    self._first[name][self._parts[name][other]]
                except (IndexError, TypeError, ValueError):
                    allowed = f"a slice or a list of indices below {len(self._first[name])}"
                    raise ConfigError(f"messages[{name!r}][{other!r}]", part, allowed) from None
            if space is not None:
                received = Dict(dict.fromkeys(self._parts[name], space))
                observation = Dict({"observation": observation, "messages": received})
                action = Dict({"action": action, "message": space})
            self._spaces[name] = observation, action

    def observation_space(self, agent: str) -> Any:
        """That of the environment; with a space: a ``Dict`` of its ``observation`` and ``messages`` by agent."""
        return self._spaces[agent][0]

    def action_space(self, agent: str) -> Any:
        """That of the environment; with a space: a ``Dict`` of its ``action`` and the ``message`` to send."""
        return self._spaces[agent][1]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Begin an episode; without a seed, that of the losses is one more than in the last episode."""
        self._config = replace(self._config, seed=self._next_seed if seed is None else seed)
        self._next_seed = self._config.seed + 1
        self._transport, self._step = Transport(self._config), 0
        return self._exchange(*self.env.reset(seed=seed, options=options), {})

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        """Take a step: observations, rewards, terminations, truncations and infos by agent."""
        sent: dict[str, Any] = {}
        if self._space is not None:
            sent = {name: dict.fromkeys(self._names, np.array(both["message"])) for name, both in actions.items()}
            actions = {name: both["action"] for name, both in actions.items()}
        observations, *outcome, infos = self.env.step(actions)
        observations, infos = self._exchange(observations, infos, sent)
        return observations, *outcome, infos

    def _exchange(
        self, observations: dict[str, Any], infos: dict[str, Any], sent: dict[str, dict[str, Any]]
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Let a step's messages, by sender and receiver, pass; return observations and infos with what was received."""
        step, now_ns, names = self._step, self._step * self._step_ns, self._names
        self._step += 1
        if self._space is None:
            copies = {name: np.array(values) for name, values in observations.items()}
            sent = dict.fromkeys(names, copies)
        present = np.array([name in observations for name in names])
        for sender, name in enumerate(names, 1):
            if name in sent and present[sender - 1]:
                self._transport.send(RadioMessage(sender, "", step, self._size, now_ns, present, sent[name]))
        # A slot that begins with the next step is that step's: its messages come first.
        self._transport.advance(now_ns + self._step_ns - 1, self._places())
        observations, infos = dict(observations), dict(infos)
        for name, newest in zip(names, self._transport.newest, strict=True):
            received = {other: message for other, message in zip(names, newest, strict=True) if other != name}
            if name in infos:
                age = {other: step - message.number if message else -1 for other, message in received.items()}
                infos[name] = {**infos[name], "age": age}
            if name not in observations:
                continue
            parts, first = self._parts[name], self._first[name]
            known = {other: received[other].payload[name] if received[other] else first for other in parts}
            if self._space is not None:
                observations[name] = {"observation": observations[name], "messages": known}
                continue
            observations[name] = np.array(observations[name])
            for other, part in parts.items():
                observations[name][part] = known[other][part]
        return observations, infos

    def _places(self) -> NDArray[np.float64] | None:
        """Return where agents are, (3, N), m."""
        if self._positions is None:
            return None
        given = np.asarray(self._positions(self.env), np.float64)
        if given.shape not in ((len(self._names), 2), (len(self._names), 3)):
            raise ConfigError("positions", f"shape {given.shape}", f"({len(self._names)}, 2) or (.., 3), m")
        return np.pad(given.T, ((0, 3 - given.shape[1]), (0, 0)))
