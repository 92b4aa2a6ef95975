"""`dtsa completion`: a script that completes commands, options and their values in bash and zsh."""

from __future__ import annotations

import argparse
import importlib

# What `tools/dtsa` knows besides the commands of this package; a test compares.
OF_THE_TOOL = ("setup", "shell", "test", "ros2", "clean")

DESCRIPTION = """\
Prints a script for bash or zsh that completes the commands of this program, their options, and the values of
options that have names. It asks nobody while one types; after an update it is made again."""
EXAMPLES = (
    ("bash > ~/.dtsa-completion.bash", "then, in ~/.bashrc: . ~/.dtsa-completion.bash"),
    ("zsh > ~/.zsh/_dtsa", "then, in ~/.zshrc before compinit: fpath=(~/.zsh $fpath)"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    parser.add_argument("shell", choices=("bash", "zsh"), help="for which shell")


def run(args: argparse.Namespace) -> int:
    """Print the script."""
    import shtab

    from .cli import build_parser, declare
    from .registry import COMMANDS, module_of

    parser, _ = build_parser(None, OF_THE_TOOL)
    for name in COMMANDS:
        own = parser.commands[name]
        declare(importlib.import_module(module_of(name)), own, name)
        own.description = COMMANDS[name]
        for action in own._actions:
            action.choices = action.choices or getattr(action, "words", None) or None
    print(shtab.complete(parser, args.shell))
    return 0
