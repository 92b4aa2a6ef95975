"""`dtsa protocol`: the slot protocols alone, without flight."""

from __future__ import annotations

import argparse
from pathlib import Path

DESCRIPTION = """\
Runs the slot protocols without flight: ages, waking, joins, deaths, jams, partitions. Writes results.json and the
tables of docs/evidence/protocol.md, long.md and protocol.md. Interrupted, it goes on where it stopped
when the same command is given again."""
EXAMPLES = (
    ("", "all tables, into runs/protocol"),
    ("--seeds 3 --slots 6000", "fewer and shorter runs"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    parser.add_argument("--show", action="store_true", help="print what is run, as YAML")
    parser.add_argument("--out", metavar="DIR", help="directory for the results [runs/protocol]")
    parser.add_argument("--seeds", metavar="N", help="number of seeds [each row's own]")
    parser.add_argument("--first-seed", metavar="N", help="first of them [1]")
    parser.add_argument("--slots", metavar="N", help="length of the runs of the long table [each column's own]")
    parser.add_argument("--jobs", metavar="N", help="processes [all cores]")


def run(args: argparse.Namespace) -> int:
    """Run what is missing, then sum up."""
    from dtsa_bench.runs.options import whole_number
    from dtsa_dev.protocol import plan, table

    if args.show:
        print(plan.as_yaml(), end="")
        return 0

    def number(name: str, least: int, most: int) -> int | None:
        value = getattr(args, name)
        return None if value is None else whole_number(value, name.replace("_", "-"), least, most)

    first = number("first_seed", 0, 2**62)
    return table.run_table(
        Path(args.out) if args.out else Path("runs") / "protocol",
        number("seeds", 1, 1000),
        slots=number("slots", 4000, 10_000_000),
        jobs=number("jobs", 1, 1024),
        first_seed=plan.FIRST_SEED if first is None else first,
    )
