"""Who sends in a slot: policies that decide from the table alone, ``tdma``, ``dtsa``, ``age`` and ``aloha``."""

from __future__ import annotations

from dataclasses import dataclass

from . import estimators
from .arithmetic import mix64, share_of
from .priority import priorities
from .rules import Rules
from .selection import Choice, oldest, select
from .table import Table

NOBODY = Choice(-1, "nobody")


@dataclass(slots=True)
class Weights:
    """What a policy computed on its way to a decision, for whoever wants to look; None: not computed."""

    h: list[int] | None = None
    g: list[float] | None = None


def choose(table: Table, slot: int, rules: Rules, weights: Weights | None = None) -> Choice:
    """Whose turn a slot is in the eyes of one table: the same for all agents whose tables are the same.

    ``tdma`` gives all the same update time (eq:update_time_tdma), ``age`` all of A_p (eq:update_time_NA).

    :param table: what is known before the slot.
    :param slot: the slot that begins.
    :param rules: what all agree on; policies ``tdma``, ``dtsa``, ``age``.
    :param weights: gets what was computed.
    """
    weights = Weights() if weights is None else weights
    if rules.policy == "tdma":
        return Choice(slot % rules.agents, "tdma")
    if rules.policy == "dtsa" and rules.boot_round and slot < rules.agents:
        return Choice(slot, "boot")
    outside = choose_outside(table, slot, rules)
    if outside is not None:
        return outside
    members = [k for k, row in enumerate(table.rows) if row.in_ap]
    h = weights.h = [row.h(slot) for row in table.rows]
    if not members:
        return NOBODY
    longest = oldest(h, members)
    if rules.policy == "age":
        return Choice(longest, "oldest")
    if rules.age_cap > 0.0 and h[longest] >= rules.age_cap * len(members):
        return Choice(longest, "age-cap")
    return choose_by_priority(table, slot, rules, weights)


def choose_by_priority(table: Table, slot: int, rules: Rules, weights: Weights) -> Choice:
    """The agent of A_p with the most urgent extrapolated state (eq:estimate, eq:permission_d_p_ang, eq:pfs).

    :param slot: number of the slot.
    """
    estimate = estimators.intent if rules.estimator == "intent" else estimators.linear
    believed = [estimate(row, rules, slot) for row in table.rows]
    weights.g = priorities([p for p, _ in believed], [v for _, v in believed], rules.slot_s)
    h = [row.h(slot) for row in table.rows]
    return select(weights.g, h, [row.in_ap for row in table.rows], rules.epsilon, rules.selection)


def choose_outside(table: Table, slot: int, rules: Rules) -> Choice | None:
    """Every so many slots one belongs, in id order, to the agents outside A_p; None: this is no such slot."""
    if rules.return_every < 1 or slot % rules.return_every != rules.return_every - 1:
        return None
    outside = [k for k, row in enumerate(table.rows) if not row.in_ap]
    if not outside:
        return None
    return Choice(outside[slot // rules.return_every % len(outside)], "return")


def choose_aloha(table: Table, slot: int, agent: int, rules: Rules) -> Choice:
    """ALOHA: each agent of A_p sends with probability 1 / N_p, by a draw that depends on key, slot and id only.

    :param agent: id of the agent that decides for itself.
    """
    outside = choose_outside(table, slot, rules)
    if outside is not None:
        return outside
    members = sum(row.in_ap for row in table.rows)
    draw = share_of(mix64(rules.key ^ mix64(slot * 65536 + agent)))
    sends = table.rows[agent - 1].in_ap and draw * members < 1.0
    return Choice(agent - 1 if sends else -1, "random")
