"""`dtsa merge`: the bags of several agents as one flight."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

DESCRIPTION = """\
Lays the bags that agents on a network have made of their own flights on one time line, by the frames that they share,
and says what came of the flight: clocks, ages, errors, agreement, the closest pair; whether two spoke in one turn;
whether all decisions follow from what each agent heard, made again by the core. Exit code 1 if they do not, if the
agents did not hear each other, or if frames do not go both ways between groups of them: offsets of clocks are not
determined then. --out keeps the whole flight as one bag, which report, export, verify, replay and ros2
bag take like any other."""
EXAMPLES = (
    ("runs/cf1 runs/cf2 runs/cf3", "three agents' bags"),
    ("runs/cf* --json", "all of them, as JSON"),
    ("runs/cf* --out flight_1", "kept as one bag, for report, export and verify"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    parser.add_argument("bags", nargs="+", metavar="BAG", help="directory of `agent --out`, or its .mcap file")
    parser.add_argument(
        "--air-us", metavar="X", default="0", help="a frame is on the air for so long: count overlaps [0]"
    )
    parser.add_argument("--out", metavar="DIR", help="keep the whole flight there: bag, and result as summary.json")
    parser.add_argument("--json", action="store_true", help="print the result as JSON instead of lines")


def run(args: argparse.Namespace) -> int:
    """Merge, and print what came of it."""
    from dtsa_bench.log.agent_bag import read_all
    from dtsa_bench.log.merge.merge import Merge, clocks_apart, is_verified
    from dtsa_bench.runs.options import check_free, number

    out = Path(args.out) if args.out else None
    if out is not None:
        from dtsa_bench.log.merged_bag import write_merged

        check_free(out)
    air_ns = round(number(args.air_us, "air_us", 0, 1e6, "us") * 1e3)
    merged = Merge(*read_all(args.bags))
    summary = merged.summary(air_ns)
    if out is not None:
        write_merged(out, merged.log, summary)
    text = json.dumps(summary, indent=2) + "\n"
    print(text if args.json else "\n".join(lines(summary)) + "\n", end="")
    if summary["unheard"]:
        print(f"dtsa: {summary['unheard']}", file=sys.stderr)
    if merged.apart:
        print(f"dtsa: {clocks_apart(merged.apart)}", file=sys.stderr)
    for path in merged.nothing_written:
        print(f"dtsa: {path}: nothing was written there; left out", file=sys.stderr)
    return 0 if is_verified(summary) and not summary["unheard"] else 1


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
