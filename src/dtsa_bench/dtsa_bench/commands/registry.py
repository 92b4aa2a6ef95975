"""Names of the commands. `tools/dtsa` reads this before anything is installed: it imports nothing but Python's own."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping

COMMANDS = {
    "demo": "who speaks next, in nine recorded flights, a page and a picture; under a minute",
    "fly": "one flight with real ROS 2 nodes, recorded to a bag",
    "agent": "one agent on a real network: frames over UDP, no channel node, no ROS",
    "simulate": "one or many flights without ROS, as fast as the machine allows",
    "sweep": "many simulated flights over a grid of settings; can be interrupted and resumed",
    "league": "cells that any policy flies, entries that anybody can check, and their table",
    "new-plugin": "a package to begin with: a policy of your own, its test and a sweep",
    "replay": "play a bag back into the ROS graph",
    "verify": "check a bag: was every decision what the protocol says?",
    "sniff": "listen to agents on a real network, record and judge what they send",
    "merge": "the bags of agents on a real network as one flight: one time line, results, decisions made again",
    "losses": "what each link lost in recorded flights: rates, bursts, distances, as a channel to fly in",
    "recover": "make a readable bag of what a killed recorder left behind",
    "view": "a swarm in the browser: a recorded run, one that is being recorded, one on the ROS graph or a network",
    "report": "one web page about one or several recorded runs",
    "export": "a bag's contents as CSV or Parquet",
    "relay": "topics of any robots over the shared channel: losses, delay, collisions, range",
    "bridge": "connect the swarm to real or simulated Crazyflie quadcopters",
    "fake-crazyflie": "simulated Crazyflie quadcopters that the official library connects to",
    "peer-lab": "copies of a Crazyflie app (C) on this machine: peer to peer, in virtual time",
    "completion": "a script that completes commands, options and their values in bash or zsh",
}

RECORDED_RUN = "run directory, bag directory or .mcap file"  # what commands take that read one

_MODULES: dict[str, str] = {}  # of commands that do not belong to this package


def add(package: str, commands: Mapping[str, str]) -> None:
    """Adds the commands of another package, for the command line of a checkout."""
    COMMANDS.update(commands)
    _MODULES.update({name: f"{package}.{name.replace('-', '_')}" for name in commands})


def module_of(command: str) -> str:
    """Name of the module of a command."""
    return _MODULES.get(command, f"dtsa_bench.commands.{command.replace('-', '_')}")


def hint(word: str, words: Iterable[str]) -> str:
    """A question that names the nearest of the words that would have been right; empty if none is near."""
    near = difflib.get_close_matches(word, list(words), n=1, cutoff=0.6)
    return f"; did you mean {near[0]}?" if near and near[0] != word else ""
