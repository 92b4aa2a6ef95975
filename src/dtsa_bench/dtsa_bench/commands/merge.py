"""`dtsa merge`: the bags of several agents as one flight."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

DESCRIPTION = """\
Lays the bags that agents on a network have made of their own flights on one time line, by the frames that they share,
and says what came of the flight: clocks, ages, errors, agreement, the closest pair; whether two spoke in one turn;
whether all decisions follow from what each agent heard, made again by the core. Exit code 1 if they do not."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register the command."""
    parser = subparsers.add_parser("merge", help="the bags of several agents as one flight", description=DESCRIPTION)
    parser.add_argument("bags", nargs="+", metavar="BAG", help="directory of `agent --out`, or its .mcap file")
    parser.add_argument(
        "--air-us", metavar="X", default="0", help="a frame is on the air for so long: count overlaps [0]"
    )
    parser.add_argument("--out", metavar="FILE", help="write the result there, too, as JSON")
    parser.add_argument("--json", action="store_true", help="print the result as JSON instead of lines")


def run(args: argparse.Namespace) -> int:
    """Merge, and print what came of it."""
    from dtsa_agent.core.settings import Setting
    from dtsa_bench.air.agent_bag import read
    from dtsa_bench.air.merge import merge, verified
    from dtsa_bench.batch.table import write_whole

    air_us = Setting("air_us", "float", 0.0, "time of a frame on the air", unit="us", minimum=0, maximum=1e6)
    summary = merge([read(path) for path in args.bags], round(air_us.read(args.air_us) * 1e3))
    text = json.dumps(summary, indent=2) + "\n"
    if args.out:
        write_whole(Path(args.out), text)
    print(text if args.json else "\n".join(lines(summary)) + "\n", end="")
    return 0 if verified(summary) else 1


def lines(summary: dict[str, object]) -> list[str]:
    """A summary, indented where it has parts."""
    found = []
    for key, value in summary.items():
        if isinstance(value, dict):
            found.append(f"{key.replace('_', ' ')}:")
            found += [f"  {line}" for line in lines(value)]
        elif isinstance(value, float):
            found.append(f"{key.replace('_', ' '):26} {value:.6g}")
        else:
            found.append(f"{key.replace('_', ' '):26} {'-' if value in (None, []) else value}")
    return found
