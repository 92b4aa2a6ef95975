"""Command-line options made from the configuration dataclasses: the same words for `fly`, `simulate` and `sweep`."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings import Setting, settings_of
from dtsa_bench.run_config import LOCKSTEP, RunConfig, RunLimits
from dtsa_channel_sim import ChannelConfig, ClockConfig

# Settings of the channel that follow from the swarm's.
FROM_SWARM = ("agents", "slot_ns", "seed")
_SECTIONS: tuple[tuple[str, type, tuple[str, ...]], ...] = (
    ("swarm", SwarmConfig, ()),
    ("channel", ChannelConfig, FROM_SWARM),
    ("limits", RunLimits, ()),
)
_TITLES = {"swarm": "the swarm", "channel": "the radio channel", "limits": "the end of a run"}


def add_run_options(parser: argparse.ArgumentParser, skip: Iterable[str] = ()) -> None:
    """Adds an option for every setting of a run, and `--channel FILE` for what does not fit into one option.

    :param parser: the command's parser.
    :param skip: settings that the command does not offer.
    """
    left_out = set(skip)
    for section, cls, derived in _SECTIONS:
        group = parser.add_argument_group(_TITLES[section])
        for setting in settings_of(cls):
            if setting.kind != "structure" and setting.name not in derived and setting.name not in left_out:
                _add(group, setting, section)
        if section == "channel":
            group.add_argument(
                "--channel",
                metavar="FILE",
                default=None,
                help="YAML file with settings of the "
                "channel, those too that have no option: loss_matrix, link_loss, schedule",
            )


def add_mode_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options of flights in real time.

    :param parser: the command's parser.
    """
    group = parser.add_argument_group("real time")
    group.add_argument(
        "--mode",
        metavar="NAME",
        default=None,
        help="lockstep: all wait for each other, as fast as the "
        "machine allows; realtime: every agent on its own clock [lockstep]",
    )
    for setting in settings_of(ClockConfig):
        if setting.name != "seed":
            _add(group, setting, "clocks", "clock-")
    group.add_argument(
        "--align",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="agents align their clocks by what they hear [True]",
    )


def _add(group: Any, setting: Setting, section: str, prefix: str = "") -> None:
    option = f"--{prefix}" + setting.name.replace("_", "-")
    where = f"{section}.{setting.name}"
    text = setting.description.replace("%", "%%")
    if setting.default not in (None, {}, ""):
        text += f" [{_shown(setting.default)}]"
    if setting.kind == "bool":
        group.add_argument(option, dest=where, action=argparse.BooleanOptionalAction, default=None, help=text)
        return
    metavar = {"int": "N", "float": "X", "values": "NAME=X,..."}.get(
        setting.kind, "NAME" if setting.choices else "TEXT"
    )
    group.add_argument(option, dest=where, metavar=metavar, default=None, help=text)


def _shown(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def run_config(args: argparse.Namespace, **fixed: Any) -> RunConfig:
    """The run that the options describe.

    :param args: parsed options.
    :param fixed: settings of the swarm that win over the options.
    :raises ConfigError: naming the option, the value and what is allowed.
    """
    values: dict[str, dict[str, Any]] = {}
    for section, cls in (*((section, cls) for section, cls, _ in _SECTIONS), ("clocks", ClockConfig)):
        chosen = values[section] = {}
        for setting in settings_of(cls):
            given = getattr(args, f"{section}.{setting.name}", None)
            if given is not None:
                chosen[setting.name] = setting.parse(given) if isinstance(given, str) else given
    swarm = SwarmConfig.from_dict({**values["swarm"], **fixed})
    derived = {"agents": swarm.agents, "slot_ns": swarm.slot_ns, "seed": swarm.seed}
    if getattr(args, "channel", None):
        channel = ChannelConfig.from_yaml(args.channel, **values["channel"], **derived)
    else:
        channel = ChannelConfig.from_dict({**values["channel"], **derived})
    mode = getattr(args, "mode", None) or LOCKSTEP
    clocks = ClockConfig(seed=swarm.seed, **values["clocks"])
    return RunConfig(swarm, channel, RunLimits(**values["limits"]), mode, clocks, getattr(args, "align", True))


def whole_number(text: str, name: str, minimum: int, maximum: int) -> int:
    """A number given to an option of a single command.

    :raises ConfigError: if it is none, or out of range.
    """
    try:
        value = int(text)
    except ValueError:
        value = minimum - 1
    if not minimum <= value <= maximum:
        raise ConfigError(name, text, f"a whole number, {minimum} to {maximum}")
    return value


def new_directory(path: str | Path, name: str = "out") -> Path:
    """The directory for results: it does not exist yet, or is empty.

    :raises ConfigError: if it is in use or cannot be made.
    """
    directory = Path(path)
    try:
        if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
            raise ConfigError(name, str(path), "a directory that is empty or does not exist yet")
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(name, str(path), f"a directory that can be written to ({error.strerror})") from None
    return directory
