"""`dtsa recover`: a full bag from a damaged one."""

from __future__ import annotations

import argparse
import dataclasses
import json

from .registry import RECORDED_RUN

DESCRIPTION = """\
Makes a full bag of what a killed recorder, a full disk or a damaged file left: all that can be read. It says what was
saved, and what is lost. The original is only read."""
EXAMPLES = (("runs/a", "into runs/a/bag_recovered"),)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    parser.add_argument("bag", help=RECORDED_RUN)
    parser.add_argument("--out", metavar="DIR", help="where to (default: <bag>_recovered beside the old one)")
    parser.add_argument("--json", action="store_true", help="print what was saved as JSON")


def run(args: argparse.Namespace) -> int:
    """Recover the bag."""
    from dtsa_bench.log.bag.recover import recover

    result = recover(args.bag, args.out)
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
        print(f"  the recording breaks off at {result.whole_ns / 1e9:.3f} s; `verify` checks it up to there")
    for note in result.damaged or ["the file was whole: nothing was lost"]:
        print(f"  {note}")
    return 0
