"""`dtsa new-plugin`: a package to begin with."""

from __future__ import annotations

import argparse
from pathlib import Path

DESCRIPTION = """\
Writes a package with a policy of your own that works: the policy, a test, a sweep that sets it against the league's
best and the bound, and the lines that install and run it. What a policy is given and what it
returns: docs/reference/plug-ins.md."""
EXAMPLES = (("my-policy --out plugins/my-policy", "then as its README.md says"),)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    parser.add_argument("name", metavar="NAME", help="what the policy will be called, as in my-policy")
    parser.add_argument("--out", metavar="DIR", help="where the package goes (default: a directory of that name here)")


def run(args: argparse.Namespace) -> int:
    """Write the package."""
    from dtsa_bench.experiments.plugin_template import write_package

    for path in write_package(args.name, Path(args.out or args.name)):
        print(path)
    return 0
