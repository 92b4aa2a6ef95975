"""The command line: finds the module of a command, imports that one alone, and turns errors into one line.

A command is a module `dtsa_bench.commands.<name>` with `add_parser(subparsers)` and `run(args) -> int`.
"""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys
from collections.abc import Sequence
from typing import NoReturn

from dtsa_bench import __version__
from dtsa_bench.missing import say_missing
from dtsa_bench.registry import available, module_name

PROGRAM = "dtsa"
INTERRUPTED = 128 + signal.SIGINT


class OneLineParser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage text around it."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{PROGRAM}: error: {message}\n")


def build_parser(command: str | None) -> tuple[argparse.ArgumentParser, object | None]:
    """Parser of the whole command line; only the chosen command's module is imported.

    :param command: first word of the command line, None if there is none.
    :returns: the parser, and the chosen command's module or None.
    """
    parser = OneLineParser(prog=PROGRAM, description="Channel access in quadcopter swarms.")
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    subparsers = parser.add_subparsers(
        dest="command", metavar="COMMAND", required=True, parser_class=OneLineParser, title="commands"
    )
    chosen = None
    for name, text in available():
        if name == command:
            chosen = importlib.import_module(f"dtsa_bench.commands.{module_name(name)}")
            chosen.add_parser(subparsers)
        else:
            subparsers.add_parser(name, help=text)
    return parser, chosen


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    :param arguments: command line without the program's name; None: this process's.
    :returns: exit code: 0 done, 1 the command failed, 2 wrong input, 130 interrupted.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        command = words[0] if words and not words[0].startswith("-") else None
        parser, chosen = build_parser(command)
        args = parser.parse_args(words)
        return int(chosen.run(args) or 0)  # type: ignore[union-attr, attr-defined]
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        # The reader (`| head`) has gone; nothing more may be written, not even at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except Exception as error:
        return report(error)


def report(error: Exception) -> int:
    """Print an error that was raised on purpose as one line; pass on all others.

    :returns: exit code.
    """
    if isinstance(error, ImportError):
        return say_missing(PROGRAM, error)
    from dtsa_agent.core.errors import ConfigError, DtsaError

    if isinstance(error, DtsaError):
        print(f"{PROGRAM}: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2 if isinstance(error, ConfigError) else 1
    raise error


if __name__ == "__main__":
    sys.exit(main())
