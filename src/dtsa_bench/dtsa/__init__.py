"""Channel access in quadcopter swarms: simulate, sweep, read and verify recorded runs.

This is the public interface; everything else in `dtsa_agent`, `dtsa_channel_sim` and `dtsa_bench` may change. Importing
it costs next to nothing: what a name needs is loaded when the name is first used. Units are SI, positions are in frame
`map` (the room's centre, ENU). Figures need Matplotlib, data frames need pandas. See docs/how-to/python.md.
"""

from __future__ import annotations

from importlib import import_module

from dtsa_bench import __version__ as __version__

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

__all__ = sorted((*_HOME, "__version__", "env"))  # their types: __init__.pyi


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
    return __all__
