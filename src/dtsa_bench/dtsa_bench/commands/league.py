"""`dtsa league` and `dtsa new-plugin`: frozen cells that any policy flies, and a policy of your own to begin with."""

from __future__ import annotations

import argparse
import importlib
import json
import secrets
import shlex
import sys
from pathlib import Path

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.experiments.batch import run_in
from dtsa_bench.experiments.league import (
    HEADS,
    STAR,
    League,
    LeagueTable,
    batch_of,
    check_entry,
    flight_of,
    league,
    make_entry,
    read_entries,
    write_entries,
)
from dtsa_bench.experiments.tables import aligned
from dtsa_bench.runs.options import named_values, processes, whole_number
from dtsa_bench.runs.program import program

from .registry import Command, add_rows, warn

SAMPLE = 24  # flights of an entry that `check` flies again
_SHOWN = 10  # differences that are named; the others are counted


class LeagueCommand(Command):
    description = """\
`cells` lists what is flown, and the schemes that come with this program. `enter POLICY` flies one of them, or a
plug-in, through all cells and writes an entry. `check FILE` flies a sample of the flights of its entries again and says
what differs. `table FILE...` compares entries. How to enter: docs/how-to/sweep.md."""
    examples = (
        ("cells", "what is flown, and the schemes that come with the package"),
        ("enter lease --sample 2", "two seeds of each cell, to try it out"),
        ("enter my-policy --path runs/plug-ins", "a plug-in that was installed into a directory, all cells"),
        ("check docs/evidence/league-1.json lease", "flies a sample of its flights again"),
        ("table runs/league-1/lease runs/league-1/tdma --out runs/table", "a table and a page"),
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
        actions.add_parser("cells", help="list what is flown")
        enter = actions.add_parser("enter", help="fly a policy through all cells")
        add_rows(enter, (
            ("policy POLICY", "a scheme of `league cells`, or a policy by its name"),
            ("--name NAME", "name of the entry [the scheme's]"),
            ("--set NAME=VALUE", "a setting of the policy, or frame=extended", {"action": "append"}),
            ("--cells NAME[,NAME...]", "these alone; the entry is incomplete"),
            ("--sample N", "so many seeds of each cell; the entry is incomplete"),
            ("--cluster tcp://HOST:PORT", "fly on a Dask cluster with this scheduler"),
            ("--out DIR", "directory for entry.json [runs/league-1/NAME]"),
        ))  # fmt: skip
        check = actions.add_parser("check", help="fly a sample of entries again")
        add_rows(check, (
            ("file FILE", "file of entries, or directory that `enter` wrote"),
            ("names NAME*", "which of its entries [all]"),
            ("--sample N", f"so many flights of each [{SAMPLE}]", {"default": str(SAMPLE)}),
            ("--all", "all flights"),
            ("--seed N", "which flights are flown again [at random]"),
        ))  # fmt: skip
        for action in (enter, check):
            action.add_argument("--path", metavar="DIR", help="where Python also looks for installed plug-ins")
            action.add_argument("--jobs", metavar="N", help="processes [all cores]")
        table = actions.add_parser("table", help="compare entries")
        add_rows(table, (
            ("files FILE...", "files of entries, or directories that `enter` wrote"),
            ("--out DIR", "directory for the page and its figure [runs/league-1/table]"),
            ("--json", "print the table as JSON"),
        ))  # fmt: skip

    def run(self, args: argparse.Namespace) -> int:
        """Do one of the actions."""
        if getattr(args, "path", None):
            sys.path.insert(0, str(Path(args.path).resolve()))
            importlib.invalidate_caches()
        return {"cells": _cells, "enter": _enter, "check": _check, "table": _table}[args.action](args, league())


def _cells(args: argparse.Namespace, the_league: League) -> int:
    print(aligned([["cell", "meaning"], *([name, cell["text"]] for name, cell in the_league.cells.items())]))
    print(f"\n{the_league.seed_count} seeds each\nschemes: {', '.join(the_league.entrants)}")
    return 0


def _enter(args: argparse.Namespace, the_league: League) -> int:
    cells = list(the_league.cells)
    if args.cells is not None:
        chosen = [name.strip() for name in args.cells.split(",")]
        if unknown := next((name for name in chosen if name not in cells), None):
            raise ConfigError("cells", unknown, ", ".join(cells))
        cells = [name for name in cells if name in chosen]
    most = the_league.seed_count
    count = most if args.sample is None else whole_number(args.sample, "sample", 1, most)
    entry = make_entry(the_league, args.policy, args.name, named_values(args.set or []))
    wanted = [(cell, k) for cell in cells for k in range(count)]
    batch = batch_of(the_league, entry, wanted)
    directory = Path(args.out or Path("runs") / the_league.name / entry["name"])
    rows = run_in(directory, batch, jobs=processes(args.jobs), cluster=args.cluster)
    for (cell, _), task in zip(wanted, batch.tasks, strict=True):
        entry["flights"].setdefault(cell, []).append(flight_of(rows[task.key]))
    write_entries(directory / "entry.json", the_league, [entry])
    table = LeagueTable(the_league, [entry])
    print(aligned([["cell", "age, ms"], *zip(table.cells, table.cell_lines()[0][1:], strict=True)]))
    print(f"\n{aligned([HEADS[1:], table.lines('-')[0][1:]])}")
    print(f"entry: {directory / 'entry.json'}" + ("" if table.complete else " (incomplete)"))
    reasons = [rows[task.key]["reason"] for task in batch.tasks if rows[task.key]["reason"]]
    if reasons:
        warn(f"{len(reasons)} flights could not be flown: {reasons[0]}")
    return 1 if reasons else 0


def _check(args: argparse.Namespace, the_league: League) -> int:
    entries = {entry["name"]: entry for entry in read_entries(args.file)}
    if unknown := next((name for name in args.names if name not in entries), None):
        raise ConfigError("NAME", unknown, ", ".join(entries))
    sample = None if args.all else whole_number(args.sample, "sample", 1, 1_000_000)
    seed = secrets.randbits(31) if args.seed is None else whole_number(args.seed, "seed", 0, 2**62)
    wrong = 0
    for name in args.names or entries:
        entry = entries[name]
        try:
            flown, differences = check_entry(the_league, entry, sample=sample, seed=seed, jobs=processes(args.jobs))
        except ConfigError as error:
            print(f"{name}: not checked: {error}")
            wrong += 1
            continue
        for difference in differences[:_SHOWN]:
            print(f"differs: {difference}")
        flights = sum(map(len, entry["flights"].values()))
        how = "" if flown == flights else f" (--seed {seed})"
        print(f"{name}: {flown} of {flights} flights flown again{how}; {len(differences)} differences", flush=True)
        wrong += bool(differences)
    return 1 if wrong else 0


def _table(args: argparse.Namespace, the_league: League) -> int:
    table = LeagueTable(the_league, [entry for path in args.files for entry in read_entries(path)])
    from dtsa_bench.pages.report.tables import write_league

    directory = Path(args.out or Path("runs") / the_league.name / "table")
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError("out", str(directory), f"a directory that can be made ({error.strerror})") from error
    page = write_league(table, directory, f"{program()} {shlex.join(sys.argv[1:])}")
    if args.json:
        print(json.dumps([dict(zip(HEADS, line, strict=True)) for line in table.lines("-")], indent=1))
    else:
        print(f"{aligned([HEADS, *table.lines('-')])}\n{STAR}")
        print(f"table: {page}")
    return 0


class NewPluginCommand(Command):
    description = """\
Writes a package with a policy of your own that works: the policy, a test, a sweep that sets it against the league's
best and the bound, and the lines that install and run it. Input and output of a
policy: docs/reference/plug-ins.md."""
    examples = (("my-policy --out plugins/my-policy", "then as its README.md says"),)
    options = (
        ("name NAME", "what the policy will be called, as in my-policy"),
        ("--out DIR", "where the package goes (default: a directory of that name here)"),
    )  # fmt: skip

    def run(self, args: argparse.Namespace) -> int:
        """Write the package."""
        from dtsa_bench.experiments.plugin_template import write_package

        for path in write_package(args.name, Path(args.out or args.name)):
            print(path)
        return 0
