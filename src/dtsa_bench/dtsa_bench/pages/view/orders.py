"""What a page may order where the user has allowed it: checked before anything acts on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dtsa_agent.core.errors import ConfigError

PROCESS_ORDERS = ("kill", "start")  # of an agent's process, by a flight in real time
SURE = "stop all motors"  # what an emergency stop has to say: it is never ordered by accident
_LONGEST = 2000  # characters of a partition


@dataclass(frozen=True, slots=True)
class Order:
    """One order."""

    kind: str
    value: float | bool | str | None = None


def _is_agent(value: Any) -> bool:
    return type(value) is int and 1 <= value <= 65535


# By kind of order: whether a value will do, and which ones do.
_VALUES = {
    **dict.fromkeys(PROCESS_ORDERS, (_is_agent, "the id of an agent")),
    "loss": (lambda value: type(value) in (int, float) and 0.0 <= value <= 1.0, "0 to 1"),
    "jam": (lambda value: type(value) is bool, "true or false"),
    "partition": (
        lambda value: type(value) is str and len(value) <= _LONGEST,
        "groups of ids, as [[1, 2, 3], [4, 5, 6]]",
    ),
    "land": (lambda value: value is None, "nothing"),
    "emergency": (lambda value: value == SURE, f"{SURE!r}, the second step"),
}


def read_order(content: Any) -> Order:
    """The order in decoded JSON that a page has sent; whether it can be carried out is not known yet.

    :raises ConfigError: if it is none.
    """
    if not isinstance(content, dict) or content.get("kind") not in _VALUES:
        raise ConfigError("order", str(content)[:80], f"one of {', '.join(_VALUES)}")
    kind, value = content["kind"], content.get("value")
    fits, allowed = _VALUES[kind]
    if not fits(value):
        raise ConfigError(kind, str(value)[:80], allowed)
    return Order(kind, float(value) if kind == "loss" else value)
