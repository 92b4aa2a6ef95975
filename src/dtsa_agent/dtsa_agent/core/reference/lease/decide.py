"""Policy ``lease``: who sends in a slot, as one agent sees it (docs/reference/protocol.md, "Who sends in slot T")."""

from __future__ import annotations

from dtsa_agent.core.reference.arithmetic import mix64, share_of
from dtsa_agent.core.reference.frame_extended import OPEN
from dtsa_agent.core.reference.policies import Choice

from .memory import HANDED, NEVER, Memory

_OPEN_DRAW = 0x4F50454E  # "OPEN": these draws are none of another policy's


def decide(memory: Memory, self_index: int, slot: int, far_from_goal: bool) -> Choice:
    """Who is expected to send in a slot; if that is oneself, one sends."""
    if not memory.started:
        memory.start(slot)
    memory.roll(self_index, slot)
    watch_goal(memory, slot, far_from_goal)
    memory.heard_now = False
    memory.expected = -1
    owner = memory.owner(slot)
    lease = memory.leases.get(slot)
    if lease is not None and lease.lessee == OPEN:
        return Choice(self_index if uses_open_turn(memory, self_index, slot) else -1, "open")
    if lease is not None:
        adopted = lease.issuer not in (0, owner + 1, HANDED)
        memory.expected = lease.lessee - 1
        # A lease that I hear of while others may think me dead, or I them, may be one of two.
        mine_but_quiet = memory.expected == self_index and memory.probation
        return Choice(-1 if mine_but_quiet else memory.expected, "adopted" if adopted else "leased")
    reason = "anchor" if memory.is_anchor(slot) else "own"
    if owner == self_index:
        if memory.probation and not memory.is_anchor(slot):
            return Choice(-1, "probation")
        return Choice(self_index, reason)
    memory.expected = memory.scheduled(slot)
    if memory.expected < 0:
        reason = "probation" if memory.quiet[owner] else "absent"
    return Choice(memory.expected, reason)


def watch_goal(memory: Memory, slot: int, far_from_goal: bool) -> None:
    """Note since when the agent is idle, or that it wakes."""
    if not far_from_goal:
        if memory.idle_since == NEVER:
            memory.idle_since = slot
    elif memory.idle_since != NEVER:
        memory.idle_since = NEVER
        memory.woke = slot
        memory.attempts = 0
    memory.moving = far_from_goal


def has_own_turn_soon(memory: Memory, self_index: int, slot: int) -> bool:
    """Whether the agent may send by a right of its own within the next N / 2 slots."""
    for turn in range(slot + 1, slot + memory.rules.agents // 2 + 1):
        lease = memory.leases.get(turn)
        if lease is not None and lease.lessee == self_index + 1:
            return True
        if memory.owner(turn) == self_index and lease is None and (memory.is_anchor(turn) or not memory.probation):
            return True
    return False


def uses_open_turn(memory: Memory, self_index: int, slot: int) -> bool:
    """Whether a waking agent uses an OPEN turn: with the chance 1 / ((1 + 3 w) 2^a), a at most 5.

    w agents woke lately; a frames of its own in OPEN turns were not known to be heard. So many that woke together get
    out of each other's way.
    """
    if memory.woke == NEVER or has_own_turn_soon(memory, self_index, slot):
        return False
    chance = 1.0 / ((1.0 + 3.0 * memory.wakers) * 2.0 ** min(memory.attempts, 5))
    draw = mix64(memory.rules.key ^ mix64((slot << 16) + self_index + _OPEN_DRAW))
    return share_of(draw) < chance
