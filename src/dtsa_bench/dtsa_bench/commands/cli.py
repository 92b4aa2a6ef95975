"""The command line: imports the chosen command's module alone, and turns errors into one line."""

from __future__ import annotations

import argparse
import os
import re
import signal
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from dtsa_bench import __version__
from dtsa_bench.runs.program import program

from .registry import COMMANDS, INTERRUPTED, Command, hint, load_command, report_missing_package

PROGRAM = "dtsa"
# Commands of `tools/dtsa` besides those of this package; a test compares.
CHECKOUT_COMMANDS = ("setup", "shell", "test", "ros2", "clean")


class HelpText(argparse.HelpFormatter):
    """Fill paragraphs, but leave examples as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return text if text.startswith("examples:") else super()._fill_text(text, width, indent)


class CommandParser(argparse.ArgumentParser):
    """A parser whose errors are one line, without the usage text; it takes no abbreviations."""

    def __init__(self, **more: Any) -> None:
        super().__init__(allow_abbrev=False, formatter_class=HelpText, **more)
        self.commands: dict[str, CommandParser] = {}  # parsers of the commands, of the whole command line's parser

    def error(self, message: str) -> NoReturn:
        wrong = re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message)
        near = hint(wrong[1], re.findall(r"[\w.-]+", wrong[2])) if wrong else ""
        self.exit(2, f"{PROGRAM}: error: {message}{near}\n")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse does; an option that there is not is named before one that is missing."""
        options = self._option_string_actions
        for word in () if self._subparsers else args or ():
            option = word.partition("=")[0]
            if option.startswith("--") and option not in (*options, "--"):
                self.error(f"option {word}: unknown{hint(option, options)}")
        return super().parse_known_args(args, namespace)


def build_parser(command: str | None, others: Sequence[str] = ()) -> tuple[CommandParser, Command | None]:
    """Parser of the whole command line, and the command that its first word names; only its module is imported."""
    parser = CommandParser(prog=PROGRAM, description="Channel access in quadcopter swarms.")
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    subparsers = parser.add_subparsers(
        dest="command", metavar="COMMAND", required=True, parser_class=CommandParser, title="commands"
    )
    chosen = None
    for name, text in {**COMMANDS, **dict.fromkeys(others, "")}.items():
        parser.commands[name] = subparsers.add_parser(name, help=text)
        if name == command:
            chosen = load_command(name)
            add_command(chosen, parser.commands[name], name)
    return parser, chosen


def add_command(command: Command, parser: CommandParser, name: str) -> None:
    """Fill the parser of a command."""
    parser.description = command.description
    lines = [f"  {program()} {name} {words}".rstrip() + f"\n      {text}" for words, text in command.examples]
    parser.epilog = "\n".join(["examples:", *lines])
    command.add_arguments(parser)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; ``arguments``: the command line without the program's name, None: this process's."""
    try:
        try:
            return _run(list(sys.argv[1:] if arguments is None else arguments))
        finally:
            print(end="", flush=True)  # now, so that an error of that can be told; nothing where it is closed
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
    assert chosen is not None
    return chosen.run(args)


def report(error: Exception) -> int:
    """Print an error that was raised on purpose, or by the system, as one line; pass on all others."""
    if isinstance(error, ImportError):
        return report_missing_package(PROGRAM, error)
    if isinstance(error, OSError):
        return _report_system(error)
    from dtsa_agent.core.errors import ConfigError, DtsaError

    if not isinstance(error, DtsaError):
        raise error
    print(f"{PROGRAM}: error: {' '.join(str(error).split())}", file=sys.stderr)
    return 2 if isinstance(error, ConfigError) else 1


def _report_system(error: OSError) -> int:
    """Report what the system refused; where standard output takes no more, not even the exit writes to it."""
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


class CompletionCommand(Command):
    description = """\
Prints a script for bash or zsh that completes the commands of this program, their options, and the values of
options that have names. It starts no program while you type; make it again after an update."""
    examples = (
        ("bash > ~/.dtsa-completion.bash", "then, in ~/.bashrc: . ~/.dtsa-completion.bash"),
        ("zsh > ~/.zsh/_dtsa", "then, in ~/.zshrc before compinit: fpath=(~/.zsh $fpath)"),
    )
    options = (("shell", "for which shell", {"choices": ("bash", "zsh")}),)

    def run(self, args: argparse.Namespace) -> int:
        """Print the script."""
        import shtab

        parser, _ = build_parser(None, CHECKOUT_COMMANDS)
        for name in COMMANDS:
            own = parser.commands[name]
            add_command(load_command(name), own, name)
            own.description = COMMANDS[name]
            for action in own._actions:
                action.choices = action.choices or getattr(action, "words", None) or None
        print(shtab.complete(parser, args.shell))
        return 0
