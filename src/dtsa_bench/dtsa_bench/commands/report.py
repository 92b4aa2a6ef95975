"""`dtsa report`: one HTML page about recorded runs."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from .registry import RECORDED_RUN

DESCRIPTION = """\
Writes one self-contained HTML page about one recorded run, or several side by side: the flight in 3D, the slots,
distances, ages, estimate errors, channel use, decisions and the configuration. It opens without a network, and
prints."""
EXAMPLES = (
    ("runs/a", "one run"),
    ("runs/a runs/b --out compared.html", "two side by side"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    parser.add_argument("bags", nargs="+", metavar="BAG", help=f"{RECORDED_RUN}; up to 8")
    parser.add_argument("--out", metavar="FILE", help="the page (default: report.html beside the first bag)")


def run(args: argparse.Namespace) -> int:
    """Write the report."""
    from dtsa_bench.log.bag.metadata import bag_of
    from dtsa_bench.pages.report.data import write_report

    first = bag_of(args.bags[0]).resolve()
    out = Path(args.out) if args.out else first.parent / "report.html"

    def progress(bag: str) -> None:
        if sys.stderr.isatty():
            print(f"reading {bag}", file=sys.stderr, flush=True)

    path = write_report(args.bags, out, progress)
    print(f"{path} ({path.stat().st_size / 1e6:.1f} MB): open it in any browser")
    return 0
