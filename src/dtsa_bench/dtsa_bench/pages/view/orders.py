"""What a page may order where the user has allowed it: checked before anything acts on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dtsa_agent.core.errors import ConfigError

KINDS = ("kill", "start", "loss", "jam", "partition", "land", "emergency")
SURE = "stop all motors"  # what an emergency stop has to say: it is never ordered by accident
_LONGEST = 2000  # characters of a partition


@dataclass(frozen=True, slots=True)
class Order:
    """One order."""

    kind: str  # one of KINDS
    agent: int = 0  # id: kill, start
    value: float | bool | str = 0.0  # loss: share; jam: on or off; partition: groups as in the channel's settings


def read_order(content: Any) -> Order:
    """An order in what a page has sent; whether it can be carried out is not known yet.

    :param content: decoded JSON.
    :raises ConfigError: if it is none.
    """
    if not isinstance(content, dict) or content.get("kind") not in KINDS:
        raise ConfigError("order", str(content)[:80], f"one of {', '.join(KINDS)}")
    kind, agent, value = content["kind"], content.get("agent", 0), content.get("value")
    if kind in ("kill", "start"):
        if type(agent) is not int or not 1 <= agent <= 65535:
            raise ConfigError("agent", str(agent)[:80], "the id of an agent")
        return Order(kind, agent)
    if kind == "loss":
        if type(value) not in (int, float) or not 0.0 <= value <= 1.0:
            raise ConfigError("loss", str(value)[:80], "0 to 1")
        return Order(kind, value=float(value))
    if kind == "jam":
        if type(value) is not bool:
            raise ConfigError("jam", str(value)[:80], "true or false")
        return Order(kind, value=value)
    if kind == "land":
        return Order(kind)
    if kind == "emergency":
        if value != SURE:
            raise ConfigError("emergency", str(value)[:80], f"{SURE!r}, the second step")
        return Order(kind, value=SURE)
    if type(value) is not str or len(value) > _LONGEST:
        raise ConfigError("partition", str(value)[:80], "groups of ids, as [[1, 2, 3], [4, 5, 6]]")
    return Order(kind, value=value)
