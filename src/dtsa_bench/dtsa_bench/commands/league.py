"""`dtsa league`: frozen cells that any policy flies, entries that anybody can check, and the table of all."""

from __future__ import annotations

import argparse
import json
import secrets
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dtsa_bench.runs.program import program

if TYPE_CHECKING:
    from dtsa_bench.experiments.league.cells import League
    from dtsa_bench.experiments.league.entrant import Entrant

DESCRIPTION = """\
`enter PACKAGE` flies a policy through all cells of the league and writes an entry. PACKAGE is a scheme that comes with
this program, a policy or distribution that is installed, or a folder or wheel with one. `check ENTRY` flies a sample of
its flights again and says what differs. `table ENTRY...` compares entries: a page, figures, CSV and LaTeX. `cells`
lists what is flown, and the schemes that come with this program. What an entry is: docs/how-to/league.md."""
EXAMPLES = (
    ("cells", "what is flown, and the schemes that come with the package"),
    ("enter lease --sample 2", "two practice seeds of each cell, to try it out"),
    ("enter examples/dtsa_plugins --jobs 2", "the policy of a folder, all cells"),
    ("check runs/league-1/lease", "flies a sample of its flights again"),
    ("table runs/league-1/lease runs/league-1/tdma --out runs/table", "a page, figures, CSV and LaTeX"),
)

SAMPLE = 24  # flights that `check` flies again
_OPTIONS = {
    "enter": ("name", "policy", "set", "cells", "sample", "secret", "judged", "out", "jobs", "cluster", "json"),
    "check": ("sample", "all", "seed", "secret", "package", "jobs"),
    "table": ("out", "json"),
    "cells": (),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    parser.add_argument("action", choices=tuple(_OPTIONS), help="what is to be done")
    parser.add_argument(
        "what", nargs="*", metavar="PACKAGE|ENTRY", help="who enters; the file or directory of an entry"
    )
    enter = parser.add_argument_group("enter")
    enter.add_argument("--name", metavar="NAME", help="name of the entry [the scheme's]")
    enter.add_argument("--policy", metavar="NAME", help="which policy, of a package with several")
    enter.add_argument(
        "--set", metavar="NAME=VALUE", action="append", help="a setting of the policy, or frame=extended"
    )
    enter.add_argument("--cells", metavar="NAME[,NAME...]", help="these alone; the entry is incomplete")
    enter.add_argument(
        "--judged", action="store_true", default=None, help="the judged seeds, after their word is published"
    )
    enter.add_argument("--cluster", metavar="tcp://HOST:PORT", help="fly on a Dask cluster with this scheduler")
    both = parser.add_argument_group("enter and check")
    both.add_argument("--secret", metavar="FILE", help="the word of the judged seeds [practice; check: as published]")
    both.add_argument(
        "--sample", metavar="N", help=f"enter: so many seeds of each cell; check: so many flights again [{SAMPLE}]"
    )
    both.add_argument("--jobs", metavar="N", help="processes [all cores]")
    check = parser.add_argument_group("check")
    check.add_argument("--all", action="store_true", default=None, help="fly all flights again")
    check.add_argument("--seed", metavar="N", help="which flights are flown again [at random]")
    check.add_argument("--package", metavar="PATH", help="folder or wheel of the policy, if it is not installed")
    out = parser.add_argument_group("enter and table")
    out.add_argument(
        "--out", metavar="DIR", help="directory for what is written [runs/league-1/NAME, runs/league-1/table]"
    )
    out.add_argument("--json", action="store_true", default=None, help="print the scores as JSON instead of a table")


def run(args: argparse.Namespace) -> int:
    """Do one of the actions."""
    from dtsa_agent.core.errors import ConfigError
    from dtsa_bench.experiments.league.cells import league

    known = {name for names in _OPTIONS.values() for name in names}
    wrong = next((n for n in sorted(known) if getattr(args, n) is not None and n not in _OPTIONS[args.action]), None)
    if wrong is not None:
        allowed = ", ".join(f"--{name}" for name in _OPTIONS[args.action]) or "no options"
        raise ConfigError(wrong, getattr(args, wrong), f"with {args.action}: {allowed}")
    wanted = {"cells": "nothing", "table": "one entry or more"}.get(args.action, "one")
    if len(args.what) != 1 if wanted == "one" else bool(args.what) == (wanted == "nothing"):
        raise ConfigError(args.action, " ".join(args.what), f"{wanted} after it")
    actions = {"enter": _enter, "check": _check, "table": _table, "cells": _cells}
    return actions[args.action](args, league())


def _enter(args: argparse.Namespace, there: League) -> int:
    from dtsa_agent.core.errors import ConfigError
    from dtsa_bench.experiments.batch.progress import run_batch
    from dtsa_bench.experiments.league.cells import JUDGED, PRACTICE
    from dtsa_bench.experiments.league.entrant import entrant_of
    from dtsa_bench.experiments.league.entry import make_entry, write_entry
    from dtsa_bench.experiments.league.flight import check_golden
    from dtsa_bench.experiments.league.plan import EntryPlan, flights_of, work_of
    from dtsa_bench.runs.options import named_values, processes, whole_number

    word = _word(args, there)
    if args.judged:
        word = there.published()
        if word is None:
            raise ConfigError("judged", True, "after the secret has been published")
    chosen = [cell.name for cell in there.cells]
    if args.cells is not None:
        named = [there.cell(name.strip()).name for name in args.cells.split(",")]
        chosen = [name for name in chosen if name in named]
    count = there.count if args.sample is None else whole_number(args.sample, "sample", 1, there.count)
    jobs = processes(args.jobs)
    room = Path(args.out or Path("runs") / there.name) / "package"
    entrant = entrant_of(args.what[0], args.name, args.policy, named_values(args.set or []), room)
    check_golden(there)
    flights = flights_of(there, word or there.practice, chosen, count)
    plan, work = EntryPlan(there, entrant.name, entrant.scheme, flights), work_of(entrant.scheme["policy"])
    directory = Path(args.out) if args.out else Path("runs") / there.name / entrant.name
    rows = run_batch(plan, work, directory, jobs=jobs, cluster=args.cluster)
    done = [rows[plan.key(wanted)] for wanted in flights]
    entry = make_entry(there, entrant, flights, done, JUDGED if word else PRACTICE, work.code())
    path = directory / "entry.json"
    write_entry(path, entry)
    return _say(args, there, entry, entrant, path)


def _say(args: argparse.Namespace, there: League, entry: dict[str, Any], entrant: Entrant, path: Path) -> int:
    """Prints what has come of an entry."""
    from dtsa_bench.experiments.batch.table import aligned
    from dtsa_bench.experiments.league.table import figure, percent_text

    summary = entry["summary"]
    if args.json:
        print(json.dumps(summary, indent=1))
    else:
        lines = [["cell", "lost", "age ms", "on the air", "what it is"]]
        for name, cell in summary["cells"].items():
            air = percent_text(cell["air"])
            lines.append(
                [name, f"{cell['lost']}/{cell['flights']}", figure(cell["age_ms"]), air, there.cell(name).text]
            )
        total = f"{summary['lost']}/{summary['flights']}"
        lines.append(["all", total, figure(summary["age_ms"]), percent_text(summary["air"]), ""])
        print(aligned(lines))
        part = "complete" if entry["complete"] else "incomplete: for trying out"
        print(f"{entrant.name}: {part}, {entry['seeds']} seeds: {path}")
    if not summary["failed"]:
        return 0
    reasons = [line[-1] for lines in entry["flights"].values() for line in lines if line[-1]]
    print(f"dtsa: {summary['failed']} flights could not be flown: {reasons[0]}", file=sys.stderr)
    return 1


def _check(args: argparse.Namespace, there: League) -> int:
    from dtsa_agent.core.errors import ConfigError
    from dtsa_bench.experiments.league.check import SHOWN, check_entry, found_share
    from dtsa_bench.experiments.league.entrant import install
    from dtsa_bench.experiments.league.entry import read_entry
    from dtsa_bench.runs.options import processes, whole_number

    if args.all and args.sample is not None:
        raise ConfigError("sample", args.sample, "without --all")
    entry = read_entry(args.what[0])
    word = _word(args, there) or there.published() if entry["seeds"] == "judged" else there.practice
    sample = None if args.all else whole_number(args.sample or str(SAMPLE), "sample", 0, 1_000_000)
    seed = secrets.randbits(31) if args.seed is None else whole_number(args.seed, "seed", 0, 2**62)
    jobs = processes(args.jobs)
    if args.package is not None:
        install(Path(args.package), Path("runs") / there.name / "package")
    found = check_entry(there, entry, word=word, sample=sample, seed=seed, jobs=jobs)
    for note in found.notes:
        print(f"note: {note}")
    for difference in found.differences[:SHOWN]:
        print(f"differs: {difference}")
    if len(found.differences) > SHOWN:
        print(f"differs: {len(found.differences) - SHOWN} more")
    how = "" if found.flown == found.of else f" (--seed {seed})"
    print(
        f"{entry['name']}: {found.flown} of {found.of} flights flown again{how}; {len(found.differences)} differences"
    )
    if found.flown < found.of:
        share, more = (100 * found_share(found.of, n, found.flown) for n in (1, 10))
        print(f"A sample of {found.flown} finds one forged flight in {share:.0f} % of checks, ten in {more:.0f} %.")
    return 1 if found.differences else 0


def _table(args: argparse.Namespace, there: League) -> int:
    from dtsa_agent.core.errors import ConfigError
    from dtsa_bench.experiments.batch.table import aligned
    from dtsa_bench.experiments.league.check import sums
    from dtsa_bench.experiments.league.entry import read_entry
    from dtsa_bench.experiments.league.table import HEADS, LeagueTable
    from dtsa_bench.pages.report.tables import write_league

    entries = [read_entry(path) for path in args.what]
    for path, entry in zip(args.what, entries, strict=True):
        if wrong := sums(there, entry):
            raise ConfigError("ENTRY", path, f"an entry whose numbers follow from its flights ({wrong[0]})")
    table = LeagueTable(there, entries)
    directory = Path(args.out) if args.out else Path("runs") / there.name / "table"
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError("out", str(directory), f"a directory that can be made ({error.strerror})") from error
    files = write_league(table, directory, f"{program()} {shlex.join(sys.argv[1:])}")
    if args.json:
        print(json.dumps([dict(zip(HEADS, line, strict=True)) for line in table.lines("-")], indent=1))
    else:
        print(aligned([HEADS, *table.lines("-")]))
        print(f"table: {files[0]}")
    return 0


def _cells(args: argparse.Namespace, there: League) -> int:
    from dtsa_bench.experiments.batch.table import aligned
    from dtsa_bench.experiments.league.cells import entrants

    print(aligned([["cell", "what it is"], *([cell.name, cell.text] for cell in there.cells)]))
    published = there.published()
    print(f"\n{there.count} seeds each; commitment to the judged ones: {there.commitment}")
    print(f"secret: {published or 'not published yet'}")
    print(f"schemes: {', '.join(entrants())}")
    return 0


def _word(args: argparse.Namespace, there: League) -> str | None:
    """The secret that was given, if it is the one of the commitment; None: none was given."""
    from dtsa_bench.experiments.league.cells import read_secret

    if args.secret is None:
        return None
    word = read_secret(args.secret)
    there.check_secret(word)
    return word
