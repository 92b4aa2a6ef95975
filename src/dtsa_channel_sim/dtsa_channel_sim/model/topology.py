"""Who is connected with whom: lists of agents, groups of a partition, links, distances."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Setting

_RANGE = re.compile(r"(\d+)(?:\s*-\s*(\d+))?")
_PROBABILITY = Setting("loss", "float", None, "loss of a link", minimum=0.0, maximum=1.0)


def parse_ids(value: object, agents: int, name: str) -> tuple[int, ...]:
    """Return the ids that the user means, ascending and without doubles.

    :param value: an id, a list of ids, or text as "1-6, 9"; "all" means everybody.
    :param agents: number of agents N; ids run from 1 to N.
    :param name: name of the setting, for the error.
    :raises ConfigError: when the notation is wrong, an id is out of range or nobody is named.
    """
    allowed = f'ids from 1 to {agents}, as a number, a list, or text like "1-6, 9", or "all"'
    if isinstance(value, str):
        ids = set(_text_ids(value, agents, name, allowed))
    elif isinstance(value, Iterable):
        ids = {member for item in value for member in parse_ids(item, agents, name)}
    elif isinstance(value, int | np.integer) and not isinstance(value, bool):
        ids = {int(value)}
    else:
        raise ConfigError(name, value, allowed)
    if not ids or min(ids) < 1 or max(ids) > agents:
        raise ConfigError(name, value, allowed)
    return tuple(sorted(ids))


def _text_ids(text: str, agents: int, name: str, allowed: str) -> Iterable[int]:
    if text.strip().lower() == "all":
        return range(1, agents + 1)
    ids: list[int] = []
    for part in text.split(","):
        match = _RANGE.fullmatch(part.strip())
        if match is None:
            raise ConfigError(name, text, allowed)
        first, last = int(match[1]), int(match[2] or match[1])
        # The upper bound is checked before the range is written out: "1-999999999" must not fill the memory.
        if last > agents or first > last:
            raise ConfigError(name, text, allowed)
        ids.extend(range(first, last + 1))
    return ids


def format_ids(ids: Sequence[int]) -> str:
    """Return ids as text, runs as "1-6"; the inverse of :func:`parse_ids`.

    :param ids: ascending ids.
    """
    parts: list[list[int]] = []
    for member in ids:
        if parts and member == parts[-1][1] + 1:
            parts[-1][1] = member
        else:
            parts.append([member, member])
    return ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in parts)


def parse_partition(value: object, agents: int, name: str = "partition") -> tuple[tuple[int, ...], ...]:
    """Return the groups of a partition, in the order given; empty when all are together.

    :param value: text as "1-6 | 7-12", or a list of groups; empty or None: one group. Agents that are not
        named form one more group.
    :param agents: number of agents N.
    :param name: name of the setting, for the error.
    :raises ConfigError: when an id is out of range or stands in two groups.
    """
    if value is None or value == "" or (isinstance(value, Sequence) and not len(value)):
        return ()
    if isinstance(value, str):
        parts: Sequence[Any] = value.split("|")
    elif isinstance(value, Sequence):
        parts = value
    else:
        raise ConfigError(name, value, 'groups of ids, as "1-6 | 7-12" or [[1, 2], [3, 4]]; empty: no partition')
    groups = tuple(parse_ids(part, agents, name) for part in parts)
    named = [member for group in groups for member in group]
    if len(set(named)) != len(named):
        raise ConfigError(name, value, "every id in at most one group")
    rest = tuple(sorted(set(range(1, agents + 1)) - set(named)))
    groups = (*groups, rest) if rest else groups
    return groups if len(groups) > 1 else ()


def format_partition(groups: Sequence[Sequence[int]]) -> str:
    """Return groups as text, "1-6 | 7-12"; the inverse of :func:`parse_partition`."""
    return " | ".join(format_ids(group) for group in groups)


def group_numbers(groups: Sequence[Sequence[int]], agents: int) -> NDArray[np.int32]:
    """Return the number of each agent's group, (N,), zeros without a partition.

    :param groups: ids of each group.
    :param agents: number of agents.
    """
    numbers = np.zeros(agents, dtype=np.int32)
    for number, group in enumerate(groups):
        numbers[np.asarray(group) - 1] = number
    return numbers


@dataclass(frozen=True, slots=True)
class LinkLoss:
    """Loss of some directed links.

    :param sender: ids of the senders as text, see :func:`parse_ids`.
    :param receiver: ids of the receivers as text.
    :param loss: probability that a frame on such a link is lost, 0 to 1.
    :param both_ways: True when the way back loses as much.
    """

    sender: str
    receiver: str
    loss: float
    both_ways: bool = False

    @classmethod
    def from_dict(cls, entry: object, agents: int, name: str) -> LinkLoss:
        """Return the entry ``{from: ids, to: ids, loss: p, both_ways: false}``, validated.

        :param agents: number of agents.
        :raises ConfigError: naming the part that is wrong.
        """
        if isinstance(entry, LinkLoss):
            entry = entry.to_dict()
        if not isinstance(entry, Mapping):
            raise ConfigError(name, entry, "{from: ids, to: ids, loss: 0 to 1, both_ways: true or false}")
        for key in entry:
            if key not in ("from", "to", "loss", "both_ways"):
                raise ConfigError(f"{name}.{key}", entry[key], "the keys from, to, loss, both_ways")
        for key in ("from", "to", "loss"):
            if key not in entry:
                raise ConfigError(f"{name}.{key}", None, "a value: the entry needs from, to and loss")
        both_ways = entry.get("both_ways", False)
        if not isinstance(both_ways, bool):
            raise ConfigError(f"{name}.both_ways", both_ways, "true or false")
        return cls(
            sender=format_ids(parse_ids(entry["from"], agents, f"{name}.from")),
            receiver=format_ids(parse_ids(entry["to"], agents, f"{name}.to")),
            loss=_PROBABILITY.check(entry["loss"], f"{name}.loss"),
            both_ways=both_ways,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the entry as :meth:`from_dict` reads it."""
        return {"from": self.sender, "to": self.receiver, "loss": self.loss, "both_ways": self.both_ways}


def parse_matrix(value: object, agents: int, name: str = "loss_matrix") -> tuple[tuple[float, ...], ...]:
    """Return an (N, N) matrix of losses as tuples; empty stays empty. The diagonal is not used and set to 0.

    :param value: rows of numbers, row = sender, column = receiver.
    :param agents: number of agents.
    :raises ConfigError: when its shape or a number is wrong.
    """
    if value is None:
        return ()
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
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


def link_matrix(
    matrix: Sequence[Sequence[float]], links: Sequence[LinkLoss], agents: int
) -> NDArray[np.float64] | None:
    """Return the loss of every link, (N, N), row = sender, column = receiver; None when no link is special.

    :param matrix: (N, N) loss of each link, row = sender, 0 to 1; empty for zeros.
    :param links: entries laid over it, later ones over earlier ones.
    :param agents: number of agents.
    """
    if not matrix and not links:
        return None
    result = np.array(matrix, dtype=np.float64) if matrix else np.zeros((agents, agents))
    for link in links:
        senders = np.array(parse_ids(link.sender, agents, "link_loss.from")) - 1
        receivers = np.array(parse_ids(link.receiver, agents, "link_loss.to")) - 1
        result[np.ix_(senders, receivers)] = link.loss
        if link.both_ways:
            result[np.ix_(receivers, senders)] = link.loss
    np.fill_diagonal(result, 0.0)
    return result if result.any() else None


def squared_distances(positions: NDArray[np.float64], agent: int) -> NDArray[np.float64]:
    """Return the squared distance of every agent to one, (N,), m^2.

    :param positions: (3, N), m, frame map.
    :param agent: id of the one.
    """
    offset = positions - positions[:, agent - 1 : agent]
    return np.asarray(offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2)
