"""`dtsa sweep`: many simulated flights over a grid of settings, summed up in a report."""

from __future__ import annotations

import argparse
import shlex
import shutil
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from dtsa_bench.runs.program import program

if TYPE_CHECKING:
    from dtsa_bench.experiments.sweep import Sweep

DESCRIPTION = """\
Flies every combination of a sweep's axes with every seed, without ROS, on all cores or on a Dask cluster, and
writes results.csv, results.json, figures (PNG and SVG) and report.html. Interrupted, it goes on where it
stopped when the same command is given again. Sweeps of your own: docs/how-to/sweep.md."""
EXAMPLES = (
    ("--list", "what comes with the package"),
    ("--preset paper-12,paper-18 --seeds 30", "the paper's experiments"),
    ("--preset loss --set slot_ms=20 --out runs/slow", "with a setting changed"),
    ("--file own.yaml --json", "a sweep of your own, its groups as JSON"),
    ("--preset loss --paper pdf", "with figures and tables for a paper"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--preset", metavar="NAME[,NAME...]", help="sweeps that come with the package; see --list")
    what.add_argument("--file", metavar="FILE", help="a sweep of your own, in YAML")
    what.add_argument("--list", action="store_true", help="list the presets")
    what.add_argument("--show", metavar="NAME", help="print a preset's YAML, to start a sweep of your own from")
    parser.add_argument(
        "--out", metavar="DIR", help="directory for the results [runs/NAME]; several presets: one each in it"
    )
    parser.add_argument("--seeds", metavar="N", help="number of seeds [the sweep's own]")
    parser.add_argument("--first-seed", metavar="N", help="first of them [1001]")
    parser.add_argument("--jobs", metavar="N", help="processes [all cores]")
    parser.add_argument("--set", metavar="NAME=VALUE", action="append", default=[], help="change a setting of the base")
    parser.add_argument("--losses", metavar="FILE", help="fly in losses that were measured, as simulate --losses does")
    parser.add_argument("--cluster", metavar="tcp://HOST:PORT", help="fly on a Dask cluster with this scheduler")
    parser.add_argument("--no-report", action="store_true", help="only results.csv and results.json")
    parser.add_argument(
        "--paper", metavar="FORMAT",
        help="also write DIR/paper: figures (pdf, svg or png), table.tex and table.csv, which say how they were made",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print the contents of results.json instead of tables")


def run(args: argparse.Namespace) -> int:
    """Fly what is missing, then sum up."""
    from dtsa_agent.core.errors import ConfigError
    from dtsa_bench.experiments import sweep as spec

    if args.list:
        for name in spec.preset_names():
            sweep = spec.load_preset(name)
            print(f"{name:14}{len(sweep.cells) * len(sweep.seeds):>6} flights  {sweep.title}")
        return 0
    if args.show:
        if args.show not in spec.preset_names():
            raise ConfigError("show", args.show, ", ".join(spec.preset_names()))
        print((spec.PRESETS / f"{args.show}.yaml").read_text(encoding="utf-8"), end="")
        return 0
    if args.json and args.preset and "," in args.preset:
        raise ConfigError("json", args.preset, "one preset at a time: what is printed is one JSON document")
    if args.paper:
        from dtsa_bench.experiments.paper import check_format

        check_format(args.paper)
    sweeps = _sweeps(args)
    base = Path(args.out) if args.out else Path("runs")
    code = 0
    for sweep in sweeps:
        directory = base if args.out and len(sweeps) == 1 else base / sweep.name
        code = max(code, _one(sweep, directory, args))
    return code


def _sweeps(args: argparse.Namespace) -> list[Sweep]:
    from dtsa_agent.core.errors import ConfigError
    from dtsa_bench.experiments import sweep as spec
    from dtsa_bench.runs.options import named_values, whole_number

    changes = {
        "seeds": None if args.seeds is None else whole_number(args.seeds, "seeds", 1, 1_000_000),
        "first_seed": None if args.first_seed is None else whole_number(args.first_seed, "first-seed", 0, 2**62),
        "base": named_values(args.set) | ({"losses": args.losses} if args.losses else {}),
    }
    if args.file:
        return [spec.load_file(args.file, **changes)]
    names = [name.strip() for name in args.preset.split(",")]
    for name in names:
        if name not in spec.preset_names():
            raise ConfigError("preset", name, ", ".join(spec.preset_names()))
    return [spec.load_preset(name, **changes) for name in names]


def _one(sweep: Sweep, directory: Path, args: argparse.Namespace) -> int:
    from dtsa_bench.experiments.batch import FAILED, run_in
    from dtsa_bench.experiments.provenance import code_digest
    from dtsa_bench.experiments.tables import SweepTable, table_text, write_results
    from dtsa_bench.runs.options import processes

    begun, code, say = time.monotonic(), code_digest(sweep.batch.plug_ins), (lambda _: None) if args.json else print
    table = SweepTable(sweep, run_in(directory, sweep.batch, jobs=processes(args.jobs), cluster=args.cluster))
    write_results(directory, table, code)
    flown = time.monotonic() - begun
    command = f"{program()} {shlex.join(sys.argv[1:])}"
    say(table_text(table, shutil.get_terminal_size((0, 0)).columns))
    if args.paper:
        from dtsa_bench.experiments.paper import write_paper

        files = write_paper(table, directory / "paper", args.paper, code, command)
        say(f"paper: {directory / 'paper'}: {', '.join(files)}")
    if not args.no_report:
        from dtsa_bench.pages.report.tables import write_report

        say(f"report: {write_report(table, directory, code, command)}")
    seconds = f"{flown:.1f} s, {time.monotonic() - begun:.1f} s with the report"
    say(f"{sweep.name}: {len(table.rows)} runs in {seconds}")
    if args.json:
        print((directory / "results.json").read_text(encoding="utf-8"), end="")
    reasons = [row["reason"] for row in table.rows if row["status"] == FAILED]
    if reasons:
        print(f"dtsa: {len(reasons)} runs failed: {reasons[0]}", file=sys.stderr)
    return 1 if reasons else 0
