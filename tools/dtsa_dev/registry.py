"""Commands that only a checkout has: their names, `soak` and `docs`.

`tools/dtsa` reads this before anything is installed, so it imports the standard library alone.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

from dtsa_bench.commands.registry import Command

COMMANDS = {
    "soak": "what is too long for the tests: kills, faults, missions, fuzzing; run by pytest",
    "prove": "policy lease explored state by state, for all patterns of loss",
    "embedded": "the protocol on a simulated microcontroller: the same bits, and what it costs",
    "docs": "the documentation as a site, built strictly or served",
    "benchmark": "how fast the protocol, the nodes and the simulator are on this machine, as ratios",
    "release": "the distribution: source and wheels, installed and tried in fresh environments; nothing is uploaded",
}
_MODULES = {"soak": "registry", "docs": "registry"}  # the others are modules of their own


def add_commands() -> None:
    """Make these commands known to the command line of `dtsa_bench`."""
    from dtsa_bench.commands import registry

    registry.add_commands(COMMANDS, {name: f"dtsa_dev.{_MODULES.get(name, name)}" for name in COMMANDS})


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
        # Items have limits of their own, up to half an hour: what ends a test that hangs in C waits for longer.
        words = ["-m", "soak", "-k", args.k, "-o", "faulthandler_timeout=2000"]
        words += ["--collect-only", "-q"] if args.list else ["-v"]
        files = SOAKS.values() if args.name is None else [SOAKS[args.name]]
        environment = {**os.environ, **({"DTSA_EVIDENCE": "1"} if args.evidence and not args.list else {})}
        os.chdir(ROOT)
        # In place of this process, which at Ctrl-C would not wait until the tests have ended what they started.
        os.execve(sys.executable, [sys.executable, "-m", "pytest", *words, *map(str, files)], environment)


SITE = "runs/site"
HOST = "127.0.0.1"


class DocsCommand(Command):
    description = """\
Builds the documentation as a site that needs no network. A dead link, a link to a heading that is not there, and a page
that the navigation does not name end the build with code 1."""
    examples = (("", "into runs/site"), ("--serve", "on http://127.0.0.1:8000, built again after each change"))

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--out", metavar="DIR", default=SITE, help=f"where the site is put [{SITE}]")
        parser.add_argument(
            "--serve", action="store_true", help=f"serve it on {HOST} instead, and build it again after each change"
        )
        parser.add_argument("--port", metavar="N", type=int, default=8000, help="of --serve [8000]")

    def run(self, args: argparse.Namespace) -> int:
        """Build or serve."""
        from dtsa_agent.core.errors import ConfigError

        out = Path(args.out).resolve()
        if out.is_file() or (
            out.is_dir() and any(out.iterdir()) and not (out / "search" / "search_index.json").exists()
        ):
            raise ConfigError("out", args.out, "a new or empty directory, or one with a site, which is replaced")
        if not 1 <= args.port <= 65535:
            raise ConfigError("port", args.port, "1 to 65535")
        how = (
            ["serve", "--dev-addr", f"{HOST}:{args.port}"]
            if args.serve
            else ["build", "--quiet", "--site-dir", str(out)]
        )
        command = [sys.executable, "-m", "mkdocs", *how, "--strict", "--config-file", str(ROOT / "mkdocs.yml")]
        # Material's announcement of its successor is no warning about a page.
        code = subprocess.call(command, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"})
        if code == 0 and not args.serve:
            print(f"docs: {out / 'index.html'}")
        return code
