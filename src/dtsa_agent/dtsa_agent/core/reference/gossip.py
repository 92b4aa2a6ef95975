"""Gossip: extended frames carry what their sender last heard of others."""

from __future__ import annotations

from dtsa_agent.core.frame import ExtendedFrame, Frame, Gossip

from .frame import GOSSIP_AGE_MAX, OPEN, SECTIONS, gossip_fits
from .table import Rules, Table


def collect(table: Table, slot: int, room: int, rules: Rules) -> tuple[Gossip, ...]:
    """The states that a frame carries: the newest, the newest of k slots or more, and of 2 k or more; k = 2 + N div 16.

    The first mends single losses at once; the others reach receivers that heard nothing for a while. What is left of
    the room carries the next newest.
    """
    later = 2 + rules.agents // 16
    chosen: list[int] = []
    for age in (1, later, 2 * later, *[1] * SECTIONS):
        if len(chosen) < room:
            chosen += newest_of_age(table, slot, age, chosen, rules)
    rows = table.rows
    return tuple(
        Gossip(k + 1, slot - rows[k].sent_slot, rows[k].in_ap, rows[k].position, rows[k].velocity) for k in chosen
    )


def newest_of_age(table: Table, slot: int, age: int, chosen: list[int], rules: Rules) -> list[int]:
    """The newest state of somebody not yet chosen that is ``age`` slots old or older and can be said; or nobody's."""
    fit = [
        k
        for k, row in enumerate(table.rows)
        if k != table.observer - 1
        and row.sent_slot >= 0
        and age <= slot - row.sent_slot <= GOSSIP_AGE_MAX
        and k not in chosen
        and gossip_fits(row.position, row.velocity, rules.position_step)
    ]
    return [max(fit, key=lambda k: table.rows[k].sent_slot)] if fit else []


def learn(table: Table, sampled: int, entry: Gossip, rules: Rules) -> None:
    """A state that somebody else heard replaces an older one only, and never the observer's entry for itself.

    One at the codec's limit may be a wrong one and is not believed.
    """
    if table.observer != entry.agent:
        confirm(table, sampled, entry, rules)


def confirm(table: Table, sampled: int, entry: Gossip, rules: Rules) -> None:
    """:func:`learn`, of the observer's entry for itself, too: somebody has heard it."""
    if sampled < 0 or table.rows[entry.agent - 1].sent_slot >= sampled:
        return
    if gossip_fits(entry.position, entry.velocity, rules.position_step):
        table.learn(
            Frame(entry.agent, sampled, int(entry.moving), entry.position, entry.velocity, entry.velocity), sampled
        )


def fits_swarm(frame: ExtendedFrame, slot: int, rules: Rules) -> bool:
    """Whether a frame speaks of agents of this swarm only, and gives turns away in its sender's own turn only."""
    n, own_turn = rules.agents, slot >= 0 and slot % rules.agents == frame.own.sender - 1
    lessees = (*frame.leases, *(lessee for _, lessee in frame.relay))
    return (
        frame.own.sender <= n
        and frame.c_s < n
        and frame.far_lessee <= n
        and (own_turn or not frame.leases)
        and all(entry.agent <= n for entry in frame.gossip)
        and all(lessee <= n or lessee == OPEN for lessee in lessees)
    )
