"""Environments for learning: agents that say when they send, and any agents with a channel between them.

See docs/how-to/learning.md and docs/how-to/relay.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.simulation.environment import MeanAge, Observer, Reward, SlotResults, SwarmEnv, fields
from dtsa_bench.simulation.message_environment import MessageEnv, MessageMap

from ._flights import config_of

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from ._settings import RunSettings

__all__ = [
    "MeanAge", "MessageEnv", "Observer", "Reward", "SlotResults", "SwarmEnv", "channel", "fields", "parallel_env",
]  # fmt: skip


def parallel_env(
    config: RunConfig | None = None, *, reward: Reward | None = None, slots: int | None = None,
    render_mode: str | None = None, **settings: Unpack[RunSettings],
) -> SwarmEnv:  # fmt: skip
    """One flight as a `ParallelEnv` of PettingZoo.

    :param config: what is flown, without its policy; None: made from the settings.
    :param reward: what a slot was worth: (N,), or one number for all agents, of :class:`SlotResults`; None:
        :class:`MeanAge`.
    :param slots: a flight that is not over after so many slots is truncated; None: at its `timeout_s`.
    :param render_mode: "ansi", "human" or None.
    :param settings: as for :func:`dtsa.run_config`, if there is no config.

    >>> env = parallel_env(agents=4, slots=50)
    >>> observations, infos = env.reset(seed=1)
    >>> observations, rewards, *_ = env.step({agent: int(agent == "agent_1") for agent in env.agents})

    :raises ConfigError: for a value that is not usable, or if PettingZoo is not installed.
    """
    if "policy" in settings:
        raise ConfigError("policy", settings["policy"], "none: the actions decide which agents send")
    return SwarmEnv(config_of(config, settings), reward=reward, slots=slots, render_mode=render_mode)


def channel(env: Any, messages: MessageMap | None = None, **more: Any) -> MessageEnv:
    """Put a radio channel between the agents of any `ParallelEnv`.

    :param env: the environment; its agents in the order of `possible_agents` have the ids 1 to N.
    :param messages: which numbers of an agent's observation, of shape (F,), belong to which other agent: a slice or
        indices as `messages[agent][other]`, or a function of both names; None: agents choose what they send (`space`).
    :param more: `space`, `step_ms`, `size`, `positions` and settings of the channel, as for :class:`MessageEnv`.
    :raises ConfigError: for a value that is not usable, or if PettingZoo is not installed.
    """
    return MessageEnv(env, messages, **more)
