"""`dtsa soak`: what is too long for the tests, run by pytest."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

from dtsa_bench.commands.registry import Command

ROOT = Path(__file__).resolve().parents[2]
SOAKS = {path.stem.removeprefix("test_"): path for path in sorted((ROOT / "tools" / "test" / "soak").glob("test_*.py"))}


class SoakCommand(Command):
    description = """\
Runs the tests that are too long for `dtsa test`: flights and faults against real processes, for minutes to an hour.
The same as `pytest -m soak`. A test that fails is run again by `pytest --last-failed -m soak`."""
    examples = (("faults -k agent_killed", "some rows of one"), ("recorder --evidence", "one, and its record"))

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("name", nargs="?", choices=list(SOAKS), help="which soak [all]")
        parser.add_argument("-k", metavar="EXPRESSION", default="", help="only tests whose names match, as of pytest")
        parser.add_argument("--list", action="store_true", help="list the tests only")
        parser.add_argument("--evidence", action="store_true", help="write the records to docs/evidence")

    def run(self, args: argparse.Namespace) -> int:
        """Run pytest."""
        words = ["-m", "soak", "-k", args.k, *(["--collect-only", "-q"] if args.list else ["-v"])]
        files = SOAKS.values() if args.name is None else [SOAKS[args.name]]
        environment = {**os.environ, **({"DTSA_EVIDENCE": "1"} if args.evidence and not args.list else {})}
        return subprocess.call([sys.executable, "-m", "pytest", *words, *map(str, files)], cwd=ROOT, env=environment)
