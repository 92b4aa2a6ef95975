"""`dtsa export`: tables of a recorded run."""

from __future__ import annotations

import argparse
import json
import sys

from .registry import RECORDED_RUN

TABLES = ("slots", "frames", "receptions", "decisions", "states", "ages", "ages_by_observer", "distances")
DESCRIPTION = """\
Writes a recorded run as tables for pandas and polars: slots, frames, who received them, decisions, states, ages and
errors (of each agent; of each agent in the eyes of each observer), one file each, and columns.md, which says what each
column holds and in which unit."""
EXAMPLES = (
    ("runs/a", "all tables as Parquet"),
    ("runs/a --to csv --tables slots frames --out tables", "two of them as CSV"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    parser.add_argument("bag", help=RECORDED_RUN)
    parser.add_argument("--to", default="parquet", metavar="FORMAT", help="parquet (default) or csv")
    parser.add_argument("--out", metavar="DIR", help="where to (default: <bag>_tables beside the bag)")
    parser.add_argument("--tables", nargs="+", metavar="TABLE", help=f"only these: {' '.join(TABLES)}")
    parser.add_argument("--json", action="store_true", help="print the files and their rows as JSON")


def run(args: argparse.Namespace) -> int:
    """Export the bag."""
    import pyarrow  # noqa: F401  # if it is missing, that is said before a bag is read

    from dtsa_bench.log.bag.metadata import bag_of
    from dtsa_bench.log.merged_bag import open_log
    from dtsa_bench.log.tables import export

    bag = bag_of(args.bag).resolve()
    target = args.out or bag.with_name(f"{bag.name if bag.is_dir() else bag.stem}_tables")
    written = export(
        lambda: open_log(args.bag), target, args.to, args.tables, lambda text: print(f"dtsa: {text}", file=sys.stderr)
    )
    if args.json:
        print(json.dumps([{"path": str(table.path), "rows": table.rows} for table in written], indent=2))
        return 0
    for table in written:
        print(f"{table.path}: {table.rows} rows")
    return 0
