"""Who sends in a slot: policies that decide from the table alone: all but ``lease``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from .arithmetic import INVERSE_PI, Vector, arcsin, dot, minus, mix64, share_of, sum_in_lanes
from .table import Table, intent, linear


@dataclass(frozen=True, slots=True)
class Choice:
    """Who was chosen, and why."""

    index: int  # id - 1, -1: nobody
    reason: str  # one of REASONS
    g: float = 0.0  # priority of the chosen
    counters: list[int] | None = None  # h of all agents, where the policy has looked at them
    priorities: list[float] | None = None  # g of all agents, likewise


NOBODY = Choice(-1, "nobody")
STRAIGHT = 0.02  # m/s, weight of an agent that flies straight on, with policy innovation


def choose(table: Table, slot: int) -> Choice:
    """Whose turn a slot is in the eyes of one table: the same for all agents whose tables are the same.

    ``tdma`` gives all the same update time (eq:update_time_tdma), ``age`` all of A_p (eq:update_time_NA).
    """
    rules = table.rules
    if rules.policy == "tdma":
        return Choice(slot % rules.agents, "tdma")
    if rules.policy == "dtsa" and rules.boot_round and slot < rules.agents:
        return Choice(slot, "boot")
    outside = choose_outside(table, slot)
    if outside is not None:
        return outside
    if rules.policy == "aloha":
        return choose_aloha(table, slot)
    members = [k for k, row in enumerate(table.rows) if row.in_ap]
    h = [row.h(slot) for row in table.rows]
    longest = oldest(h, members)
    if not members:
        return Choice(-1, "nobody", counters=h)
    if rules.policy == "age":
        return Choice(longest, "oldest", counters=h)
    if rules.age_cap > 0.0 and h[longest] >= rules.age_cap * len(members):
        return Choice(longest, "age-cap", counters=h)
    if rules.policy == "innovation":
        weighed = max(members, key=lambda k: h[k] * (STRAIGHT + table.rows[k].innovation))
        return Choice(weighed, "innovation", counters=h)
    return choose_by_priority(table, slot, h)


def choose_by_priority(table: Table, slot: int, h: list[int]) -> Choice:
    """The agent of A_p with the most urgent extrapolated state (eq:estimate, eq:permission_d_p_ang, eq:pfs)."""
    rules = table.rules
    estimate = intent if rules.estimator == "intent" else linear
    believed = [estimate(row, rules, slot) for row in table.rows]
    g = priorities([p for p, _ in believed], [v for _, v in believed], rules.slot_s)
    choice = select(g, h, [row.in_ap for row in table.rows], rules.epsilon, rules.selection)
    return replace(choice, counters=h, priorities=g)


def choose_outside(table: Table, slot: int) -> Choice | None:
    """Every so many slots one belongs, in id order, to the agents outside A_p; None: this is no such slot."""
    every = table.rules.return_every
    if every < 1 or slot % every != every - 1:
        return None
    outside = [k for k, row in enumerate(table.rows) if not row.in_ap]
    if not outside:
        return None
    return Choice(outside[slot // every % len(outside)], "return")


def choose_aloha(table: Table, slot: int) -> Choice:
    """ALOHA: each agent of A_p sends with probability 1 / N_p, by a draw that depends on key, slot and id only."""
    agent = table.observer
    members = sum(row.in_ap for row in table.rows)
    draw = share_of(mix64(table.rules.key ^ mix64(slot * 65536 + agent)))
    sends = table.rows[agent - 1].in_ap and draw * members < 1.0
    return Choice(agent - 1 if sends else -1, "random")


def eta(p_k: Vector, v_k: Vector, p_j: Vector, v_j: Vector, slot_s: float) -> float:
    """How urgent two agents are to each other: eta_jk = |d_jk| / |p_kj| (pi - alpha_jk) / pi.

    d_jk = v_jk t_s is their relative displacement in a slot; alpha_jk (eq:permission_alpha) is the angle between v_jk
    and p_kj, 0 for a head-on approach. (pi - arccos x) / pi is computed as 1/2 + arcsin(x) / pi, and |v| / |p| as
    |v|^2 / (|p| |v|), which needs one root.

    :returns: eta, dimensionless; 0 for v_jk = 0, and for p_kj = 0: that is a crash, and the run is over.
    """
    p_kj, v_jk = minus(p_k, p_j), minus(v_j, v_k)
    speed2 = dot(v_jk, v_jk)
    product = math.sqrt(dot(p_kj, p_kj) * speed2)  # |p_kj| |v_jk|
    if not product > 0.0:
        return 0.0
    inverse = 1.0 / product
    cosine = max(-1.0, min(1.0, dot(v_jk, p_kj) * inverse))
    share = 0.5 + arcsin(cosine) * INVERSE_PI
    return speed2 * inverse * slot_s * share


def priorities(positions: Sequence[Vector], velocities: Sequence[Vector], slot_s: float) -> list[float]:
    """The priority values g_k of all agents, the sum of eta_jk over all j but k (eq:permission_d_p_ang).

    eta is symmetric, so each pair is computed once. The order of the sum: from the agents before k one after the other,
    then the sum in lanes over those after it. An agent at rest has g = 0.
    """
    count = len(positions)
    g = [0.0] * count
    for k in range(count):
        later = range(k + 1, count)
        row = [eta(positions[k], velocities[k], positions[j], velocities[j], slot_s) for j in later]
        for j, value in zip(later, row, strict=True):
            g[j] += value
        g[k] += sum_in_lanes(row)
    return [0.0 if v == (0.0, 0.0, 0.0) else value for v, value in zip(velocities, g, strict=True)]


def oldest(h: Sequence[int], members: Sequence[int]) -> int:
    """The member with the largest h, then the lowest id; -1 without members."""
    return max(members, key=lambda k: h[k], default=-1)  # the first of several


def select(
    g: Sequence[float], h: Sequence[int], in_ap: Sequence[bool], epsilon: float, selection: str = "candidates"
) -> Choice:
    """The next sender (eq:pfs, eq:secondary)."""
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
    """Those of A_p with g >= (1 - epsilon) max g: eq:pfs does not tell them from the greatest."""
    floor = (1.0 - epsilon) * max(g[k] for k in members)
    return [k for k in members if g[k] >= floor]


def select_pairwise(g: Sequence[float], h: Sequence[int], members: Sequence[int], epsilon: float) -> Choice:
    """The paper's text read literally: one scan in id order that keeps the significantly greater of two.

    The comparison (eq:pfs) is not transitive, so the winner depends on the order of the ids.
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
