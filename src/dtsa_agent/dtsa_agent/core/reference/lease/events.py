"""Policy ``lease``: who sends in a slot as one agent sees it, what a frame changes, and what silence does.

docs/reference/protocol.md, "Who sends in slot T" and "States and events of an agent".
"""

from __future__ import annotations

from dtsa_agent.core.frame import ExtendedFrame, Gossip
from dtsa_agent.core.reference import gossip
from dtsa_agent.core.reference.arithmetic import mix64, share_of
from dtsa_agent.core.reference.frame import OPEN
from dtsa_agent.core.reference.policies import Choice
from dtsa_agent.core.reference.table import Table

from .memory import DEAF, GONE, HANDED, MISSED, NEVER, Memory

_OPEN_DRAW = 0x4F50454E  # "OPEN": these draws are none of another policy's


def decide(memory: Memory, slot: int, far_from_goal: bool) -> Choice:
    """Who is expected to send in a slot; if that is oneself, one sends."""
    if not memory.started:
        memory.start(slot)
    memory.roll(slot)
    watch_goal(memory, slot, far_from_goal)
    memory.heard_now = False
    memory.expected = -1
    owner = memory.owner(slot)
    lease = memory.leases.get(slot)
    if lease is not None and lease.lessee == OPEN:
        return Choice(memory.me if uses_open_turn(memory, slot) else -1, "open")
    if lease is not None:
        adopted = lease.issuer not in (0, owner + 1, HANDED)
        memory.expected = lease.lessee - 1
        # A lease that I hear of while others may think me dead, or I them, may be one of two.
        mine_but_quiet = memory.expected == memory.me and memory.probation
        return Choice(-1 if mine_but_quiet else memory.expected, "adopted" if adopted else "leased")
    reason = "anchor" if memory.is_anchor(slot) else "own"
    if owner == memory.me:
        if memory.probation and not memory.is_anchor(slot):
            return Choice(-1, "probation")
        return Choice(memory.me, reason)
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


def has_own_turn_soon(memory: Memory, slot: int) -> bool:
    """Whether the agent may send by a right of its own within the next N / 2 slots."""
    for turn in range(slot + 1, slot + memory.rules.agents // 2 + 1):
        lease = memory.leases.get(turn)
        if lease is not None and lease.lessee == memory.me + 1:
            return True
        if memory.owner(turn) == memory.me and lease is None and (memory.is_anchor(turn) or not memory.probation):
            return True
    return False


def uses_open_turn(memory: Memory, slot: int) -> bool:
    """Whether a waking agent uses an OPEN turn: with the chance 1 / ((1 + 3 w) 2^a), a at most 5.

    w agents woke lately; a frames of its own in OPEN turns were not known to be heard. So many that woke together get
    out of each other's way.
    """
    if memory.woke == NEVER or has_own_turn_soon(memory, slot):
        return False
    chance = 1.0 / ((1.0 + 3.0 * memory.wakers) * 2.0 ** min(memory.attempts, 5))
    draw = mix64(memory.rules.key ^ mix64((slot << 16) + memory.me + _OPEN_DRAW))
    return share_of(draw) < chance


def listen(memory: Memory, table: Table, slot: int, frame: ExtendedFrame, wakes: bool) -> None:
    """Receive a frame of another agent."""
    if not memory.started:
        return
    sender = frame.own.sender - 1
    was_absent = memory.absent(sender, slot)
    memory.wakers += wakes
    memory.heard_now = True
    memory.silence = 0
    memory.missed[sender] = 0
    memory.quiet[sender] = frame.probation
    memory.heard[sender] = GONE if frame.leaving else slot
    check_claim(memory, slot, frame, was_absent)
    memory.resting[sender] = frame.own.c_r == 0
    for entry in frame.gossip:
        hear_gossip(memory, table, slot - entry.age, entry)
    turns = memory.turns_of_leases(slot, frame.c_s, len(frame.leases))
    leased = [(turn, lessee) for turn, lessee in zip(turns, frame.leases, strict=False) if lessee]
    if memory.owner(slot) == sender:
        memory.settled[sender] = any(memory.owner(turn) == sender and memory.is_anchor(turn) for turn, _ in leased)
    for turn, lessee in leased:
        memory.note(slot, sender + 1, turn, lessee, sender + 1)
    for ahead, lessee in frame.relay:
        memory.note(slot, sender + 1, slot + ahead, lessee, 0)
    for ahead in frame.far:
        memory.note(slot, sender + 1, slot + ahead, frame.far_lessee, 0)


def check_claim(memory: Memory, slot: int, frame: ExtendedFrame, was_absent: bool) -> None:
    """Probation begins where another agent may take this one for dead, and ends where that agent has heard it."""
    distance = (frame.own.sender - 1 - memory.me) % memory.rules.agents
    if not memory.rules.adoption or frame.leaving:
        return
    if distance <= frame.c_s or (was_absent and not frame.probation):
        # It thinks me dead and gives my turns away; or it lived all the time elsewhere, so others there may.
        memory.probation = True
        memory.anchored = False
        memory.claimed = slot
    elif memory.probation and memory.anchored and not frame.probation and frame.c_s == distance - 1:
        memory.probation = False


def hear_gossip(memory: Memory, table: Table, alive: int, entry: Gossip) -> None:
    """Somebody says that an agent lived in a slot."""
    k = entry.agent - 1
    if k == memory.me:
        if memory.woke != NEVER and alive >= memory.woke:
            memory.woke = NEVER  # I have been heard
            gossip.confirm(table, alive, entry, memory.rules)
    elif memory.heard[k] < alive and memory.heard[k] != GONE:
        memory.heard[k] = alive


def end_slot(memory: Memory, slot: int, sent: bool, reason: str) -> None:
    """The slot is over."""
    if sent:
        if reason == "open":
            memory.attempts = min(memory.attempts + 1, 255)
        else:
            memory.woke = NEVER
    elif not memory.heard_now:
        note_silence(memory, slot)
    end_probation(memory, slot)


def note_silence(memory: Memory, slot: int) -> None:
    """Silence where somebody was expected that is not known to be gone."""
    k = memory.expected
    if k < 0 or memory.missed[k] >= MISSED or memory.absent(k, slot):
        return
    if memory.silence <= DEAF:
        memory.silence += 1
    if memory.silence <= DEAF:
        memory.missed[k] += 1


def end_probation(memory: Memory, slot: int) -> None:
    """Probation ends after an own main anchor: leases of an earlier life reach no farther.

    With adoption others may have given turns away, too; everybody who might has spoken twice after 2 K M N slots.
    """
    if memory.owner(slot) == memory.me and memory.is_main(slot):
        memory.anchored = True
    if not memory.probation or not memory.anchored:
        return
    quiet = slot - memory.claimed
    enough = 2 * memory.rules.main_every * memory.rules.agents
    if not memory.rules.adoption or (quiet >= enough and not memory.deaf):
        memory.probation = False
