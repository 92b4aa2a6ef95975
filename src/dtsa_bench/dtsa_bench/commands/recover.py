"""`dtsa recover`: a full bag from a damaged one."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys

from .registry import RECORDED_RUN

DESCRIPTION = """\
Makes a full bag of what a killed recorder, a full disk or a damaged file left, and says what was saved.
The original is only read."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register the command."""
    parser = subparsers.add_parser("recover", help="make a full bag of a damaged one", description=DESCRIPTION)
    parser.add_argument("bag", help=RECORDED_RUN)
    parser.add_argument("--out", metavar="DIR", help="where to (default: <bag>_recovered beside the old one)")
    parser.add_argument(
        "--keep-damaged",
        action="store_true",
        help="keep what can be read of chunks with a wrong checksum, too",
    )
    parser.add_argument("--json", action="store_true", help="print what was saved as JSON")


def run(args: argparse.Namespace) -> int:
    """Recover the bag."""
    from dtsa_bench.recordings.bag.recover import recover

    def progress(count: int) -> None:
        sys.stderr.write(f"\r{count} messages")
        sys.stderr.flush()

    live = sys.stderr.isatty()
    result = recover(args.bag, args.out, args.keep_damaged, progress if live else None)
    if live:
        sys.stderr.write("\r")
    if args.json:
        print(json.dumps(dataclasses.asdict(result), indent=2, default=str))
        return 0
    width = max(len(topic) for topic in result.saved)
    for topic, count in result.saved.items():
        expected = result.expected.get(topic, count)
        missing = f"  ({expected - count} missing)" if expected > count else ""
        print(f"{topic:{width}}  {count:>9}{missing}")
    seconds = (result.end_ns - result.start_ns) / 1e9
    print(f"saved {result.count} messages, {seconds:.3f} s of simulated time, to {result.directory}")
    if not result.closed:
        print(f"  the recording breaks off at {result.end_ns / 1e9:.3f} s; `verify` checks it up to there")
    for note in result.damaged or ["the file was whole: nothing was lost"]:
        print(f"  {note}")
    return 0
