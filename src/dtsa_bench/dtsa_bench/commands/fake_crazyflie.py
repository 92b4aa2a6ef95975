"""`dtsa fake-crazyflie`: simulated Crazyflies over UDP."""

from __future__ import annotations

import argparse


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register the command."""
    from dtsa_bench.crazyflies.simulated.cli import DESCRIPTION, add_arguments

    parser = subparsers.add_parser(
        "fake-crazyflie",
        help="simulated Crazyflies over UDP that cflib connects to",
        description=DESCRIPTION,
    )
    add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Fly the fleet until Ctrl-C."""
    from dtsa_bench.crazyflies.simulated import cli

    return cli.run(args)
