"""Environments for learning: agents that say in each slot whether they send. See docs/how-to/learning.md."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.simulation.environment.batch import BatchEnv, Ended
from dtsa_bench.simulation.environment.observation import Observer, fields
from dtsa_bench.simulation.environment.reward import MeanAge, Reward, SlotResults

from ._flight import run_config

if TYPE_CHECKING:
    from dtsa_bench.simulation.environment.parallel import SwarmEnv

__all__ = ["BatchEnv", "Ended", "MeanAge", "Observer", "Reward", "SlotResults", "batch_env", "fields", "parallel_env"]


def parallel_env(
    config: RunConfig | None = None,
    *,
    reward: Reward | None = None,
    slots: int | None = None,
    render_mode: str | None = None,
    **settings: Any,
) -> SwarmEnv:
    """One flight as a `ParallelEnv` of PettingZoo.

    :param config: what is flown, without its policy; None: made from the settings.
    :param reward: what a slot was worth, (B, N) or (B, 1) of :class:`SlotResults` with B = 1; None: :class:`MeanAge`.
    :param slots: a flight that is not over after so many slots is truncated; None: at its `timeout_s`.
    :param render_mode: "rgb_array", "ansi", "human" or None.
    :param settings: as for :func:`dtsa.run_config`, if there is no config.
    :raises ConfigError: for a value that is not usable, or if PettingZoo is not installed.
    """
    run = _run(config, settings)
    try:
        from dtsa_bench.simulation.environment.parallel import SwarmEnv
    except ModuleNotFoundError as error:
        if error.name not in ("pettingzoo", "gymnasium"):
            raise
        allowed = "an installed PettingZoo (pip install 'dtsa[learning]'); dtsa.env.batch_env() needs none"
        raise ConfigError("pettingzoo", None, allowed) from None
    return SwarmEnv(run, reward=reward, slots=slots, render_mode=render_mode)


def batch_env(
    config: RunConfig | None = None,
    *,
    flights: int = 32,
    reward: Reward | None = None,
    slots: int | None = None,
    autoreset: bool = True,
    **settings: Any,
) -> BatchEnv:
    """Many flights at once, on arrays.

    :param config: what is flown, without its policy; None: made from the settings.
    :param flights: number of flights B.
    :param reward: what a slot was worth, (B, N) or (B, 1) of :class:`SlotResults`; None: :class:`MeanAge`.
    :param slots: a flight that is not over after so many slots is truncated; None: at its `timeout_s`.
    :param autoreset: a flight that is over is followed by the next one.
    :param settings: as for :func:`dtsa.run_config`, if there is no config.
    :raises ConfigError: for a value that is not usable.
    """
    run = _run(config, settings)
    return BatchEnv(run, flights, reward=reward, slots=slots, autoreset=autoreset)


def _run(config: RunConfig | None, settings: dict[str, Any]) -> RunConfig:
    if config is not None and settings:
        raise ConfigError("settings", sorted(settings), "none beside a config")
    if "policy" in settings:
        raise ConfigError("policy", settings["policy"], "none: the actions say who sends")
    return run_config(**settings) if config is None else config
