"""`dtsa simulate`: one flight without ROS, the same bit for bit as `dtsa fly` in lockstep."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dtsa_bench.simulation.simulate import SimulatedFlight

DESCRIPTION = """\
Flies one run without ROS, as fast as this machine allows, over the same core as the nodes. For equal options
and seed
every slot has the same sender and every quadcopter the same positions as with `fly`, bit for bit."""
EXAMPLES = (
    ("--agents 18 --policy dtsa --loss 0.01", "one flight, its results as lines"),
    ("--moving 2 --policy lease --json", "the same as JSON"),
    ("--agents 12 --picture flight.png", "with a picture of the paths"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    from dtsa_bench.runs.options import add_run_options

    parser.usage = "%(prog)s [OPTIONS]"
    parser.add_argument(
        "--out", metavar="DIR", help="directory for summary.json and config.json; default: only printed"
    )
    parser.add_argument("--json", action="store_true", help="print summary.json instead of lines")
    parser.add_argument("--picture", metavar="FILE.png", help="draw the paths from above")
    add_run_options(parser)


def run(args: argparse.Namespace) -> int:
    """Fly and print what came of it."""
    from dtsa_agent.core import make_scenario
    from dtsa_agent.keys import check_key
    from dtsa_bench.runs.options import new_directory, run_config
    from dtsa_bench.runs.summary_text import describe
    from dtsa_bench.simulation.simulate import simulate

    config = run_config(args)
    check_key(config.swarm)  # before anything is made
    make_scenario(config.swarm)
    picture = None if args.picture is None else _checked(Path(args.picture))
    directory = None if args.out is None else new_directory(args.out)
    flight = simulate(config, log=picture is not None)
    summary = flight.summary()
    text = json.dumps(summary, indent=2) + "\n"
    if directory is not None:
        _write(directory, text, json.dumps(config.to_dict(), indent=2) + "\n")
    print(text if args.json else describe(summary), end="")
    if picture is not None:
        _draw(picture, flight, summary)
    return 0


def _checked(picture: Path) -> Path:
    """A file that a picture can be written to.

    :raises ConfigError: if its name or its directory does not fit.
    """
    from dtsa_agent.core.errors import ConfigError

    if picture.suffix.lower() != ".png" or picture.is_dir() or not picture.parent.is_dir():
        raise ConfigError("picture", str(picture), "a file *.png in a directory that exists")
    return picture


def _draw(picture: Path, flight: SimulatedFlight, summary: dict[str, Any]) -> None:
    from dtsa_bench.drawing import optional_picture

    assert flight.log is not None
    with optional_picture(picture):
        from dtsa_bench.drawing.flight_paths import draw_flight

        draw_flight(picture, flight.scenario, flight.log.positions(), summary)
        print(f"picture: {picture}", file=sys.stderr)


def _write(directory: Path, summary: str, config: str) -> None:
    (directory / "summary.json").write_text(summary, encoding="utf-8")
    (directory / "config.json").write_text(config, encoding="utf-8")
