"""`dtsa soak`: what is too long for the tests."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

DESCRIPTION = """\
Runs a named soak: flights and faults against real processes for up to 90 minutes. It can be interrupted at any time;
the same command goes on where it stopped. What was found is written to docs/evidence/NAME.json."""
EXAMPLES = (
    ("--list", "what there is"),
    ("kill --sample", "a few minutes' part of one"),
)
_MINUTES = 90.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    parser.add_argument("name", nargs="?", help="name of the soak")
    parser.add_argument("--list", action="store_true", help="names of all soaks, and what each promises")
    parser.add_argument("--sample", action="store_true", help="a few minutes' part of it only")
    parser.add_argument("--minutes", metavar="X", default="90", help="nothing begins later than this [90]")
    parser.add_argument("--out", metavar="DIR", help="where finished items are kept [runs/soak/NAME]")
    parser.add_argument("--json", action="store_true", help="print the record as JSON instead of lines")
    parser.add_argument("--evidence", metavar="FILE", help="the record [docs/evidence/NAME.json; none with --sample]")


def run(args: argparse.Namespace) -> int:
    """Run the soak."""
    from dtsa_agent.core.errors import ConfigError
    from dtsa_dev.soak.registry import SOAKS, soak_named
    from dtsa_dev.soak.runner import run_soak, write_record

    if args.list:
        for name, text in SOAKS.items():
            print(f"{name:10} {text}")
        return 0
    if args.name not in SOAKS:
        raise ConfigError("name", args.name or "", ", ".join(SOAKS))
    name = f"{args.name}-sample" if args.sample else args.name
    directory = Path(args.out) if args.out else Path("runs") / "soak" / name
    soak = soak_named(args.name)
    soak.check()
    record = run_soak(soak, directory, _minutes(args.minutes), args.sample)
    if args.evidence or not args.sample:
        path = Path(args.evidence) if args.evidence else Path("docs") / "evidence" / f"{name}.json"
        write_record(path, record)
        if not args.json:
            print(f"record: {path}")
    if args.json:
        print(json.dumps(record, indent=1))
        return 1 if record["failures"] else 0
    left = record["items"] - record["finished"]
    print(f"{name}: {record['finished']} of {record['items']} done, {len(record['failures'])} failed")
    print(json.dumps(record["figures"], indent=1))
    for failure in record["failures"]:
        print(f"  {failure['item']}: {failure['reason']}")
    if left:
        print(f"{left} are left: the same command goes on from there")
    return 1 if record["failures"] else 0


def _minutes(text: str) -> float:
    from dtsa_agent.core.errors import ConfigError

    try:
        minutes = float(text)
    except ValueError:
        minutes = 0.0
    if not 0.0 < minutes <= _MINUTES:
        raise ConfigError("minutes", text, f"more than 0 to {_MINUTES:g}")
    return minutes
