"""Policy ``lease``: the leases in a frame (docs/reference/protocol.md, "Giving turns away")."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from dtsa_agent.core.reference.arithmetic import Vector, minus, norm, norm1
from dtsa_agent.core.reference.frame_extended import FAR_REACH, LEASE_ROOM, OPEN, RELAY_IDS, RELAY_REACH, SECTION_BYTES
from dtsa_agent.core.reference.table import Table

from .memory import HANDED, MISSED, Lease, Memory

NEED, MAX_NEED = 50.0, 6000.0  # NEED: s/m
HAND_ON_FACTOR = 2  # a mover hands on turns that are worth so many times as much to another agent


@dataclass(frozen=True, slots=True)
class TurnAnnouncement:
    """Fields of a frame about turns."""

    c_s: int = 0
    leaving: bool = False
    leases: bytes = b""
    relay: tuple[tuple[int, int], ...] = ()
    far: tuple[int, ...] = ()
    far_lessee: int = 0


@dataclass(slots=True)
class LeaseCandidates:
    """Agents that may be given turns, agents that rest, and a forecast of which agent sends when."""

    alive: int  # N_alive: this agent and the agents heard of lately
    able: list[bool]  # members of A_p that live, are not in probation and do not miss their turns
    rests: list[bool]  # live, are not in A_p and not in probation: they give turns away, as far as is known
    settled: list[bool]  # rest at their final goals
    block: int  # one turn in so many is OPEN; 0: none
    informed: bool  # all agents have sent, or all goals are known to all
    last: list[int]  # slot in which each sent last, or is predicted to send
    need: list[int]  # weight of each: grows with the last change of its velocity
    rights: list[list[int]] = field(default_factory=list)  # coming slots in which each is predicted to send

    @property
    def members(self) -> int:
        """N_p, number of agents that are able."""
        return sum(self.able)


def announce_turns(
    memory: Memory, self_index: int, table: Table, slot: int, velocity: Vector, final: bool, leaves: bool
) -> TurnAnnouncement:
    """Fields of the agent's frame about turns; the turns that it gives away are noted.

    :param velocity: of the agent, m/s.
    """
    own_turn = memory.owner(slot) == self_index
    memory.spoke = slot
    leaving = memory.leaving = own_turn and leaves
    claims = memory.rules.adoption and not memory.probation and not leaving
    c_s = count_absent_before(memory, self_index, slot) if claims else 0
    leases = b""
    if own_turn:
        leases = issue_leases(memory, self_index, table, slot, velocity, c_s, 0 if leaving else None, final)
    handed = hand_on_turns(memory, self_index, table, slot, velocity, final, leases)
    near = [turn for turn in handed if turn - slot <= RELAY_REACH]
    far = tuple(turn - slot for turn in handed if turn - slot > RELAY_REACH)
    lessee = memory.leases[handed[-1]].lessee if far else 0
    return TurnAnnouncement(
        c_s, leaving, leases, relay_leases(memory, self_index, slot, near, in_leases=bool(leases)), far, lessee
    )


def count_absent_before(memory: Memory, self_index: int, slot: int) -> int:
    """c_s: number of consecutive ids before an agent's that are absent."""
    n, count = memory.rules.agents, 0
    while count < n - 1 and memory.absent((self_index - 1 - count) % n, slot):
        count += 1
    return count


def find_candidates(
    memory: Memory, self_index: int, table: Table, slot: int, velocity: Vector, final: bool
) -> LeaseCandidates:
    """Find the agents that may be given a turn, and the resting ones."""
    rows, agents = table.rows, range(memory.rules.agents)
    presumed = [is_presumed(memory, table, k, slot) for k in agents]
    alive = [k == self_index or presumed[k] or memory.is_connected(k) for k in agents]
    moves = [sets_out(memory, table, k) if presumed[k] else rows[k].in_ap for k in agents]
    able = [alive[k] and moves[k] and not memory.quiet[k] and memory.missed[k] < MISSED for k in agents]
    able[self_index] = memory.moving
    rests = [alive[k] and not moves[k] and not memory.quiet[k] for k in agents]
    rests[self_index] = not memory.moving and not memory.probation
    settled = [rests[k] and (presumed[k] or memory.settled[k]) for k in agents]
    settled[self_index] = rests[self_index] and final
    informed = slot >= memory.rules.agents or table.known_goals is not None
    last = [row.sent_slot if row.sent_slot >= 0 else slot - memory.rules.agents for row in rows]
    block = open_block(memory.rules.agents, memory.rules.open_every, sum(rests), sum(settled))
    innovation = [row.innovation for row in rows]
    innovation[self_index] = norm1(minus(velocity, rows[self_index].velocity))  # of the frame that is being made
    return LeaseCandidates(
        sum(alive), able, rests, settled, block, informed, last, [need_of(change) for change in innovation]
    )


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

    B slots contain S turns of resting agents, and half as many more if all of these are at their final goals. B has no
    factor in common with N: otherwise the same few owners would always give their turns.

    :param agents: N, number of agents.
    :param every: S, number of turns of resting agents of which one is OPEN.
    :param resting: number of resting agents.
    :param settled: number of these at their final goals.
    """
    if not every or not resting:
        return 0
    block = -(-every * agents // resting)  # rounded up
    if settled == resting:
        block += block // 2
    while math.gcd(block, agents) > 1:
        block += 1
    return block


def lease_depth(memory: Memory, candidates: LeaseCandidates, slot: int, final: bool) -> int:
    """Number of next turns that a resting agent gives away: all at its final goal, else floor(c x idle rounds)."""
    rules = memory.rules
    if memory.idle_since < 0 or not candidates.members or memory.deaf:
        return 0
    if candidates.members > rules.lease_share * candidates.alive:
        return 0
    if final:
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


def issue_leases(
    memory: Memory,
    self_index: int,
    table: Table,
    slot: int,
    velocity: Vector,
    c_s: int,
    own_depth: int | None,
    final: bool,
) -> bytes:
    """Give away turns; return the lease bytes of a frame in an own turn, with the leases given before.

    :param c_s: number of absent agents before this one, whose turns it gives away.
    :param own_depth: largest number of own turns to give away; None: by :func:`lease_depth`.
    :returns: a byte a turn, up to the last that is given away.
    """
    candidates = find_candidates(memory, self_index, table, slot, velocity, final)
    predicted_end = slot + 1  # up to here, excluded
    rounds_mine = lease_depth(memory, candidates, slot, final) if own_depth is None else own_depth
    rounds_adopted = memory.rules.anchor_every if memory.idle_since >= 0 else 1
    lessees = []
    for turn in memory.turns_of_leases(slot, c_s, LEASE_ROOM):
        mine = memory.owner(turn) == self_index
        rounds_ahead = -(-(turn - slot) // memory.rules.agents)  # rounded up
        if mine and not final and memory.is_anchor(turn):
            rounds_mine = 0
        reach = rounds_mine if mine else rounds_adopted
        if turn not in memory.leases and rounds_ahead <= reach and not memory.probation:
            lessee = 0
            if mine and is_open(memory, candidates, turn):
                lessee = OPEN
            elif candidates.members and (mine or not memory.deaf):
                if predicted_end == slot + 1:
                    candidates.rights = turns_ahead(memory, candidates, slot)
                predict_senders(memory, candidates, range(predicted_end, turn))
                predicted_end = turn
                lessee = choose_lessee(memory, candidates, turn) + 1
            if lessee:
                memory.leases[turn] = Lease(lessee, self_index + 1)
        lessees.append(memory.leases[turn].lessee if turn in memory.leases else 0)
    return bytes(lessees).rstrip(b"\0")


def turns_ahead(memory: Memory, candidates: LeaseCandidates, slot: int) -> list[list[int]]:
    """Return, for each agent, the coming slots in which it is predicted to send."""
    rights: list[list[int]] = [[] for _ in range(memory.rules.agents)]
    for turn in range(slot + 1, slot + memory.window):
        sender = memory.scheduled(turn)
        if sender >= 0:
            rights[sender].append(turn)
    return rights


def predict_senders(memory: Memory, candidates: LeaseCandidates, turns: range) -> None:
    """Predict the senders of some turns: move `last` forward."""
    for turn in turns:
        sender = memory.scheduled(turn)
        if sender >= 0:
            candidates.last[sender] = turn


def worth(memory: Memory, candidates: LeaseCandidates, k: int, turn: int) -> int:
    """Worth of a turn to an agent: p min(n, m), times its need.

    p and n are the distances from the turn to the agent's previous and next slot, as known or predicted;
    p is N + 1 at most. p n is what the turn takes off the sum of its ages; n is cut off at m = N_p, because more leases
    will come in between.
    """
    longest = memory.rules.agents + 1
    before = min(turn - candidates.last[k], longest)
    after = next((right - turn for right in candidates.rights[k] if right > turn), longest)
    return before * min(after, candidates.members) * candidates.need[k]


def choose_lessee(memory: Memory, candidates: LeaseCandidates, turn: int, but: int = -1) -> int:
    """Return the agent to which a turn is worth most, the lowest id of several; -1: no agent is able.

    :param but: index of an agent that is left out.
    """
    able = [k for k in range(memory.rules.agents) if candidates.able[k] and k != but]
    return max(able, key=lambda k: worth(memory, candidates, k, turn), default=-1)  # the first of several


def hand_on_turns(
    memory: Memory, self_index: int, table: Table, slot: int, velocity: Vector, final: bool, leases: bytes
) -> list[int]:
    """Hand on turns leased to the agent; not the next slot's: frames may arrive late.

    A resting agent hands on all within reach, but its last one, in which it can hand on further turns; beyond the
    relay's reach all go to the one agent to which the first of them is worth most. A moving agent hands on those within
    the relay's reach that are worth much more to another agent. No turn goes back to its owner, which gave it away.

    :param leases: the frame's lease bytes; with more than one section of them there is no room for a far lessee.
    :returns: the turns handed on; at most eight within the relay's reach, the others to one agent.
    """
    handed: list[int] = []
    idle = memory.idle_since >= 0
    if not memory.rules.open_every or not memory.rules.adoption or memory.probation or memory.deaf:
        return handed
    reach = FAR_REACH if idle and len(leases) <= SECTION_BYTES else RELAY_REACH
    mine = [t for t in range(slot + 2, slot + min(reach, memory.window - 1) + 1) if memory.scheduled(t) == self_index]
    leased = [t for t in (mine[:-1] if idle else mine) if t in memory.leases]
    if not leased:
        return handed
    candidates = find_candidates(memory, self_index, table, slot, velocity, final)
    candidates.rights = turns_ahead(memory, candidates, slot)
    candidates.last[self_index] = slot
    predicted_end = slot + 1  # up to here, excluded
    far_lessee = -1  # of all turns beyond the relay's reach
    for turn in leased:
        far = turn - slot > RELAY_REACH
        if not far and len(handed) == RELAY_IDS:
            continue
        k = far_lessee
        if not far or far_lessee < 0:
            predict_senders(memory, candidates, range(predicted_end, turn))
            predicted_end = turn
            k = choose_lessee(memory, candidates, turn, but=self_index)
        if k < 0 or k == memory.owner(turn):
            continue
        if idle or worth(memory, candidates, k, turn) >= HAND_ON_FACTOR * worth(memory, candidates, self_index, turn):
            memory.leases[turn] = Lease(k + 1, HANDED)
            handed.append(turn)
            far_lessee = k if far else -1
    return handed


def relay_leases(
    memory: Memory, self_index: int, slot: int, handed: list[int], in_leases: bool
) -> tuple[tuple[int, int], ...]:
    """Return the leases to relay: those handed on now, and the next known ones, for agents that missed their frames.

    :param in_leases: whether the frame's lease bytes have the own turns already.
    :returns: (slots ahead, lessee), at most eight.
    """
    turns = list(handed)
    for turn in range(slot + 1, slot + min(RELAY_REACH, memory.window - 1) + 1):
        is_named = in_leases and memory.owner(turn) == self_index
        if turn in memory.leases and turn not in handed and not is_named and len(turns) < RELAY_IDS:
            turns.append(turn)
    return tuple((turn - slot, memory.leases[turn].lessee) for turn in sorted(turns))
