"""`dtsa completion`: a script that completes commands, options and their values in bash and zsh."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

SHELLS = ("bash", "zsh")
# What `tools/dtsa` knows besides the commands of this package; a test compares.
OF_THE_TOOL = ("setup", "shell", "test", "ros2", "clean")

DESCRIPTION = """\
Prints a script for bash or zsh that completes the commands of this program, their options, and the values of
options that have names. It asks nobody while one types; after an update it is made again."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register the command."""
    parser = subparsers.add_parser("completion", help="a script that completes in bash or zsh", description=DESCRIPTION)
    parser.add_argument("shell", choices=SHELLS, help="for which shell")


def run(args: argparse.Namespace) -> int:
    """Print the script."""
    print(script(args.shell), end="")
    return 0


def script(shell: str) -> str:
    """The script.

    :param shell: "bash" or "zsh".
    """
    from .registry import COMMANDS

    names = list(COMMANDS)
    options, values = [], []
    for name in names:
        found = dict(_options(name))
        options.append(f"            {name}) words='{' '.join(word for word in found if word != name)}' ;;")
        values += [
            f"        '{name} {option}') words='{' '.join(known)}' ;;" for option, known in found.items() if known
        ]
    return "\n".join([
        *(["autoload -U +X bashcompinit && bashcompinit"] if shell == "zsh" else []),
        "_dtsa() {",
        '    local word="${COMP_WORDS[COMP_CWORD]}" before="${COMP_WORDS[COMP_CWORD-1]}" words=',
        '    if [ "$COMP_CWORD" -eq 1 ]; then',
        f"        words='{' '.join([*names, *OF_THE_TOOL])}'",
        "    else",
        '        case "${COMP_WORDS[1]} $before" in',
        *values,
        "        esac",
        '        case "$word" in -*) case "${COMP_WORDS[1]}" in',
        *options,
        "        esac ;; esac",
        "    fi",
        '    COMPREPLY=($(compgen -W "$words" -- "$word"))',
        "}",
        "complete -o default -F _dtsa dtsa",
        "",
    ])  # fmt: skip


def _options(command: str) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Long options of a command, each with the values that it takes; none: any.

    :param command: its name.
    """
    from .cli import build_parser, command_parser

    parser, _ = build_parser(command)
    for action in command_parser(parser, command)._actions:
        known = tuple(str(word) for word in action.choices or getattr(action, "words", ()))
        if known and not action.option_strings:
            yield command, known  # what comes right after the command
        for option in action.option_strings:
            if option.startswith("--"):
                yield option, known
