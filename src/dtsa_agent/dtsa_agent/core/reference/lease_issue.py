"""Policy ``lease``: the leases in a frame (docs/reference/protocol.md, "Giving turns away")."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from dtsa_agent.core.frame import ExtendedFrame, Frame

from .arithmetic import Vector, minus, norm, norm1
from .frame import FAR_REACH, LEASE_ROOM, OPEN, RELAY_IDS, RELAY_REACH, SECTION_BYTES
from .lease import HANDED, MISSED, Lease, Memory
from .table import Table

NEED, MAX_NEED = 50.0, 6000.0  # NEED: s/m
HAND_ON_FACTOR = 2  # a mover hands on turns that are worth so many times as much to another agent


@dataclass(slots=True)
class LeaseCandidates:
    """Agents that may be given turns, agents that rest, and a forecast of which agent sends when."""

    alive: int  # N_alive: this agent and the agents heard of lately
    able: list[bool]  # members of A_p that live, are not in probation and do not miss their turns
    rests: list[bool]  # live, are not in A_p and not in probation: they give turns away, as far as is known
    settled: list[bool]  # rest at their final goals
    final: bool  # this agent is at its final goal, if it rests
    block: int  # one turn in so many is OPEN; 0: none
    informed: bool  # all agents have sent, or all goals are known to all
    need: list[int]  # weight of each: grows with the last change of its velocity
    last: list[int]  # slot in which each sent last, or is predicted to send
    end: int  # senders are predicted up to here, excluded
    rights: list[list[int]] = field(default_factory=list)  # coming slots in which each is predicted to send

    @property
    def members(self) -> int:
        """N_p, number of agents that are able."""
        return sum(self.able)


def announce_turns(
    memory: Memory, table: Table, own: Frame, slot: int, velocity: Vector, final: bool, leaves: bool
) -> ExtendedFrame:
    """The agent's frame but for gossip; the turns that it gives away are noted. ``own``: what it says of itself."""
    own_turn = memory.owner(slot) == memory.me
    memory.spoke = slot
    leaving = memory.leaving = own_turn and leaves
    claims = memory.rules.adoption and not memory.probation and not leaving
    c_s = count_absent_before(memory, slot) if claims else 0
    candidates = find_candidates(memory, table, slot, velocity, final)
    leases = b""
    if own_turn:
        depth = 0 if leaving else lease_depth(memory, candidates, slot)
        leases = issue_leases(memory, replace(candidates, last=list(candidates.last)), slot, c_s, depth)
    handed = hand_on_turns(memory, candidates, slot, leases)
    near = [turn for turn in handed if turn - slot <= RELAY_REACH]
    far = tuple(turn - slot for turn in handed if turn - slot > RELAY_REACH)
    lessee = memory.leases[handed[-1]].lessee if far else 0
    relay = relay_leases(memory, slot, near, in_leases=bool(leases))
    return ExtendedFrame(own, c_s, leaving, memory.probation, (), leases, relay, far, lessee)


def count_absent_before(memory: Memory, slot: int) -> int:
    """c_s: number of consecutive ids before an agent's that are absent."""
    n, count = memory.rules.agents, 0
    while count < n - 1 and memory.absent((memory.me - 1 - count) % n, slot):
        count += 1
    return count


def find_candidates(memory: Memory, table: Table, slot: int, velocity: Vector, final: bool) -> LeaseCandidates:
    """Find the agents that may be given a turn, and the resting ones."""
    n, me, rows = memory.rules.agents, memory.me, table.rows
    presumed = [is_presumed(memory, table, k, slot) for k in range(n)]
    alive = [k == me or presumed[k] or memory.is_connected(k) for k in range(n)]
    moves = [sets_out(memory, table, k) if presumed[k] else rows[k].in_ap for k in range(n)]
    able = [alive[k] and moves[k] and not memory.quiet[k] and memory.missed[k] < MISSED for k in range(n)]
    able[me] = memory.moving
    rests = [alive[k] and not moves[k] and not memory.quiet[k] for k in range(n)]
    rests[me] = not memory.moving and not memory.probation
    settled = [rests[k] and (presumed[k] or memory.settled[k]) for k in range(n)]
    settled[me] = rests[me] and final
    innovation = [row.innovation for row in rows]
    innovation[me] = norm1(minus(velocity, rows[me].velocity))  # of the frame that is being made
    return LeaseCandidates(
        sum(alive), able, rests, settled, final,
        block=open_block(n, memory.rules.open_every, sum(rests), sum(settled)),
        informed=slot >= n or table.known_goals is not None, need=[need_of(change) for change in innovation],
        last=[row.sent_slot if row.sent_slot >= 0 else slot - n for row in rows], end=slot + 1,
    )  # fmt: skip


def need_of(innovation: float) -> int:
    """Weight of an agent's wait: 1, and 1 more for each 2 cm/s by which its velocity has just changed.

    After a turn, receivers extrapolate a velocity that the agent may not keep.
    """
    more = NEED * innovation
    return 1 + int(more if more < MAX_NEED else MAX_NEED)


def is_presumed(memory: Memory, table: Table, k: int, slot: int) -> bool:
    """Whether only start and goal of an agent are known: in the first round, before its first frame."""
    first_round = memory.born == 0 and slot < memory.rules.agents
    unheard = table.rows[k].sent_slot < 0 and not memory.absent(k, slot)
    return first_round and table.known_goals is not None and unheard


def sets_out(memory: Memory, table: Table, k: int) -> bool:
    """Whether an agent has something to say when it starts (eq:remaining_t_slots)."""
    assert table.known_goals is not None
    return norm(minus(table.known_goals[k], table.start[k])) > memory.rules.r_min


def open_block(agents: int, every: int, resting: int, settled: int) -> int:
    """B: one turn in B slots is OPEN, for agents that start moving; 0: none.

    B slots contain S (``every``) turns of resting agents, and half as many more if all of these have settled: are at
    their final goals. B has no factor in common with N: otherwise the same few owners would always give their turns.
    """
    if not every or not resting:
        return 0
    block = -(-every * agents // resting)  # rounded up
    if settled == resting:
        block += block // 2
    while math.gcd(block, agents) > 1:
        block += 1
    return block


def lease_depth(memory: Memory, candidates: LeaseCandidates, slot: int) -> int:
    """Number of next turns that a resting agent gives away: all at its final goal, else floor(c x idle rounds)."""
    rules = memory.rules
    if memory.idle_since < 0 or not candidates.members or memory.deaf:
        return 0
    if candidates.members > rules.lease_share * candidates.alive:
        return 0
    if candidates.final:
        return rules.main_every if candidates.informed else 1
    turns = rules.depth_rate * (slot - memory.idle_since) / rules.agents
    return int(min(turns, rules.anchor_every))


def is_open(memory: Memory, candidates: LeaseCandidates, turn: int) -> bool:
    """Whether a turn is OPEN, for agents that start moving: the first in its block that its owner gives away."""
    if not candidates.block:
        return False
    first = max(turn - turn % candidates.block, turn - 2 * memory.rules.agents)
    return not any(is_spare(memory, candidates, t) for t in range(first, turn))


def is_spare(memory: Memory, candidates: LeaseCandidates, turn: int) -> bool:
    """Whether a turn is one that its owner gives away, as far as is known."""
    owner = memory.owner(turn)
    kept = memory.is_main(turn) if candidates.settled[owner] else memory.is_anchor(turn)
    return candidates.rests[owner] and turn >= memory.rules.agents and not kept


def issue_leases(memory: Memory, candidates: LeaseCandidates, slot: int, c_s: int, depth: int) -> bytes:
    """Give away turns; return the lease bytes of a frame in an own turn, with the leases given before.

    :param c_s: number of absent agents before this one, whose turns it gives away.
    :param depth: number of own turns to give away.
    :returns: a byte a turn, up to the last that is given away.
    """
    rounds_adopted = memory.rules.anchor_every if memory.idle_since >= 0 else 1
    lessees = []
    for turn in memory.turns_of_leases(slot, c_s, LEASE_ROOM):
        mine = memory.owner(turn) == memory.me
        rounds_ahead = -(-(turn - slot) // memory.rules.agents)  # rounded up
        if mine and not candidates.final and memory.is_anchor(turn):
            depth = 0
        if turn not in memory.leases and rounds_ahead <= (depth if mine else rounds_adopted) and not memory.probation:
            lessee = 0
            if mine and is_open(memory, candidates, turn):
                lessee = OPEN
            elif candidates.members and (mine or not memory.deaf):
                if candidates.end == slot + 1:
                    candidates.rights = turns_ahead(memory, slot)
                predict_senders(memory, candidates, turn)
                lessee = choose_lessee(candidates, turn) + 1
            if lessee:
                memory.leases[turn] = Lease(lessee, memory.me + 1)
        lessees.append(memory.leases[turn].lessee if turn in memory.leases else 0)
    return bytes(lessees).rstrip(b"\0")


def turns_ahead(memory: Memory, slot: int) -> list[list[int]]:
    """Return, for each agent, the coming slots in which it is predicted to send."""
    rights: list[list[int]] = [[] for _ in range(memory.rules.agents)]
    for turn in range(slot + 1, slot + memory.window):
        sender = memory.scheduled(turn)
        if sender >= 0:
            rights[sender].append(turn)
    return rights


def predict_senders(memory: Memory, candidates: LeaseCandidates, end: int) -> None:
    """Predict the senders of the turns up to ``end``, excluded: move `last` forward."""
    for turn in range(candidates.end, end):
        sender = memory.scheduled(turn)
        if sender >= 0:
            candidates.last[sender] = turn
    candidates.end = end


def worth(candidates: LeaseCandidates, k: int, turn: int) -> int:
    """Worth of a turn to an agent: p min(n, m), times its need.

    p and n are the distances from the turn to the agent's previous and next slot, as known or predicted;
    p is N + 1 at most. p n is what the turn takes off the sum of its ages; n is cut off at m = N_p, because more leases
    will come in between.
    """
    longest = len(candidates.last) + 1
    before = min(turn - candidates.last[k], longest)
    after = next((right - turn for right in candidates.rights[k] if right > turn), longest)
    return before * min(after, candidates.members) * candidates.need[k]


def choose_lessee(candidates: LeaseCandidates, turn: int, but: int = -1) -> int:
    """Return the agent to which a turn is worth most, the lowest id of several, ``but`` left out; -1: none is able."""
    able = [k for k, is_able in enumerate(candidates.able) if is_able and k != but]
    return max(able, key=lambda k: worth(candidates, k, turn), default=-1)  # the first of several


def hand_on_turns(memory: Memory, candidates: LeaseCandidates, slot: int, leases: bytes) -> list[int]:
    """Hand on turns leased to the agent; not the next slot's: frames may arrive late.

    A resting agent hands on all within reach, but its last one, in which it can hand on further turns; beyond the
    relay's reach all go to the one agent to which the first of them is worth most. A moving agent hands on those within
    the relay's reach that are worth much more to another agent. No turn goes back to its owner, which gave it away.

    :param leases: the frame's lease bytes; with more than one section of them there is no room for a far lessee.
    :returns: the turns handed on; at most eight within the relay's reach, the others to one agent.
    """
    me, idle, handed = memory.me, memory.idle_since >= 0, list[int]()
    if not memory.rules.open_every or not memory.rules.adoption or memory.probation or memory.deaf:
        return handed
    reach = FAR_REACH if idle and len(leases) <= SECTION_BYTES else RELAY_REACH
    mine = [t for t in range(slot + 2, slot + min(reach, memory.window - 1) + 1) if memory.scheduled(t) == me]
    candidates.rights = turns_ahead(memory, slot)
    candidates.last[me] = slot
    far_lessee = -1  # of all turns beyond the relay's reach
    for turn in mine[:-1] if idle else mine:
        far = turn - slot > RELAY_REACH
        if turn not in memory.leases or (not far and len(handed) == RELAY_IDS):
            continue
        k = far_lessee
        if not far or far_lessee < 0:
            predict_senders(memory, candidates, turn)
            k = choose_lessee(candidates, turn, but=me)
        if k < 0 or k == memory.owner(turn):
            continue
        if idle or worth(candidates, k, turn) >= HAND_ON_FACTOR * worth(candidates, me, turn):
            memory.leases[turn] = Lease(k + 1, HANDED)
            handed.append(turn)
            far_lessee = k if far else -1
    return handed


def relay_leases(memory: Memory, slot: int, handed: list[int], in_leases: bool) -> tuple[tuple[int, int], ...]:
    """Return the leases to relay: those handed on now, and the next known ones, for agents that missed their frames.

    :param in_leases: whether the frame's lease bytes have the own turns already.
    :returns: (slots ahead, lessee), at most eight.
    """
    turns = list(handed)
    for turn in range(slot + 1, slot + min(RELAY_REACH, memory.window - 1) + 1):
        is_named = in_leases and memory.owner(turn) == memory.me
        if turn in memory.leases and turn not in handed and not is_named and len(turns) < RELAY_IDS:
            turns.append(turn)
    return tuple((turn - slot, memory.leases[turn].lessee) for turn in sorted(turns))
