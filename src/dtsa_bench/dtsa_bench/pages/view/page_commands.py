"""What a page may command where the user has allowed it: checked before anything acts on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dtsa_agent.core.errors import ConfigError

PROCESS_COMMANDS = ("kill", "start")  # of an agent's process, by a flight in real time
CONFIRMATION = "stop all motors"  # value of an emergency stop: it is never commanded by accident
_MAX_LENGTH = 2000  # characters of a partition


@dataclass(frozen=True, slots=True)
class PageCommand:
    """One command of a page."""

    kind: str
    value: float | bool | str | None = None


# By kind: whether a value is valid, and which values are.
_VALUES = {
    **dict.fromkeys(PROCESS_COMMANDS, (lambda value: type(value) is int and 1 <= value <= 65535, "the id of an agent")),
    "loss": (lambda value: type(value) in (int, float) and 0.0 <= value <= 1.0, "0 to 1"),
    "jam": (lambda value: type(value) is bool, "true or false"),
    "partition": (
        lambda value: type(value) is str and len(value) <= _MAX_LENGTH, "groups of ids, as [[1, 2, 3], [4, 5, 6]]"
    ),
    "land": (lambda value: value is None, "nothing"),
    "emergency": (lambda value: value == CONFIRMATION, f"{CONFIRMATION!r}, the second step"),
}  # fmt: skip


def parse_command(content: Any) -> PageCommand:
    """Return the command in decoded JSON of a page; whether it can be carried out is not known yet.

    :raises ConfigError: if it is none.
    """
    if not isinstance(content, dict) or content.get("kind") not in _VALUES:
        raise ConfigError("command", str(content)[:80], f"one of {', '.join(_VALUES)}")
    kind, value = content["kind"], content.get("value")
    is_valid, allowed = _VALUES[kind]
    if not is_valid(value):
        raise ConfigError(kind, str(value)[:80], allowed)
    return PageCommand(kind, float(value) if kind == "loss" else value)
