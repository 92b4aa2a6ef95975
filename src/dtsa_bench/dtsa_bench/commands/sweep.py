"""`dtsa sweep`: many simulated flights over a grid of settings, summed up in a report."""

from __future__ import annotations

import argparse
import os
import shlex
import signal
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dtsa_bench.sweep.journal import Journal
    from dtsa_bench.sweep.spec import Sweep

PROTOCOL = "protocol"  # a preset that flies nothing

DESCRIPTION = """\
Flies every combination of a sweep's axes with every seed, without ROS, on all cores or on a Dask cluster, and
writes results.csv, results.json, figures (PNG and SVG) and report.html. Interrupted, it goes on where it
stopped when the same
command is given again. Sweeps of your own: docs/bench.md."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register the command."""
    parser = subparsers.add_parser("sweep", help="many flights without ROS, and a report", description=DESCRIPTION)
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
    parser.add_argument("--cluster", metavar="tcp://HOST:PORT", help="fly on a Dask cluster with this scheduler")
    parser.add_argument("--no-report", action="store_true", help="only results.csv and results.json")


def run(args: argparse.Namespace) -> int:
    """Fly what is missing, then sum up."""
    from dtsa_bench.sweep import spec

    if args.list:
        for name in spec.preset_names():
            sweep = spec.load_preset(name)
            print(f"{name:14}{len(sweep.cells) * len(sweep.seeds):>6} flights  {sweep.title}")
        print(f"{PROTOCOL:14}     no flights  The slot protocols alone: ages, waking, joins, deaths, jams, partitions")
        return 0
    if args.preset == PROTOCOL:
        return _protocol(args)
    if args.show:
        spec.load_preset(args.show)
        print((spec.PRESETS / f"{args.show}.yaml").read_text(encoding="utf-8"), end="")
        return 0
    sweeps = _sweeps(args)
    base = Path(args.out) if args.out else Path("runs")
    code = 0
    for sweep in sweeps:
        directory = base if args.out and len(sweeps) == 1 else base / sweep.name
        code = max(code, _one(sweep, directory, args))
    return code


def _protocol(args: argparse.Namespace) -> int:
    """The table of the slot protocols: runs without flight, which have no axes and no report of their own."""
    from dtsa_agent.core.errors import ConfigError
    from dtsa_bench.options import whole_number
    from dtsa_bench.protocol_bench import table

    changed = _base(args.set)
    slots = changed.pop("slots", table.SLOTS)
    for name in changed:
        raise ConfigError(f"set {name}", changed[name], f"slots=NUMBER with --preset {PROTOCOL}")
    if args.cluster:
        raise ConfigError("cluster", args.cluster, f"nothing with --preset {PROTOCOL}: it runs on this machine")
    return table.run_table(
        Path(args.out) if args.out else Path("runs") / PROTOCOL,
        table.SEEDS if args.seeds is None else whole_number(args.seeds, "seeds", 1, 1000),
        slots=whole_number(str(slots), "slots", 4000, 10_000_000),
        jobs=None if args.jobs is None else whole_number(args.jobs, "jobs", 1, 1024),
        first_seed=table.FIRST_SEED
        if args.first_seed is None
        else whole_number(args.first_seed, "first-seed", 0, 2**62),
    )


def _sweeps(args: argparse.Namespace) -> list[Sweep]:
    from dtsa_agent.core.errors import ConfigError
    from dtsa_bench.options import whole_number
    from dtsa_bench.sweep import spec

    changes = {
        "seeds": None if args.seeds is None else whole_number(args.seeds, "seeds", 1, 1_000_000),
        "first_seed": None if args.first_seed is None else whole_number(args.first_seed, "first-seed", 0, 2**62),
        "base": _base(args.set),
    }
    if args.file:
        return [spec.load_file(args.file, **changes)]
    names = [name.strip() for name in args.preset.split(",")]
    for name in names:
        if name not in spec.preset_names():
            raise ConfigError("preset", name, ", ".join(spec.preset_names()) + f"; {PROTOCOL}, but alone")
    return [spec.load_preset(name, **changes) for name in names]


def _base(words: list[str]) -> dict[str, object]:
    import yaml

    from dtsa_agent.core.errors import ConfigError

    base = {}
    for word in words:
        name, sign, value = word.partition("=")
        if not sign:
            raise ConfigError("set", word, "NAME=VALUE")
        try:
            base[name.replace("-", "_")] = yaml.safe_load(value)
        except yaml.YAMLError:
            raise ConfigError("set", word, "NAME=VALUE with a plain value") from None
    return base


def _one(sweep: Sweep, directory: Path, args: argparse.Namespace) -> int:
    from dtsa_bench.options import whole_number
    from dtsa_bench.sweep.journal import Journal, collect, write_results
    from dtsa_bench.sweep.runner import fly_all
    from dtsa_bench.sweep.work import fingerprint

    jobs = len(os.sched_getaffinity(0)) if args.jobs is None else whole_number(args.jobs, "jobs", 1, 1024)
    begun = time.monotonic()
    journal = Journal(directory, sweep, fingerprint())
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        with Progress(journal) as progress:
            finished = fly_all(journal, jobs=jobs, cluster=args.cluster, progress=progress.advance)
    except KeyboardInterrupt:
        print(
            f"dtsa: interrupted; {len(journal.rows())} runs are saved in {directory}, "
            "the same command goes on from "
            "there",
            file=sys.stderr,
        )
        raise
    finally:
        journal.close()
        signal.signal(signal.SIGTERM, before)
    from dtsa_bench.sweep.aggregate import Table
    from dtsa_bench.sweep.text import claims_text, table_text

    rows = collect(sweep, finished)
    table = Table(sweep, rows)
    write_results(directory, sweep, rows, table.plain(), journal.code)
    flown = time.monotonic() - begun
    print(table_text(table))
    if claims := claims_text(table):
        print(f"\n{claims}\n")
    if not args.no_report:
        from dtsa_bench.sweep.report import write_report

        path = write_report(table, directory, journal.code, f"tools/dtsa {shlex.join(sys.argv[1:])}")
        print(f"report: {path}")
    print(f"{sweep.name}: {len(rows)} runs in {flown:.1f} s, {time.monotonic() - begun:.1f} s with the report")
    failed = sum(row["status"] == "failed" for row in rows)
    if failed:
        print(
            f"dtsa: {failed} runs failed: {next(row['reason'] for row in rows if row['status'] == 'failed')}",
            file=sys.stderr,
        )
    return 1 if failed else 0


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


class Progress:
    """Says on stderr how far a sweep is: a bar on a terminal, a line now and then elsewhere."""

    def __init__(self, journal: Journal) -> None:
        done = journal.rows()
        tasks = list(journal.sweep.tasks())
        self._name = journal.sweep.name
        self._total = len(tasks)
        self._done = sum(task.key in done for task in tasks)
        self._cost_left = sum(task.cost for task in tasks if task.key not in done)
        self._cost_done = 0.0
        self._begun = self._said = time.monotonic()
        if journal.put_aside:
            print(
                f"{self._name}: {journal.put_aside} runs of other code are put aside and flown again",
                file=sys.stderr,
            )
        if self._done:
            print(f"{self._name}: {self._done} of {self._total} runs are there already", file=sys.stderr)
        self._bar = _bar(self._name, self._total, self._done) if sys.stderr.isatty() else None

    def __enter__(self) -> Progress:
        if self._bar is not None:
            self._bar[0].start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar[0].stop()

    def left_s(self) -> float:
        """Estimated time left, s, from the cost of the runs done and to do."""
        if not self._cost_done:
            return float("nan")
        return (time.monotonic() - self._begun) / self._cost_done * max(0.0, self._cost_left - self._cost_done)

    def advance(self, runs: int, cost: float) -> None:
        """Takes note of finished runs."""
        self._done += runs
        self._cost_done += cost
        left = self.left_s()
        if self._bar is not None:
            bar, task = self._bar
            bar.update(task, completed=self._done, left=f"{left:.0f} s left")
        elif time.monotonic() - self._said > 10.0:
            self._said = time.monotonic()
            print(f"{self._name}: {self._done} of {self._total} runs, about {left:.0f} s left", file=sys.stderr)


# type: ignore[no-untyped-def]  # rich is imported on terminals alone
def _bar(name: str, total: int, done: int):
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
    from rich.progress import Progress as Bar

    bar = Bar(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[left]}"),
        console=Console(stderr=True),
        transient=True,
    )
    return bar, bar.add_task(name, total=total, completed=done, left="")
