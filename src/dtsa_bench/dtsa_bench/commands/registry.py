"""The commands: their names, and what a command is.

`tools/dtsa` reads this before anything is installed, so it imports the standard library alone.
"""

from __future__ import annotations

import argparse
import difflib
import importlib
import importlib.util
import sys
from collections.abc import Iterable, Mapping
from typing import Any

_COMMANDS = {  # by name: the module, and what it does
    "demo": ("demo", "who sends next, in nine recorded flights, a page and a picture; under a minute"),
    "fly": ("fly", "one flight with real ROS 2 nodes, recorded to a bag"),
    "agent": ("network", "one agent on a real network: frames over UDP, no channel node, no ROS"),
    "simulate": ("simulation", "one or many flights without ROS, as fast as the machine allows"),
    "sweep": ("simulation", "many simulated flights over a grid of settings; can be interrupted and resumed"),
    "league": ("league", "cells that any policy flies, entries that you can check, and their table"),
    "new-plugin": ("league", "a package to begin with: a policy of your own, its test and a sweep"),
    "replay": ("playback", "play a bag back into the ROS graph"),
    "verify": ("recordings", "check a bag: was every decision what the protocol says?"),
    "sniff": ("network", "listen to agents on a real network, record and judge what they send"),
    "merge": ("recordings", "the bags of agents on a real network as one flight: time line, results, decisions"),
    "losses": ("recordings", "what each link lost in recorded flights, rates and bursts, as a channel to fly in"),
    "recover": ("recordings", "make a readable bag of what a killed recorder left behind"),
    "view": ("playback", "a swarm in the browser: one on the ROS graph, or on a network"),
    "report": ("recordings", "one web page about one or several recorded runs"),
    "export": ("recordings", "a bag's contents as CSV or Parquet"),
    "relay": ("network", "topics of any robots over the shared channel: losses, delay, collisions, range"),
    "bridge": ("crazyflies", "connect the swarm to real or simulated Crazyflie quadcopters"),
    "fake-crazyflie": ("crazyflies", "simulated Crazyflie quadcopters that the official library connects to"),
    "peer-lab": ("crazyflies", "copies of a Crazyflie app (C) on this machine: peer to peer, in virtual time"),
    "completion": ("cli", "a script that completes commands, options and their values in bash or zsh"),
}
COMMANDS = {name: text for name, (_, text) in _COMMANDS.items()}
_MODULES = {name: f"dtsa_bench.commands.{module}" for name, (module, _) in _COMMANDS.items()}

RECORDED_RUN = "run directory, bag directory or .mcap file"  # what commands take that read one
INTERRUPTED = 130  # exit code after Ctrl-C

Row = tuple[str, str] | tuple[str, str, dict[str, Any]]


class Command:
    """A command of the command line. Its class is called after it: that of `fake-crazyflie` is FakeCrazyflieCommand."""

    description: str
    examples: tuple[tuple[str, str], ...] = ()  # words after the command's name, and what they do
    options: tuple[Row, ...] = ()

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add the command's options."""
        add_rows(parser, self.options)

    def run(self, args: argparse.Namespace) -> int:
        """Do it; the exit code."""
        raise NotImplementedError


def add_rows(parser: argparse._ActionsContainer, rows: Iterable[Row]) -> None:
    """Add options: their words, the help, and more arguments for argparse.

    Words are ``--flag``, ``--name VALUE``, ``name VALUE...`` (one or more) or ``name VALUE*`` (any number).
    """
    for words, text, *others in rows:
        name, _, value = words.partition(" ")
        more: dict[str, Any] = {"help": text, **(others[0] if others else {})}
        if value:
            more["metavar"] = value.removesuffix("...").removesuffix("*")
        if value.endswith(("...", "*")):
            more["nargs"] = "*" if value.endswith("*") else "+"
        elif name.startswith("-") and not value and not more.keys() & {"action", "choices"}:
            more["action"] = "store_true"
        parser.add_argument(name, **more)


def warn(text: str) -> None:
    """Print a line for the user to standard error."""
    print(f"dtsa: {text}", file=sys.stderr, flush=True)


def add_commands(commands: Mapping[str, str], modules: Mapping[str, str]) -> None:
    """Add commands of another package, what each does and its module, for the command line of a checkout."""
    COMMANDS.update(commands)
    _MODULES.update(modules)


def load_command(name: str) -> Command:
    """Import the module of a command; return the command."""
    command = getattr(importlib.import_module(_MODULES[name]), f"{name.title().replace('-', '')}Command")()
    assert isinstance(command, Command)
    return command


def hint(word: str, words: Iterable[str]) -> str:
    """As ``core.errors.did_you_mean``, where nothing is installed yet."""
    near = difflib.get_close_matches(word, list(words), n=1, cutoff=0.6)
    return f"; did you mean {near[0]}?" if near and near[0] != word else ""


_WORKSPACE = "build the workspace and source it: colcon build && . install/setup.bash"
_ROS = "source an installation of ROS 2 Jazzy, or use tools/dtsa of a checkout on x86_64"
_ROS_PACKAGES = (
    "rclpy", "ament_index_python", "builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "nav_msgs",
    "rcl_interfaces", "rosgraph_msgs", "std_msgs", "std_srvs", "visualization_msgs",
)  # fmt: skip
_HOW = {
    **dict.fromkeys(("dtsa_msgs", "dtsa_agent", "dtsa_channel_sim"), _WORKSPACE),
    **dict.fromkeys(("mcap", "rosbags", "lz4", "zstandard", "pyarrow", "pandas", "aiohttp", "shtab"), "pip install {}"),
    **dict.fromkeys(("cflib", "distributed"), "pip install {}"),
    **dict.fromkeys(_ROS_PACKAGES, _ROS),
    **dict.fromkeys(("serial", "cobs"), "pip install pyserial cobs"),
    "yaml": "apt install python3-yaml, or pip install pyyaml",
    **dict.fromkeys(("numpy", "scipy", "matplotlib", "rich", "jinja2"), "apt install python3-{0}, or pip install {0}"),
}


def report_missing_package(program: str, error: ImportError) -> int:
    """Print one line about a missing package; raise the error again if it is not about one that we use."""
    name = (error.name or "").split(".")[0]
    how = _HOW.get(name)
    if how is None:
        raise error
    if name == "dtsa_msgs" and not _is_installed("rclpy"):
        how = _ROS  # there is nothing to build a workspace on
    text = f"the Python package {name} is missing: {how.format(name)} (docs/how-to/install.md)"
    print(f"{program}: error: {text}", file=sys.stderr)
    return 2


def _is_installed(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except (ImportError, ValueError):
        return False
