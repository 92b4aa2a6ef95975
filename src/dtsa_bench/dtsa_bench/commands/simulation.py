"""`dtsa simulate` and `dtsa sweep`: flights without ROS, the same bit for bit as `dtsa fly` in lockstep."""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from dtsa_bench.runs.program import program

from .registry import Command, add_rows, warn

if TYPE_CHECKING:
    from dtsa_bench.experiments.sweep import Sweep


class SimulateCommand(Command):
    description = """\
Flies one run without ROS, as fast as this machine allows, over the same core as the nodes. For equal options
and seed every slot has the same sender and every quadcopter the same positions as with `fly`, bit for bit."""
    examples = (
        ("--agents 18 --policy dtsa --loss 0.01", "one flight, its results as lines"),
        ("--moving 2 --policy lease --json", "the same as JSON"),
        ("--agents 12 --picture flight.png", "with a picture of the paths"),
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        from dtsa_bench.runs.options import add_run_options

        parser.usage = "%(prog)s [OPTIONS]"
        add_rows(parser, (
            ("--out DIR", "directory for summary.json and config.json; default: only printed"),
            ("--json", "print summary.json instead of lines"),
            ("--picture FILE.png", "draw the paths from above"),
        ))  # fmt: skip
        add_run_options(parser)

    def run(self, args: argparse.Namespace) -> int:
        """Fly and print what came of it."""
        from dtsa_agent.core import ConfigError, make_scenario
        from dtsa_agent.keys import check_key
        from dtsa_bench.runs.options import new_directory, run_config
        from dtsa_bench.runs.summary_text import describe
        from dtsa_bench.simulation.simulate import simulate

        config = run_config(args)
        check_key(config.swarm)  # before anything is made
        make_scenario(config.swarm)
        picture = None if args.picture is None else Path(args.picture)
        if picture and (picture.suffix.lower() != ".png" or picture.is_dir() or not picture.parent.is_dir()):
            raise ConfigError("picture", args.picture, "a file *.png in a directory that exists")
        directory = None if args.out is None else new_directory(args.out)
        flight = simulate(config, log=picture is not None)
        summary = flight.summary()
        text = json.dumps(summary, indent=2) + "\n"
        try:
            if directory is not None:
                settings = json.dumps(config.to_dict(), indent=2) + "\n"
                for name, content in (("summary.json", text), ("config.json", settings)):
                    (directory / name).write_text(content, encoding="utf-8")
        finally:  # also on a full disk
            print(text if args.json else describe(summary), end="", flush=True)
        if picture is not None and flight.log is not None:
            from dtsa_bench.drawing import optional_picture

            with optional_picture(picture) as part:
                from dtsa_bench.drawing.flight_paths import draw_flight

                draw_flight(part, flight.scenario, flight.log.positions(), summary)
                print(f"picture: {picture}", file=sys.stderr)
        return 0


class SweepCommand(Command):
    description = """\
Flies every combination of a sweep's axes with every seed, without ROS, on all cores or on a Dask cluster, and
writes results.csv, results.json, figures (PNG and SVG) and report.html. Interrupted, it goes on where it
stopped when the same command is given again. Sweeps of your own: docs/how-to/sweep.md."""
    examples = (
        ("--list", "what comes with the package"),
        ("--preset paper-12,paper-18 --seeds 30", "the paper's experiments"),
        ("--preset loss --set slot_ms=20 --out runs/slow", "with a setting changed"),
        ("--file own.yaml --json", "a sweep of your own, its groups as JSON"),
        ("--preset loss --paper pdf", "with figures and tables for a paper"),
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        what = parser.add_mutually_exclusive_group(required=True)
        add_rows(what, (
            ("--preset NAME[,NAME...]", "sweeps that come with the package; see --list"),
            ("--file FILE", "a sweep of your own, in YAML"),
            ("--list", "list the presets"),
            ("--show NAME", "print a preset's YAML, to start a sweep of your own from"),
        ))  # fmt: skip
        add_rows(parser, (
            ("--out DIR", "directory for the results [runs/NAME]; several presets: one each in it"),
            ("--seeds N", "number of seeds [the sweep's own]"),
            ("--first-seed N", "first of them [1001]"),
            ("--jobs N", "processes [all cores]"),
            ("--set NAME=VALUE", "change a setting of the base", {"action": "append", "default": []}),
            ("--losses FILE", "fly in losses that were measured, as simulate --losses does"),
            ("--cluster tcp://HOST:PORT", "fly on a Dask cluster with this scheduler"),
            ("--no-report", "only results.csv and results.json"),
            ("--paper FORMAT", "also write DIR/paper: figures (pdf, svg or png), table.tex and table.csv, which say "
             "how"),
            ("--json", "print the contents of results.json instead of tables"),
        ))  # fmt: skip

    def run(self, args: argparse.Namespace) -> int:
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
            code = max(code, _fly_sweep(sweep, directory, args))
        return code


def _sweeps(args: argparse.Namespace) -> list[Sweep]:
    from dtsa_bench.experiments import sweep as spec
    from dtsa_bench.runs.options import named_values, whole_number

    changes = {
        "seeds": None if args.seeds is None else whole_number(args.seeds, "seeds", 1, 1_000_000),
        "first_seed": None if args.first_seed is None else whole_number(args.first_seed, "first-seed", 0, 2**62),
        "base": named_values(args.set) | ({"losses": args.losses} if args.losses else {}),
    }
    if args.file:
        return [spec.load_file(args.file, **changes)]
    return [spec.load_preset(name.strip(), **changes) for name in args.preset.split(",")]


def _fly_sweep(sweep: Sweep, directory: Path, args: argparse.Namespace) -> int:
    from dtsa_bench.experiments.batch import FAILED, run_in
    from dtsa_bench.experiments.provenance import code_digest
    from dtsa_bench.experiments.tables import SweepTable, table_text, write_results
    from dtsa_bench.runs.options import processes

    start, code, report = time.monotonic(), code_digest(sweep.batch.plug_ins), (lambda _: None) if args.json else print
    table = SweepTable(sweep, run_in(directory, sweep.batch, jobs=processes(args.jobs), cluster=args.cluster))
    write_results(directory, table, code)
    flown = time.monotonic() - start
    command = f"{program()} {shlex.join(sys.argv[1:])}"
    report(table_text(table, shutil.get_terminal_size((0, 0)).columns))
    if args.paper:
        from dtsa_bench.experiments.paper import write_paper

        files = write_paper(table, directory / "paper", args.paper, code, command)
        report(f"paper: {directory / 'paper'}: {', '.join(files)}")
    if not args.no_report:
        from dtsa_bench.pages.report.tables import write_report

        report(f"report: {write_report(table, directory, code, command)}")
    seconds = f"{flown:.1f} s, {time.monotonic() - start:.1f} s with the report"
    report(f"{sweep.name}: {len(table.rows)} runs in {seconds}")
    if args.json:
        print((directory / "results.json").read_text(encoding="utf-8"), end="")
    reasons = [row["reason"] for row in table.rows if row["status"] == FAILED]
    if reasons:
        warn(f"{len(reasons)} runs failed: {reasons[0]}")
    return 1 if reasons else 0
