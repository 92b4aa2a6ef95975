"""Command-line options made from the configuration dataclasses: the same words for `fly`, `simulate` and `sweep`."""

from __future__ import annotations

import argparse
import re
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Setting, Settings, settings_of
from dtsa_channel_sim import ChannelConfig, ClockConfig

from .config import FROM_SWARM, RunConfig, RunLimits, from_swarm

_SECTIONS: tuple[tuple[str, type[Settings], tuple[str, ...]], ...] = (
    ("swarm", SwarmConfig, ()),
    ("channel", ChannelConfig, FROM_SWARM),
    ("limits", RunLimits, ()),
)
_MEMORY = Path("/proc/meminfo")
_TITLES = {"swarm": "the swarm", "channel": "the radio channel", "limits": "the end of a run"}


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """Add an option for every setting of a run, and `--channel FILE` for what does not fit into one option."""
    groups: dict[str, Any] = {}
    for section, cls, derived in _SECTIONS:
        for setting in settings_of(cls):
            title = setting.group.lower() or _TITLES[section]
            group = groups.get(title) or groups.setdefault(title, parser.add_argument_group(title))
            if setting.name not in derived:
                _add(group, setting, section)
    text = "YAML file with settings of the channel, those too that have no option: loss_matrix, link_loss, schedule"
    groups[_TITLES["channel"]].add_argument("--channel", metavar="FILE", default=None, help=text)


def add_mode_options(parser: argparse.ArgumentParser) -> Any:
    """Add the options of flights in real time; return their group, for further options."""
    group = parser.add_argument_group("real time")
    add_options(group, RunConfig, "run")
    add_options(group, ClockConfig, "clocks", "clock-", skip=("seed",))
    return group


def add_options(group: Any, cls: type[Settings], section: str, prefix: str = "", skip: Collection[str] = ()) -> None:
    """Add an option for every setting of a settings class that fits into one.

    :param section: what :func:`option_values` calls these options.
    :param prefix: stands before the setting's name in the option's.
    """
    for setting in settings_of(cls):
        if setting.name not in skip:
            _add(group, setting, section, prefix)


def option_values(args: argparse.Namespace, cls: type[Settings], section: str) -> dict[str, Any]:
    """The values of those options of :func:`add_options` that were given, by name.

    :raises ConfigError: for a text that is no value of its setting's kind.
    """
    given = ((setting, getattr(args, f"{section}.{setting.name}", None)) for setting in settings_of(cls))
    return {
        setting.name: setting.parse(value) if isinstance(value, str) else value
        for setting, value in given
        if value is not None
    }


_PLACEHOLDERS = {"int": "N", "float": "X", "values": "NAME=X,...", "file": "FILE"}


def _add(group: Any, setting: Setting, section: str, prefix: str = "") -> None:
    """Add an option for a setting, if it fits into one."""
    if setting.kind in ("structure", "vector"):
        return
    text, default = setting.description.replace("%", "%%"), setting.default
    if default not in (None, {}, ""):
        text += f" [{f'{default:g}' if isinstance(default, float) else default}]"
    names = f"--{prefix}" + setting.name.replace("_", "-")
    options: dict[str, Any] = {"dest": f"{section}.{setting.name}", "default": None, "help": text}
    if setting.kind == "bool":
        group.add_argument(names, action=argparse.BooleanOptionalAction, **options)
        return
    placeholder = _PLACEHOLDERS.get(setting.kind, "NAME" if setting.choices else "TEXT")
    action = group.add_argument(names, metavar=placeholder, **options)
    action.words = tuple(str(word) for word in setting.choices)  # for completion; plug-ins have names of their own


def run_config(args: argparse.Namespace, **fixed: Any) -> RunConfig:
    """The run that the options describe; fixed settings of the swarm win over them.

    :raises ConfigError: naming the option, the value and what is allowed.
    """
    values = {section: option_values(args, cls, section) for section, cls, _ in _SECTIONS}
    swarm = SwarmConfig.from_dict({**values["swarm"], **fixed})
    derived = from_swarm(swarm)
    settings = {**values["channel"], **derived}
    file = getattr(args, "channel", None)
    channel = ChannelConfig.from_yaml(file, **settings) if file else ChannelConfig.from_dict(settings)
    clocks = ClockConfig(seed=swarm.seed, **option_values(args, ClockConfig, "clocks"))
    limits = RunLimits(**values["limits"])
    return RunConfig(swarm, channel, limits, clocks=clocks, **option_values(args, RunConfig, "run"))


def whole_number(text: str, name: str, minimum: int, maximum: int) -> int:
    """A number given to an option of a single command.

    :raises ConfigError: if it is none, or out of range.
    """
    return int(Setting(name, "int", None, name, minimum=minimum, maximum=maximum).read(text))


def number(text: str, name: str, minimum: float, maximum: float, unit: str = "s") -> float:
    """A number with a unit given to an option of a single command.

    :raises ConfigError: if it is none, or out of range.
    """
    return float(Setting(name, "float", None, name, unit=unit, minimum=minimum, maximum=maximum).read(text))


def processes(text: str | None) -> int | None:
    """The number of processes that an option says; None: one a core.

    :raises ConfigError: if it is no such number.
    """
    return None if text is None else whole_number(text, "jobs", 1, 1024)


def named_values(words: Iterable[str]) -> dict[str, Any]:
    """Values of `--set NAME=VALUE` by name, with underscores; values are YAML.

    :raises ConfigError: for one that is none.
    """
    import yaml

    values = {}
    for word in words:
        name, sign, value = word.partition("=")
        if not sign:
            raise ConfigError("set", word, "NAME=VALUE")
        try:
            values[name.replace("-", "_")] = yaml.safe_load(value)
        except yaml.YAMLError:
            raise ConfigError("set", word, "NAME=VALUE with a plain value") from None
    return values


def check_memory(needed: int, what: str, name: str, value: object) -> None:
    """Whether this machine has memory for something, before it is asked for.

    :param needed: bytes.
    :param what: what they are for.
    :raises ConfigError: if it has not; it names the setting.
    """
    free = re.search(r"^MemAvailable: *(\d+) kB$", _MEMORY.read_text() if _MEMORY.exists() else "", re.MULTILINE)
    if free and needed > int(free[1]) << 10:
        sizes = f"{what} would need {needed / 2**30:.1f} GiB, {int(free[1]) / 2**20:.1f} GiB are free"
        raise ConfigError(name, value, f"what fits into this machine's memory: {sizes}")


def check_free(directory: Path, name: str = "out") -> None:
    """Whether results can be put there: it does not exist yet, or is an empty directory.

    :raises ConfigError: if it is in use; it names the setting.
    """
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise ConfigError(name, str(directory), "a directory that is empty or does not exist yet")


def write_whole(path: Path, text: str) -> None:
    """Write a file whole or not at all: no reader sees half of it."""
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def new_directory(path: str | Path) -> Path:
    """The directory for results, which does not exist yet, or is empty.

    :raises ConfigError: if it is in use or cannot be made.
    """
    directory = Path(path)
    try:
        check_free(directory)
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError("out", str(path), f"a directory that can be written to ({error.strerror})") from None
    return directory
