"""The command line: finds the module of a command, imports that one alone, and turns errors into one line.

A command is a module `dtsa_bench.commands.<name>` with all that concerns it: `DESCRIPTION`, `EXAMPLES` (words, and what
they do), `add_arguments(parser)` and `run(args) -> int`.
"""

from __future__ import annotations

import argparse
import importlib
import os
import re
import signal
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from dtsa_bench import __version__
from dtsa_bench.runs.program import program

from .missing_packages import say_missing
from .registry import COMMANDS, hint, module_of

PROGRAM = "dtsa"
INTERRUPTED = 128 + signal.SIGINT


class HelpText(argparse.HelpFormatter):
    """Fills paragraphs, but leaves examples as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return text if text.startswith("examples:") else super()._fill_text(text, width, indent)


class OneLineParser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage text around it; takes no abbreviations."""

    def __init__(self, **more: Any) -> None:
        super().__init__(allow_abbrev=False, formatter_class=HelpText, **more)
        self.commands: dict[str, OneLineParser] = {}  # parsers of the commands, of the whole command line's parser

    def error(self, message: str) -> NoReturn:
        wrong = re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message)
        near = hint(wrong[1], re.findall(r"[\w.-]+", wrong[2])) if wrong else ""
        self.exit(2, f"{PROGRAM}: error: {message}{near}\n")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse does; an option that there is not is named before one that is missing."""
        known = self._option_string_actions
        for word in () if self._subparsers else args or ():
            option = word.partition("=")[0]
            if option.startswith("--") and option not in (*known, "--"):
                self.error(f"option {word}: unknown{hint(option, known)}")
        return super().parse_known_args(args, namespace)


def build_parser(command: str | None, others: Sequence[str] = ()) -> tuple[OneLineParser, Any]:
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
    for name, text in {**COMMANDS, **dict.fromkeys(others, "")}.items():
        parser.commands[name] = subparsers.add_parser(name, help=text)
        if name == command:
            chosen = importlib.import_module(module_of(name))
            declare(chosen, parser.commands[name], name)
    return parser, chosen


def declare(module: Any, parser: OneLineParser, name: str) -> None:
    """Fills the parser of a command with what its module says."""
    parser.description = module.DESCRIPTION
    lines = [f"  {program()} {name} {words}".rstrip() + f"\n      {text}" for words, text in module.EXAMPLES]
    parser.epilog = "\n".join(["examples:", *lines])
    module.add_arguments(parser)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    :param arguments: command line without the program's name; None: this process's.
    """
    try:
        try:
            return _run(list(sys.argv[1:] if arguments is None else arguments))
        finally:
            sys.stdout.flush()  # now, so that an error of that can be told
    except KeyboardInterrupt:
        return INTERRUPTED
    except Exception as error:
        return report(error)


def _run(words: Sequence[str]) -> int:
    command = words[0] if words and not words[0].startswith("-") else None
    parser, chosen = build_parser(command)
    if command is not None and chosen is None:
        parser.error(f"command: got {command!r}; allowed: {', '.join(COMMANDS)}{hint(command, COMMANDS)}")
    args, surplus = parser.parse_known_args(words)
    if surplus:
        parser.error(f"argument {surplus[0]}: unknown")
    return int(chosen.run(args) or 0)


def report(error: Exception) -> int:
    """Print an error that was raised on purpose, or by the system, as one line; pass on all others."""
    if isinstance(error, ImportError):
        return say_missing(PROGRAM, error)
    if isinstance(error, OSError):
        return _report_system(error)
    from dtsa_agent.core.errors import ConfigError, DtsaError

    if not isinstance(error, DtsaError):
        raise error
    print(f"{PROGRAM}: error: {' '.join(str(error).split())}", file=sys.stderr)
    return 2 if isinstance(error, ConfigError) else 1


def _report_system(error: OSError) -> int:
    """Says what the system refused; where standard output takes nothing more, not even the exit writes to it again."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        error.filename = error.filename or "standard output"
    if isinstance(error, BrokenPipeError):  # the reader (`| head`) has gone
        return 128 + signal.SIGPIPE
    place = f"{error.filename}: " if error.filename else ""
    print(f"{PROGRAM}: error: {place}{error.strerror or error}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
