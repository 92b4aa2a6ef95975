"""`dtsa relay`: topics of any robots over the shared channel."""

from __future__ import annotations

import argparse
from pathlib import Path

DESCRIPTION = """\
Topics of any robots over the shared channel: /robot1/pose comes out as /robot2/from/robot1/pose, late, or not at all.
A YAML file names robots, topics, places and the channel. Ctrl-C ends it."""
EXAMPLES = (("examples/relay.yaml", "two talkers that lose every fifth message"),)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    parser.add_argument("file", type=Path, help="YAML file: robots, topics, channel")
    parser.add_argument("--use-sim-time", action="store_true", help="time is that of /clock")


def run(args: argparse.Namespace) -> int:
    """Relay until Ctrl-C."""
    from dtsa_channel_sim.relay import node

    sim_time = f"use_sim_time:={str(args.use_sim_time).lower()}"
    return node.main(["relay", "--ros-args", "-p", f"config:={args.file.resolve()}", "-p", sim_time])
