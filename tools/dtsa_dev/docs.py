"""`dtsa docs`: the documentation as a site."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

from dtsa_bench.commands.registry import Command

SITE = "runs/site"
HOST = "127.0.0.1"


class DocsCommand(Command):
    description = """\
Builds the documentation as a site that needs no network. A dead link, a link to a heading that is not there, and a page
that the navigation does not name end the build with code 1."""
    examples = (
        ("", "into runs/site"),
        ("--serve", "on http://127.0.0.1:8000, built again after each change"),
    )

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
        root = Path(__file__).resolve().parents[2]
        how = (
            ["serve", "--dev-addr", f"{HOST}:{args.port}"]
            if args.serve
            else ["build", "--quiet", "--site-dir", str(out)]
        )
        command = [sys.executable, "-m", "mkdocs", *how, "--strict", "--config-file", str(root / "mkdocs.yml")]
        # Material's announcement of its successor is no warning about a page.
        code = subprocess.call(command, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"})
        if code == 0 and not args.serve:
            print(f"docs: {out / 'index.html'}")
        return code
