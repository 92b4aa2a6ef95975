"""Policy ``lease``: what an agent says about turns (docs/protocol.md, "Giving turns away")."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ..frame_extended import LEASE_ROOM, OPEN, RELAY_IDS, RELAY_REACH
from ..table import Row
from .memory import MISSED, Lease, Memory

BUSY = 0.5  # more wakers than this in N slots: a second OPEN turn


@dataclass(frozen=True, slots=True)
class Said:
    """What a frame says about turns."""

    c_s: int = 0
    leaving: bool = False
    leases: bytes = b""
    relay: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True, slots=True)
class Electorate:
    """Who may be given a turn."""

    alive: int  # N_alive: me and those heard of lately
    able: list[bool]  # members of A_p that live, are not in probation and do not miss their turns

    @property
    def members(self) -> int:
        """N_p, those that are able."""
        return sum(self.able)


def say(memory: Memory, self_index: int, rows: Sequence[Row], slot: int, final: bool, leaves: bool) -> Said:
    """What the agent's frame says about turns; the turns that it gives away are noted.

    :param memory: what the agent remembers.
    :param self_index: its own number, id - 1.
    :param rows: its table.
    :param slot: the slot in which it sends.
    :param final: it knows that no further goal is scheduled for it.
    :param leaves: it will be switched off after its next own turn.
    """
    own_turn = memory.owner(slot) == self_index
    leaving = memory.leaving = own_turn and leaves
    claims = memory.rules.adoption and not memory.probation and not leaving
    c_s = count_absent_before(memory, self_index, slot) if claims else 0
    leases = b""
    if own_turn:
        leases = issue(memory, self_index, rows, slot, c_s, 0 if leaving else None, final)
    return Said(c_s, leaving, leases, relay(memory, self_index, slot, own_is_said=bool(leases)))


def count_absent_before(memory: Memory, self_index: int, slot: int) -> int:
    """c_s: the number of consecutive ids before an agent that it thinks dead."""
    n, count = memory.rules.agents, 0
    while count < n - 1 and memory.absent((self_index - 1 - count) % n, slot):
        count += 1
    return count


def electorate(memory: Memory, self_index: int, rows: Sequence[Row]) -> Electorate:
    """Who may be given a turn, and how many live."""
    others = [k for k in range(memory.rules.agents) if k != self_index]
    able = [
        memory.alive(k) and rows[k].in_ap and not memory.quiet[k] and memory.missed[k] < MISSED
        for k in range(memory.rules.agents)
    ]
    able[self_index] = memory.moving
    return Electorate(1 + sum(memory.alive(k) for k in others), able)


def depth(memory: Memory, who: Electorate, slot: int, final: bool) -> int:
    """How many of its next turns an idle agent gives away: all if it is final, else floor(c x idle rounds)."""
    rules = memory.rules
    if memory.idle_since < 0 or not who.members or memory.deaf or slot < rules.agents:
        return 0
    if who.members > rules.lease_share * who.alive:
        return 0
    if final:
        return rules.anchor_every
    turns = rules.depth_rate * (slot - memory.idle_since) / rules.agents
    return int(min(turns, rules.anchor_every))


def is_open(memory: Memory, turn: int) -> bool:
    """Whether a turn goes to those who wake: one of S; two, while many wake."""
    every = memory.rules.open_every
    if not every:
        return False
    return turn % every == 0 or (memory.wakers > BUSY and turn % every == every // 2)


def issue(
    memory: Memory, self_index: int, rows: Sequence[Row], slot: int, c_s: int, own_depth: int | None, final: bool
) -> bytes:
    """The lease bytes of a frame in an own turn: what was given away before is said again, what is new is noted.

    :param c_s: number of agents before me whose turns I give away.
    :param own_depth: how many own turns at most; None: as :func:`depth` says.
    :returns: a byte a turn, up to the last that is given away.
    """
    who = electorate(memory, self_index, rows)
    rounds_mine = depth(memory, who, slot, final) if own_depth is None else own_depth
    rounds_adopted = memory.rules.anchor_every if memory.idle_since >= 0 else 1
    said = []
    for turn in memory.turns_of_leases(slot, c_s, LEASE_ROOM):
        mine = memory.owner(turn) == self_index
        rounds_ahead = -(-(turn - slot) // memory.rules.agents)  # rounded up
        reach = rounds_mine if mine else rounds_adopted
        if turn not in memory.leases and rounds_ahead <= reach and not memory.probation:
            lessee = 0
            if mine and is_open(memory, turn):
                lessee = OPEN
            elif who.members and (mine or not memory.deaf):
                lessee = choose_lessee(memory, rows, who, slot, turn) + 1
            if lessee:
                memory.leases[turn] = Lease(lessee, self_index + 1)
        said.append(memory.leases[turn].lessee if turn in memory.leases else 0)
    return bytes(said).rstrip(b"\0")


def choose_lessee(memory: Memory, rows: Sequence[Row], who: Electorate, slot: int, turn: int) -> int:
    """To whom a turn is worth most: the able agent with the largest p min(n, N_p + 1), then the lowest id.

    p and n are the distances from the turn to that agent's previous and next scheduled slot, N + 1 if there is none
    within N. p n is what the turn takes off the sum of its ages; n is cut off, because more leases will come in
    between.

    :param slot: the present slot; what was sent up to now is in the table.
    :param turn: the turn to be given away.
    """
    n = memory.rules.agents
    before = [turn - row.sent_slot if row.sent_slot >= 0 and turn - row.sent_slot <= n else n + 1 for row in rows]
    after = [n + 1] * n
    for distance in range(n, 0, -1):
        earlier = memory.scheduled(turn - distance) if turn - distance > slot else -1
        later = memory.scheduled(turn + distance)
        if earlier >= 0:
            before[earlier] = min(before[earlier], distance)
        if later >= 0:
            after[later] = distance
    able = [k for k in range(n) if who.able[k]]
    return max(able, key=lambda k: before[k] * min(after[k], who.members + 1), default=-1)  # the first of several


def relay(memory: Memory, self_index: int, slot: int, own_is_said: bool) -> tuple[tuple[int, int], ...]:
    """The next leases that an agent knows of, so that who missed them learns of them in time.

    :param own_is_said: the frame's lease bytes speak of the own turns already.
    :returns: (slots ahead, lessee), at most eight.
    """
    known = []
    for ahead in range(1, min(RELAY_REACH, memory.window - 1) + 1):
        lease = memory.leases.get(slot + ahead)
        if lease is None or (own_is_said and memory.owner(slot + ahead) == self_index):
            continue
        known.append((ahead, lease.lessee))
    return tuple(known[:RELAY_IDS])
