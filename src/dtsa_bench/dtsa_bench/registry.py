"""Names of the commands. A module of its own: `tools/dtsa` reads it before anything is installed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

COMMANDS = {
    "demo": "who speaks next, in nine recorded flights, a page and a picture; under a minute",
    "fly": "one flight with real ROS 2 nodes, recorded to a bag",
    "agent": "one agent on a real network: frames over UDP, no channel node, no ROS",
    "simulate": "one or many flights without ROS, as fast as the machine allows",
    "sweep": "many simulated flights over a grid of settings; can be interrupted and resumed",
    "new-plugin": "a package to begin with: a policy of your own, its test and a sweep",
    "soak": "what is too long for the tests: kills, faults, load and memory over hours",
    "prove": "policy lease explored state by state, for all patterns of loss",
    "embedded": "the protocol on a simulated microcontroller: the same bits, and what it costs",
    "benchmark": "how fast the protocol, the nodes and the simulator are on this machine",
    "replay": "play a bag back into the ROS graph",
    "verify": "check a bag: was every decision what the protocol says?",
    "sniff": "listen to agents on a real network, record and judge what they send",
    "merge": "the bags of agents on a real network as one flight: one time line, results, decisions made again",
    "recover": "make a readable bag of what a killed recorder left behind",
    "view": "a swarm in the browser: a recorded run, one that is being recorded, one on the ROS graph or a network",
    "report": "one web page about one or several recorded runs",
    "export": "a bag's contents as CSV or Parquet",
    "bridge": "connect the swarm to real or simulated Crazyflie quadcopters",
    "fake-crazyflie": "simulated Crazyflie quadcopters that the official library connects to",
    "completion": "a script that completes commands, options and their values in bash or zsh",
}

RECORDED_RUN = "run directory, bag directory or .mcap file"  # what commands take that read one


def module_name(command: str) -> str:
    """Name of the module of a command inside `dtsa_bench.commands`."""
    return command.replace("-", "_")


def available() -> Iterator[tuple[str, str]]:
    """Commands that exist, in the order in which the help shows them, each with what it does."""
    directory = Path(__file__).resolve().parent / "commands"
    for command, text in COMMANDS.items():
        if (directory / f"{module_name(command)}.py").is_file():
            yield command, text
