"""`dtsa verify`: is a recorded run what the protocol gives?"""

from __future__ import annotations

import argparse
import json
import sys

from .registry import RECORDED_RUN

DESCRIPTION = """\
Rebuilds every agent and the channel from the recorded configuration, feeds them what they heard, and compares
every message of the bag, byte by byte. Exit code 0: all equal; 1: a difference, which is shown."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register the command."""
    parser = subparsers.add_parser(
        "verify",
        help="check a bag: was every decision what the protocol says?",
        description=DESCRIPTION,
    )
    parser.add_argument("bag", nargs="+", help=RECORDED_RUN)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Verify the bags."""
    from dtsa_bench.recordings.verify import verify_bag

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
            _print(results[-1])
    if args.json:
        print(json.dumps([result.to_dict() for result in results], indent=2))
    return 0 if all(result.ok for result in results) else 1


def _print(result: object) -> None:
    from dtsa_bench.recordings.verify import Result

    assert isinstance(result, Result)
    pace = result.simulated_s / result.wall_time_s if result.wall_time_s else 0.0
    verdict = "everything is what the protocol gives" if result.ok else "NOT what the protocol gives"
    end = f", up to slot {result.slots - 1}, where the recording breaks off" if result.broken_off and result.ok else ""
    print(f"{result.bag}: {verdict}{end}")
    took = f"{result.simulated_s:.2f} s in {result.wall_time_s:.2f} s ({pace:.0f} x)"
    print(f"  {result.mode}, {result.slots} slots, {took}")
    if result.checked:
        print("  equal: " + ", ".join(f"{count} {what}" for what, count in result.checked.items()))
    for what, why in result.skipped.items():
        print(f"  not checked: {what}: {why}")
    for what, value in result.safety.items():
        print(f"  {what.replace('_', ' ')}: {value if not isinstance(value, float) else format(value, '.3f')}")
    if result.unheard:
        print(f"  {result.unheard}")
    if result.difference:
        print(f"  first difference: {result.difference}")
