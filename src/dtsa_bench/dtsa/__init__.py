"""Channel access in quadcopter swarms: simulate, sweep, read and verify recorded runs.

This is the public interface; everything else in `dtsa_agent`, `dtsa_channel_sim` and `dtsa_bench` may change. Importing
it costs next to nothing: what a name needs is loaded when the name is first used. Units are SI, positions are in frame
`map` (the room's centre, ENU). Figures need Matplotlib, data frames need pandas. See docs/how-to/python.md.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from dtsa_bench import __version__

if TYPE_CHECKING:
    from dtsa_agent.core import (
        Agent,
        ConfigError,
        Decision,
        DtsaError,
        LocalProtocolError,
        PluginError,
        RemoteProtocolError,
        SlotOutcome,
        SwarmConfig,
        plug_in_random,
    )
    from dtsa_agent.core.plugins import Table
    from dtsa_agent.core.registry import REASON_TEXTS as REASONS
    from dtsa_bench.drawing.palette import agent_colour
    from dtsa_bench.log.bag.errors import BagError, UnusableBag
    from dtsa_bench.log.flight_log import FlightLog
    from dtsa_bench.log.verify.result import Difference
    from dtsa_bench.log.verify.result import Result as Verification
    from dtsa_bench.runs.config import RunConfig, RunLimits
    from dtsa_channel_sim import Channel, ChannelConfig, ClockConfig, Verdict

    from . import env
    from ._flights import open, register, run_config, simulate, verify
    from ._plots import plot_ages, plot_bars, plot_distances, plot_lines, plot_matrix, plot_trajectories
    from ._sweep import SweepResult, sweep

__all__ = [
    "REASONS", "Agent", "BagError", "Channel", "ChannelConfig", "ClockConfig", "ConfigError", "Decision", "Difference",
    "DtsaError", "FlightLog", "LocalProtocolError", "PluginError", "RemoteProtocolError", "RunConfig", "RunLimits",
    "SlotOutcome", "SwarmConfig", "SweepResult", "Table", "UnusableBag", "Verdict", "Verification", "__version__",
    "agent_colour", "env", "open", "plot_ages", "plot_bars", "plot_distances", "plot_lines", "plot_matrix",
    "plot_trajectories", "plug_in_random", "register", "run_config", "simulate", "sweep", "verify",
]  # fmt: skip

_HOMES = {
    "dtsa._flights": ("open", "register", "run_config", "simulate", "verify"),
    "dtsa._plots": ("plot_ages", "plot_bars", "plot_distances", "plot_lines", "plot_matrix", "plot_trajectories"),
    "dtsa._sweep": ("SweepResult", "sweep"),
    "dtsa_agent.core": (
        "Agent", "ConfigError", "Decision", "DtsaError", "LocalProtocolError", "PluginError", "RemoteProtocolError",
        "SlotOutcome", "SwarmConfig", "plug_in_random",
    ),
    "dtsa_agent.core.plugins": ("Table",),
    "dtsa_agent.core.registry": ("REASONS",),
    "dtsa_bench.log.bag.errors": ("BagError", "UnusableBag"),
    "dtsa_bench.drawing.palette": ("agent_colour",),
    "dtsa_bench.runs.config": ("RunConfig", "RunLimits"),
    "dtsa_bench.log.flight_log": ("FlightLog",),
    "dtsa_bench.log.verify.result": ("Difference", "Verification"),
    "dtsa_channel_sim": ("Channel", "ChannelConfig", "ClockConfig", "Verdict"),
}  # fmt: skip
_HOME = {name: module for module, names in _HOMES.items() for name in names}
_OTHER_NAMES = {"Verification": "Result", "REASONS": "REASON_TEXTS"}

if not TYPE_CHECKING:  # a type checker takes the names from above, and knows no others

    def __getattr__(name: str) -> object:
        """Load what a name needs when it is first used."""
        if name == "env":
            return import_module("dtsa.env")
        if name not in _HOME:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(import_module(_HOME[name]), _OTHER_NAMES.get(name, name))
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """The public names."""
    return sorted(__all__)
