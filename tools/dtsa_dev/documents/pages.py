"""Pages of the site that are made from the code while it is built: commands, messages, the library.

`python -m dtsa_dev.documents.pages` writes the settings of `dtsa.simulate`, as type checkers and editors read them.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import dtsa
from dtsa_bench.commands import cli, registry
from dtsa_bench.experiments.sweep import setting_specs
from dtsa_dev import registry as developers

from . import table

_SOURCES = Path(__file__).resolve().parents[3] / "src"
_TYPES = _SOURCES / "dtsa_msgs"
_SETTINGS = ("RunConfig", "SwarmConfig", "ChannelConfig", "ClockConfig", "RunLimits")
_GROUPS = {
    "One flight": ("simulate", "run_config", "FlightLog"),
    "Many flights": ("sweep", "SweepResult"),
    "Recorded runs": ("open", "verify", "Verification", "Difference"),
    "Plug-ins": ("register", "Table", "plug_in_random"),
    "Figures": (*(name for name in dtsa.__all__ if name.startswith("plot_")), "agent_colour"),
    "One agent, one channel": ("Agent", "Decision", "SlotOutcome", "Channel", "Verdict"),
    "Settings": _SETTINGS,
    "Errors": (
        "DtsaError", "ConfigError", "PluginError", "LocalProtocolError", "RemoteProtocolError", "BagError",
        "UnusableBag",
    ),
}  # fmt: skip


def commands() -> str:
    """The page of commands: what `--help` of each says, with its examples."""
    developers.add_commands()
    parts = [_command(name, text) for name, text in registry.COMMANDS.items()]
    rows = [(f"[`{name}`](#{name})", text) for name, text in registry.COMMANDS.items()]
    only = ", ".join(f"`{name}`" for name in developers.COMMANDS)
    return (
        "# Commands\n\n"
        "In a checkout a command is `tools/dtsa COMMAND`; where the distribution is installed it is `dtsa COMMAND`.\n"
        f"A checkout alone has the developers' commands: {only}. Exit codes: 0 done, 1 the command failed,\n"
        "2 wrong input, 130 interrupted. `tools/dtsa --help` also lists the commands that concern the machine.\n\n"
        f"{table(('command', 'purpose'), rows)}\n{''.join(parts)}"
    )


def _command(name: str, text: str) -> str:
    whole, command = cli.build_parser(name)
    assert command is not None
    parser = whole.commands[name]
    parts = [f"## {name}\n\n{parser.description or text}\n\n"]
    lines = [f"dtsa {name} {words}".rstrip() + f"    # {what}\n" for words, what in command.examples]
    parts += ["```sh\n", *lines, "```\n\n"] if lines else []
    for group in parser._action_groups:
        rows = [_argument(parser, action) for action in group._group_actions if action.help != argparse.SUPPRESS]
        parts += [table((group.title or "", "meaning"), rows), "\n"] if rows else []
    return "".join(parts)


def _argument(parser: argparse.ArgumentParser, action: argparse.Action) -> tuple[str, str]:
    formatter = parser._get_formatter()
    meaning = formatter._expand_help(action) if action.help else ""
    return f"`{formatter._format_action_invocation(action)}`", meaning.replace("<", "&lt;")


def messages() -> str:
    """The page of messages and services: each definition with its comments."""
    parts = [
        "# Messages and services\n\n"
        "Package `dtsa_msgs`, as `ros2 interface show` prints it. Topics of nodes and of bags:\n"
        "[nodes and bags](nodes.md).\n\n"
    ]
    for path in (*sorted(_TYPES.glob("msg/*.msg")), *sorted(_TYPES.glob("srv/*.srv"))):
        text = path.read_text(encoding="utf-8").rstrip()
        parts.append(f"## {path.stem}\n\n`dtsa_msgs/{path.suffix[1:]}/{path.stem}`\n\n```text\n{text}\n```\n\n")
    return "".join(parts)


def library() -> str:
    """The page of the public names of `dtsa`, from their docstrings."""
    grouped = {name for names in _GROUPS.values() for name in names}
    if missing := set(dtsa.__all__) - grouped - {"REASONS", "__version__", "env"}:
        raise ValueError(f"public names of dtsa that no group of the page has: {', '.join(sorted(missing))}")
    return "".join(_library())


def _library() -> Iterator[str]:
    yield "# The library `dtsa`\n\n"
    yield "How it is used, with examples: [Use it from Python](../how-to/python.md). Each name is `dtsa.NAME`. "
    yield "`dtsa.REASONS` says in words\nwhy an agent decided as it did, by the reason's name.\n\n"
    for title, names in _GROUPS.items():
        yield f"## {title}\n\n"
        if names is _SETTINGS:
            yield "Their fields, with default, unit and range: [settings](settings.md), [channel](channel.md).\n\n"
        for name in names:
            yield _entry(f"{getattr(dtsa, name).__module__}.{getattr(dtsa, name).__qualname__}", names is not _SETTINGS)
        if "Table" in names:
            yield "The methods of each kind, with shapes, units and errors: [plug-ins](plug-ins.md).\n\n"
    yield "## An environment for learning\n\n"
    yield "Each name is `dtsa.env.NAME`. Observations: [how-to](../how-to/learning.md).\n\n"
    for name in dtsa.env.__all__:
        if name != "Reward":  # a type without a text of its own: what takes SlotResults
            yield _entry(f"{getattr(dtsa.env, name).__module__}.{name}", True)


def run_settings() -> str:
    """The module ``dtsa/_settings.pyi``: a TypedDict of all settings that `simulate` takes by name."""
    simple = {"int": "int", "float": "float", "bool": "bool", "text": "str", "values": "Mapping[str, float]"}
    lines = []
    for name in sorted(names := setting_specs()):
        spec = names[name]
        closed = spec.kind == "text" and spec.choices and not spec.open_choices
        words = [json.dumps(word) for word in spec.choices] if closed else []
        text = f"Literal[{', '.join(words)}]"
        text = text if len(text) < 80 else "".join(["Literal[\n", *(f"        {word},\n" for word in words), "    ]"])
        kind = text if closed else simple.get(spec.kind, "Any")
        kind = "Any" if spec.custom else f"{kind} | None" if spec.optional else kind
        lines.append(f"    {name}: {kind}\n")
    return (
        '"""The settings of `simulate` and `run_config`: made by `python -m dtsa_dev.documents.pages`."""\n\n'
        "from __future__ import annotations\n\nfrom collections.abc import Mapping\n"
        "from typing import Any, Literal, TypedDict\n\n"
        "class RunSettings(TypedDict, total=False):\n"
        '    """Units and ranges: docs/reference/settings.md and docs/reference/channel.md."""\n\n' + "".join(lines)
    )


def _entry(identifier: str, members: bool) -> str:
    return f"::: {identifier}\n" + ("" if members else "    options: {members: false}\n") + "\n"


if __name__ == "__main__":
    (_SOURCES / "dtsa_bench" / "dtsa" / "_settings.pyi").write_text(run_settings(), encoding="utf-8")
