"""Flights: simulated, recorded, verified; policies, estimators and avoiders of your own for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.config import REGISTRIES
from dtsa_bench.experiments.sweep import run_config as _run_config
from dtsa_bench.log.flight_log import FlightLog, log_of_flight
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.simulation.simulate import simulate as _simulate

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from dtsa_bench.log.verify.result import Result

    from ._settings import RunSettings


def run_config(**settings: Unpack[RunSettings]) -> RunConfig:
    """The configuration of a run from settings by name.

    :param settings: settings of the swarm, of the channel and of the end of a run side by side, such as
        `agents=12, loss=0.1, timeout_s=20`, with the units and ranges of :class:`SwarmConfig`, :class:`ChannelConfig`
        and :class:`RunLimits`. `seed` is that of the swarm and of the channel.

    >>> run_config(agents=18, policy="lease", loss=0.05).swarm
    SwarmConfig(agents=18, moving=18, policy='lease')

    :raises ConfigError: for a name that does not exist or a value that is not allowed.
    """
    return _run_config(settings)


def config_of(config: RunConfig | None, settings: Mapping[str, Any]) -> RunConfig:
    """Return a configuration, or make it from settings; ConfigError: both are there, or it is none."""
    if config is None:
        return _run_config(settings)
    if not isinstance(config, RunConfig):
        raise ConfigError("config", config, "a RunConfig, or settings by name, as in agents=12, loss=0.1")
    if settings:
        raise ConfigError("settings", sorted(settings), "none beside a config")
    return config


def simulate(config: RunConfig | None = None, *, trace: bool = True, **settings: Unpack[RunSettings]) -> FlightLog:
    """Fly one run without ROS; equal configurations give equal flights, bit for bit.

    :param config: the run; None: made from the settings.
    :param trace: keep what happened in every slot, which arrays, tables and figures need: about 150 bytes an agent and
        slot.
    :param settings: as for :func:`run_config`, if there is no config.

    >>> flight = simulate(agents=4, policy="tdma", seed=3)
    >>> flight.summary["end"], flight.path.shape  # control instants, xyz, agents; m
    ('completed', (428, 3, 4))

    :raises ConfigError: for a setting that is not usable, or both a config and settings.
    """
    run = config_of(config, settings)
    return log_of_flight(_simulate(run, log=trace, frames=trace))


def open(path: str | Path) -> FlightLog:
    """Read a recorded flight, without ROS; of a directory with the bags of its agents, these as one.

    :param path: run directory, bag directory or .mcap file.
    :raises UnusableBag: if it is no bag of this project, or is damaged.
    :raises ConfigError: for bags of agents that are not of one flight.
    """
    from dtsa_bench.log.merged_bag import open_log

    return open_log(path)


def verify(path: str | Path, *, progress: Callable[[int], None] | None = None) -> Result:
    """Check whether every message of a recorded run is what the protocol gives.

    :param path: run directory, bag directory or .mcap file.
    :param progress: is called with the slot now and then.
    :returns: what was checked, and the first difference if there is one.
    :raises UnusableBag: if it cannot be read as a bag of this project at all.
    """
    from dtsa_bench.log.verify.check import verify_bag

    return verify_bag(path, progress)


def register(kind: str, name: str, factory: Any) -> None:
    """Make a policy, estimator or avoider known to this process: `simulate` and `sweep` fly it by its name.

    Worker processes and nodes do not know it: for these announce it by an entry point, see docs/reference/plug-ins.md.

    :param kind: "policy", "estimator" or "avoider".
    :param name: what the setting of that kind calls it; one that was registered before is replaced.
    :param factory: a class, or a function that makes the part of one observer: called with the configuration and the
        observer's id (0: one that hears everything). A policy has `choose(table, slot)`, which gives the id of the
        sender; an estimator `estimate(table, slot, step, position, velocity)`; an avoider `command(table, slot, step)`.

    >>> class Countdown:
    ...     def __init__(self, config, agent):
    ...         self.agents = config.agents
    ...
    ...     def choose(self, table, slot):
    ...         return self.agents - slot % self.agents
    >>> register("policy", "countdown", Countdown)

    :raises ConfigError: for a kind that does not exist, a built-in name, or a factory that cannot be called.
    """
    if kind not in REGISTRIES:
        raise ConfigError("kind", kind, ", ".join(REGISTRIES))
    REGISTRIES[kind].register(name, factory)
