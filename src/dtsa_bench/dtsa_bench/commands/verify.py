"""`dtsa verify`: is a recorded run what the protocol gives?"""

from __future__ import annotations

import argparse
import json
import sys

from .registry import RECORDED_RUN

DESCRIPTION = """\
Rebuilds every agent and the channel from the recorded configuration, feeds them what they heard, and compares
every message of the bag, byte by byte. Exit code 0: all equal; 1: a difference, which is shown."""
EXAMPLES = (
    ("runs/a", "one run"),
    ("runs/a runs/b --json", "several, as JSON"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    parser.add_argument("bag", nargs="+", help=RECORDED_RUN)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Verify the bags."""
    from dtsa_bench.log.verify.check import verify_bag

    live = sys.stderr.isatty()

    def progress(slot: int) -> None:
        sys.stderr.write(f"\rslot {slot}")
        sys.stderr.flush()

    results = []
    for path in args.bag:
        results.append(verify_bag(path, progress if live else None))
        if live:
            sys.stderr.write("\r\033[K")
        if not args.json:
            print(results[-1])
    if args.json:
        print(json.dumps([result.to_dict() for result in results], indent=2))
    return 0 if all(result.ok for result in results) else 1
