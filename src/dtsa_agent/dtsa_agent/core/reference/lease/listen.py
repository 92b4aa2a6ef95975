"""Policy ``lease``: what a frame changes, and what silence does.

docs/reference/protocol.md, "States and events of an agent".
"""

from __future__ import annotations

from dtsa_agent.core.frame import ExtendedFrame, Gossip
from dtsa_agent.core.reference import gossip
from dtsa_agent.core.reference.table import Table

from .memory import DEAF, GONE, MISSED, NEVER, Memory


def listen(memory: Memory, self_index: int, table: Table, slot: int, frame: ExtendedFrame, wakes: bool) -> None:
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
    check_claim(memory, self_index, slot, frame, was_absent)
    memory.resting[sender] = frame.own.c_r == 0
    for entry in frame.gossip:
        hear_gossip(memory, self_index, table, slot - entry.age, entry)
    turns = memory.turns_of_leases(slot, frame.c_s, len(frame.leases))
    leased = [(turn, lessee) for turn, lessee in zip(turns, frame.leases, strict=False) if lessee]
    if memory.owner(slot) == sender:
        memory.settled[sender] = any(memory.owner(turn) == sender and memory.is_anchor(turn) for turn, _ in leased)
    for turn, lessee in leased:
        memory.note(self_index, slot, sender + 1, turn, lessee, sender + 1)
    for ahead, lessee in frame.relay:
        memory.note(self_index, slot, sender + 1, slot + ahead, lessee, 0)
    for ahead in frame.far:
        memory.note(self_index, slot, sender + 1, slot + ahead, frame.far_lessee, 0)


def check_claim(memory: Memory, self_index: int, slot: int, frame: ExtendedFrame, was_absent: bool) -> None:
    """Probation begins where another agent may take this one for dead, and ends where that agent has heard it."""
    distance = (frame.own.sender - 1 - self_index) % memory.rules.agents
    if not memory.rules.adoption or frame.leaving:
        return
    if distance <= frame.c_s or (was_absent and not frame.probation):
        # It thinks me dead and gives my turns away; or it lived all the time elsewhere, so others there may.
        memory.probation = True
        memory.anchored = False
        memory.claimed = slot
    elif memory.probation and memory.anchored and not frame.probation and frame.c_s == distance - 1:
        memory.probation = False


def hear_gossip(memory: Memory, self_index: int, table: Table, alive: int, entry: Gossip) -> None:
    """Somebody says that an agent lived in a slot."""
    k = entry.agent - 1
    if k == self_index:
        if memory.woke != NEVER and alive >= memory.woke:
            memory.woke = NEVER  # I have been heard
            gossip.confirm(table, alive, entry, memory.rules)
    elif memory.heard[k] < alive and memory.heard[k] != GONE:
        memory.heard[k] = alive


def end_slot(memory: Memory, self_index: int, slot: int, sent: bool, reason: str) -> None:
    """The slot is over."""
    if sent:
        if reason == "open":
            memory.attempts = min(memory.attempts + 1, 255)
        else:
            memory.woke = NEVER
    elif not memory.heard_now:
        note_silence(memory, slot)
    end_probation(memory, self_index, slot)


def note_silence(memory: Memory, slot: int) -> None:
    """Silence where somebody was expected that is not known to be gone."""
    k = memory.expected
    if k < 0 or memory.missed[k] >= MISSED or memory.absent(k, slot):
        return
    if memory.silence <= DEAF:
        memory.silence += 1
    if memory.silence <= DEAF:
        memory.missed[k] += 1


def end_probation(memory: Memory, self_index: int, slot: int) -> None:
    """Probation ends after an own main anchor: leases of an earlier life reach no farther.

    With adoption others may have given turns away, too; everybody who might has spoken twice after 2 K M N slots.
    """
    if memory.owner(slot) == self_index and memory.is_main(slot):
        memory.anchored = True
    if not memory.probation or not memory.anchored:
        return
    quiet = slot - memory.claimed
    enough = 2 * memory.rules.main_every * memory.rules.agents
    if not memory.rules.adoption or (quiet >= enough and not memory.deaf):
        memory.probation = False
