"""Which agents are connected: groups of a partition, losses of links; and how settings say so."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Setting

Matrix = tuple[tuple[float, ...], ...]  # (N, N), row = sender, column = receiver
Groups = tuple[tuple[int, ...], ...]  # ids

_PROBABILITY = Setting("loss", "float", None, "loss of a link", minimum=0.0, maximum=1.0)
_BOTH_WAYS = Setting("both_ways", "bool", None, "true or false")
_LINK_KEYS = ("from", "to", "loss", "both_ways")

# Functions that parse take the setting's name, and raise ConfigError naming the part that is wrong.


def listed(value: object, name: str) -> Sequence[Any]:
    """Return a list, also of a JSON text; None and empty text: an empty one."""
    if value is None or (isinstance(value, str) and not value):
        return ()
    entries = value
    if isinstance(value, str):
        try:
            entries = json.loads(value)
        except (ValueError, RecursionError):
            entries = None
    if isinstance(entries, str) or not isinstance(entries, Sequence):
        raise ConfigError(name, value, "a list of entries")
    return entries


def parse_ids(value: object, agents: int, name: str) -> tuple[int, ...]:
    """Return the ids of an id or a list of ids of N agents, ascending and without doubles; one at least."""
    several = isinstance(value, Sequence) and not isinstance(value, str)
    ids: Sequence[Any] = value if several else (value,)  # type: ignore[assignment]
    if not ids:
        raise ConfigError(name, value, f"one id at least, from 1 to {agents}")
    for place, member in enumerate(ids):
        if isinstance(member, bool) or not isinstance(member, int | np.integer) or not 1 <= member <= agents:
            raise ConfigError(f"{name}[{place}]" if several else name, member, f"ids from 1 to {agents}")
    return tuple(sorted({int(member) for member in ids}))


def parse_partition(value: object, agents: int, name: str = "partition") -> Groups:
    """Return the groups of a partition of N agents, in the order given; empty when all are together.

    ``value`` is a list of groups of ids, ``[[1, 2], [3, 4]]``, or JSON text of one; empty: one group. Agents that are
    not named form one more group.
    """
    groups = [parse_ids(group, agents, f"{name}[{k}]") for k, group in enumerate(listed(value, name))]
    named: set[int] = set()
    for k, group in enumerate(groups):
        if not named.isdisjoint(group):
            raise ConfigError(f"{name}[{k}]", list(group), "every id in at most one group")
        named.update(group)
    rest = tuple(sorted(set(range(1, agents + 1)) - named))
    if rest:
        groups.append(rest)
    return tuple(groups) if len(groups) > 1 else ()


@dataclass(frozen=True, slots=True)
class LinkLoss:
    """Loss of some directed links."""

    sender: tuple[int, ...]  # ids; empty: all
    receiver: tuple[int, ...]  # ids; empty: all
    loss: float  # probability that a frame on such a link is lost, 0 to 1
    both_ways: bool = False  # the way back loses as much

    @classmethod
    def from_dict(cls, entry: object, agents: int, name: str) -> LinkLoss:
        """Return the entry ``{from: ids, to: ids, loss: p, both_ways: false}``; without ids: all agents."""
        if isinstance(entry, LinkLoss):
            entry = entry.to_dict()
        if not isinstance(entry, Mapping):
            raise ConfigError(name, entry, "{from: ids, to: ids, loss: 0 to 1, both_ways: true or false}")
        for key in entry:
            if key not in _LINK_KEYS:
                raise ConfigError(f"{name}.{key}", entry[key], f"the keys {', '.join(_LINK_KEYS)}")
        if "loss" not in entry:
            raise ConfigError(f"{name}.loss", None, "a value: the entry needs loss")
        both_ways = _BOTH_WAYS.check(entry.get("both_ways", False), f"{name}.both_ways")
        ids = [parse_ids(entry[key], agents, f"{name}.{key}") if key in entry else () for key in ("from", "to")]
        return cls(*ids, _PROBABILITY.check(entry["loss"], f"{name}.loss"), both_ways)

    def to_dict(self) -> dict[str, Any]:
        """Return the entry as :meth:`from_dict` reads it."""
        ids = {key: list(ids) for key, ids in (("from", self.sender), ("to", self.receiver)) if ids}
        return {**ids, "loss": self.loss, "both_ways": self.both_ways}


def parse_links(value: object, agents: int, name: str = "link_loss") -> tuple[LinkLoss, ...]:
    """Return a list of losses of links between N agents."""
    return tuple(LinkLoss.from_dict(entry, agents, f"{name}[{k}]") for k, entry in enumerate(listed(value, name)))


def parse_matrix(value: object, agents: int, name: str = "loss_matrix") -> Matrix:
    """Return an (N, N) matrix of probabilities; empty stays empty. The diagonal is not used and set to 0."""
    if value is None:
        return ()
    try:
        if {bool, str} & set(map(type, np.array(value, dtype=object).flat)):
            raise TypeError
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ConfigError(name, value, f"{agents} rows of {agents} numbers from 0 to 1") from None
    if matrix.size == 0:
        return ()
    if matrix.shape != (agents, agents):
        raise ConfigError(name, f"shape {matrix.shape}", f"{agents} rows (senders) of {agents} numbers (receivers)")
    np.fill_diagonal(matrix, 0.0)
    wrong = ~((matrix >= 0.0) & (matrix <= 1.0))
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        raise ConfigError(f"{name}[{row}][{column}]", float(matrix[row, column]), "a number from 0 to 1")
    return tuple(map(tuple, matrix.tolist()))


def link_matrix(matrix: Matrix, links: Sequence[LinkLoss], agents: int) -> NDArray[np.float64] | None:
    """Return the loss of every link, (N, N): a matrix, empty for zeros, and entries over it; None: no link has any."""
    if not matrix and not links:
        return None
    result = np.array(matrix, dtype=np.float64) if matrix else np.zeros((agents, agents))
    everybody = range(1, agents + 1)
    for link in links:
        senders, receivers = np.array(link.sender or everybody) - 1, np.array(link.receiver or everybody) - 1
        result[np.ix_(senders, receivers)] = link.loss
        if link.both_ways:
            result[np.ix_(receivers, senders)] = link.loss
    np.fill_diagonal(result, 0.0)
    return result if result.any() else None
