"""The command line: finds the module of a command, imports that one alone, and turns errors into one line.

A command is a module `dtsa_bench.commands.<name>` with `add_parser(subparsers)` and `run(args) -> int`.
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

from .examples import epilog
from .missing_packages import say_missing
from .registry import COMMANDS, module_of
from .spelling import hint, words_of

PROGRAM = "dtsa"
INTERRUPTED = 128 + signal.SIGINT


class HelpText(argparse.HelpFormatter):
    """Fills paragraphs, but leaves examples as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return text if text.startswith("examples:") else super()._fill_text(text, width, indent)


class OneLineParser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage text around it; takes no abbreviations."""

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **{"allow_abbrev": False, "formatter_class": HelpText, **more})

        self._words: list[str] = []

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse does; keeps the words for what `error` says."""
        self._words = [] if args is None else list(args)
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        if message.startswith("the following arguments are required"):
            known = {option for action in self._actions for option in action.option_strings}
            wrong = [word for word in self._words if word.startswith("--") and word.partition("=")[0] not in known]
            message += "".join(f"; {_unknown([word], self)}" for word in wrong[:1])
        self.exit(2, f"{PROGRAM}: error: {message}{_meant(message)}\n")


def _meant(message: str) -> str:
    """What may have been meant where argparse refuses a word."""
    found = re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message)
    return hint(found[1], re.findall(r"[\w.-]+", found[2])) if found else ""


def _unknown(words: Sequence[str], parser: argparse.ArgumentParser) -> str:
    """What to say about words that a command does not know.

    :param words: the words.
    :param parser: the command's parser.
    """
    options = [option for action in parser._actions for option in action.option_strings]
    wrong = next((word for word in words if word.startswith("-")), words[0])
    what = "option" if wrong.startswith("-") else "argument"
    return f"{what} {wrong}: unknown{hint(wrong.partition('=')[0], options)}"


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
    for name, text in COMMANDS.items():
        if name == command:
            chosen = importlib.import_module(module_of(name))
            chosen.add_parser(subparsers)
            subparsers.choices[name].epilog = epilog(name, program())
        else:
            subparsers.add_parser(name, help=text)
    return parser, chosen


def raise_wrong_command(parser: argparse.ArgumentParser, command: str, known: Sequence[str]) -> NoReturn:
    """Ends with one line about a command that does not exist."""
    parser.error(f"command: got {command!r}; allowed: {', '.join(known)}{hint(command, known)}")


def command_parser(parser: argparse.ArgumentParser, command: str | None) -> argparse.ArgumentParser:
    """The parser of one command.

    :param parser: of the whole command line.
    :param command: its name; None: the parser of the whole command line.
    """
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction) and command in action.choices:
            found: argparse.ArgumentParser = action.choices[command]
            return found
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    :param arguments: command line without the program's name; None: this process's.
    :returns: exit code: 0 done, 1 the command failed, 2 wrong input, 130 interrupted.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        command = words[0] if words and not words[0].startswith("-") else None
        parser, chosen = build_parser(command)
        if command is not None and chosen is None:
            raise_wrong_command(parser, command, list(COMMANDS))
        args, unknown = parser.parse_known_args(words)
        if unknown:
            parser.error(_unknown(unknown, command_parser(parser, command)))
        args.own_process = arguments is None
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
        near = hint(str(error.value), words_of(error.allowed)) if isinstance(error, ConfigError) else ""
        print(f"{PROGRAM}: error: {' '.join(str(error).split())}{near}", file=sys.stderr)
        return 2 if isinstance(error, ConfigError) else 1
    raise error


if __name__ == "__main__":
    sys.exit(main())
