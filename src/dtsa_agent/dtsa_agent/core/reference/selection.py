"""The paper's selection function: who sends next, from priorities g and counters h."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Choice:
    """Who was chosen, and why."""

    index: int  # id - 1, -1: nobody
    reason: str  # one of REASONS
    g: float = 0.0  # priority of the chosen


def oldest(h: Sequence[int], members: Sequence[int]) -> int:
    """The member with the largest h, then the lowest id; -1 without members.

    :param h: (N,) slots, counters of all agents.
    :param members: indices, ascending.
    """
    return max(members, key=lambda k: h[k], default=-1)  # the first of several


def select(
    g: Sequence[float], h: Sequence[int], in_ap: Sequence[bool], epsilon: float, selection: str = "candidates"
) -> Choice:
    """The next sender (eq:pfs, eq:secondary).

    :param g: (N,) priorities of all agents, without a unit.
    :param h: (N,) slots, counters of all agents.
    :param in_ap: who is in A_p.
    :param epsilon: least relative difference that counts.
    :param selection: ``candidates`` or ``pairwise``.
    """
    members = [k for k, member in enumerate(in_ap) if member]
    if not members:
        return Choice(-1, "nobody")
    if max(g[k] for k in members) <= 0.0:
        k = oldest(h, members)
        return Choice(k, "oldest", g[k])
    if selection == "pairwise":
        return select_pairwise(g, h, members, epsilon)
    close = candidates(g, members, epsilon)
    k = oldest(h, close)
    return Choice(k, "tie" if len(close) > 1 else "priority", g[k])


def candidates(g: Sequence[float], members: Sequence[int], epsilon: float) -> list[int]:
    """Those of A_p with g >= (1 - epsilon) max g: eq:pfs does not tell them from the greatest.

    :param members: indices of A_p.
    """
    floor = (1.0 - epsilon) * max(g[k] for k in members)
    return [k for k in members if g[k] >= floor]


def select_pairwise(g: Sequence[float], h: Sequence[int], members: Sequence[int], epsilon: float) -> Choice:
    """The paper's text read literally: one scan in id order that keeps the significantly greater of two.

    The comparison (eq:pfs) is not transitive, so the winner depends on the order of the ids.

    :param g: (N,) priorities of all agents, without a unit.
    :param h: (N,) slots, counters of all agents.
    :param members: indices of A_p.
    :param epsilon: share of the greatest g that does not tell two apart.
    """
    best, reason = members[0], "priority"
    for k in members[1:]:
        greater, less = max(g[k], g[best]), min(g[k], g[best])
        if greater > 0.0 and (greater - less) / greater > epsilon:
            if g[k] > g[best]:
                best, reason = k, "priority"
        else:
            reason = "tie"
            if h[k] > h[best]:
                best = k
    return Choice(best, reason, g[best])
