"""Policy ``lease``: what an agent says about turns (docs/reference/protocol.md, "Giving turns away")."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from dtsa_agent.core.reference.arithmetic import Vector, minus, norm, norm1
from dtsa_agent.core.reference.frame_extended import FAR_REACH, LEASE_ROOM, OPEN, RELAY_IDS, RELAY_REACH, SECTION_BYTES
from dtsa_agent.core.reference.table import Table

from .memory import HANDED, MISSED, Lease, Memory

NEED, MOST_NEED = 50.0, 6000.0  # NEED: s/m
MORE = 2  # a mover hands on turns that are worth so many times as much to another agent


@dataclass(frozen=True, slots=True)
class TurnAnnouncement:
    """What a frame says about turns."""

    c_s: int = 0
    leaving: bool = False
    leases: bytes = b""
    relay: tuple[tuple[int, int], ...] = ()
    far: tuple[int, ...] = ()
    far_lessee: int = 0


@dataclass(slots=True)
class Electorate:
    """Who may be given a turn, who rests, and what is known and foreseen of when each sends."""

    alive: int  # N_alive: me and those heard of lately
    able: list[bool]  # members of A_p that live, are not in probation and do not miss their turns
    rests: list[bool]  # live, are not in A_p and not in probation: they give turns away, as far as is known
    settled: list[bool]  # of these, who knows that it will rest
    block: int  # one turn in so many is OPEN; 0: none
    informed: bool  # all have spoken, or all know where all want to be
    last: list[int]  # slot in which each sent last, or is foreseen to send
    need: list[int]  # weight of each: more the more its velocity has just changed
    rights: list[list[int]] = field(default_factory=list)  # slots to come in which each is known to send

    @property
    def members(self) -> int:
        """N_p, those that are able."""
        return sum(self.able)


def announce_turns(
    memory: Memory, self_index: int, table: Table, slot: int, velocity: Vector, final: bool, leaves: bool
) -> TurnAnnouncement:
    """What the agent's frame says about turns; the turns that it gives away are noted.

    :param velocity: of the agent, m/s.
    """
    own_turn = memory.owner(slot) == self_index
    memory.spoke = slot
    leaving = memory.leaving = own_turn and leaves
    claims = memory.rules.adoption and not memory.probation and not leaving
    c_s = count_absent_before(memory, self_index, slot) if claims else 0
    leases = b""
    if own_turn:
        leases = issue(memory, self_index, table, slot, velocity, c_s, 0 if leaving else None, final)
    handed = hand_on(memory, self_index, table, slot, velocity, final, leases)
    near = [turn for turn in handed if turn - slot <= RELAY_REACH]
    far = tuple(turn - slot for turn in handed if turn - slot > RELAY_REACH)
    lessee = memory.leases[handed[-1]].lessee if far else 0
    return TurnAnnouncement(
        c_s, leaving, leases, relay(memory, self_index, slot, near, own_is_said=bool(leases)), far, lessee
    )


def count_absent_before(memory: Memory, self_index: int, slot: int) -> int:
    """c_s: the number of consecutive ids before an agent that it thinks dead."""
    n, count = memory.rules.agents, 0
    while count < n - 1 and memory.absent((self_index - 1 - count) % n, slot):
        count += 1
    return count


def electorate(memory: Memory, self_index: int, table: Table, slot: int, velocity: Vector, final: bool) -> Electorate:
    """Who may be given a turn, and who else there is."""
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
    return Electorate(
        sum(alive), able, rests, settled, block, informed, last, [need_of(change) for change in innovation]
    )


def need_of(innovation: float) -> int:
    """How much the wait of an agent counts: 1, and 1 more for each 2 cm/s by which its velocity has just changed.

    It has just turned, and others extrapolate a velocity that it may not keep.
    """
    more = NEED * innovation
    return 1 + int(more if more < MOST_NEED else MOST_NEED)


def is_presumed(memory: Memory, table: Table, k: int, slot: int) -> bool:
    """Whether nothing is known of an agent but where it starts and wants to be: in the first round."""
    first_round = memory.born == 0 and slot < memory.rules.agents
    unheard = table.rows[k].sent_slot < 0 and not memory.absent(k, slot)
    return first_round and table.known_goals is not None and unheard


def sets_out(memory: Memory, table: Table, k: int) -> bool:
    """Whether an agent has something to say when it starts (eq:remaining_t_slots)."""
    assert table.known_goals is not None
    return norm(minus(table.known_goals[k], table.start[k])) > memory.rules.r_min


def open_block(agents: int, every: int, resting: int, settled: int) -> int:
    """Slots of which one turn goes to agents that wake: S turns of those that rest lie in so many; 0: none.

    Half as many more where all of them are settled. It has no factor in common with N, or the same few owners would
    always pay.

    :param agents: N, number of agents.
    :param every: S, number of turns of those that rest of which one is an OPEN turn.
    :param resting: number of those that rest.
    :param settled: number of those of them that know that they will rest.
    """
    if not every or not resting:
        return 0
    block = -(-every * agents // resting)  # rounded up
    if settled == resting:
        block += block // 2
    while math.gcd(block, agents) > 1:
        block += 1
    return block


def depth(memory: Memory, voters: Electorate, slot: int, final: bool) -> int:
    """How many of its next turns an agent that rests gives away: all if it is final, else floor(c x idle rounds)."""
    rules = memory.rules
    if memory.idle_since < 0 or not voters.members or memory.deaf:
        return 0
    if voters.members > rules.lease_share * voters.alive:
        return 0
    if final:
        return rules.main_every if voters.informed else 1
    turns = rules.depth_rate * (slot - memory.idle_since) / rules.agents
    return int(min(turns, rules.anchor_every))


def is_open(memory: Memory, voters: Electorate, turn: int) -> bool:
    """Whether a turn goes to those who wake: the first one in its block that its owner gives away."""
    if not voters.block:
        return False
    first = max(turn - turn % voters.block, turn - 2 * memory.rules.agents)
    return not any(is_spare(memory, voters, t) for t in range(first, turn))


def is_spare(memory: Memory, voters: Electorate, turn: int) -> bool:
    """Whether a turn is one that its owner gives away, as far as is known."""
    owner = memory.owner(turn)
    kept = memory.is_main(turn) if voters.settled[owner] else memory.is_anchor(turn)
    return voters.rests[owner] and turn >= memory.rules.agents and not kept


def issue(
    memory: Memory,
    self_index: int,
    table: Table,
    slot: int,
    velocity: Vector,
    c_s: int,
    own_depth: int | None,
    final: bool,
) -> bytes:
    """The lease bytes of a frame in an own turn: what was given away before is said again, what is new is noted.

    :param c_s: number of agents before me whose turns I give away.
    :param own_depth: how many own turns at most; None: as :func:`depth` says.
    :returns: a byte a turn, up to the last that is given away.
    """
    voters = electorate(memory, self_index, table, slot, velocity, final)
    foreseen = slot + 1  # up to here, excluded
    rounds_mine = depth(memory, voters, slot, final) if own_depth is None else own_depth
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
            if mine and is_open(memory, voters, turn):
                lessee = OPEN
            elif voters.members and (mine or not memory.deaf):
                if foreseen == slot + 1:
                    voters.rights = turns_ahead(memory, voters, slot)
                foresee(memory, voters, range(foreseen, turn))
                foreseen = turn
                lessee = choose_lessee(memory, voters, turn) + 1
            if lessee:
                memory.leases[turn] = Lease(lessee, self_index + 1)
        lessees.append(memory.leases[turn].lessee if turn in memory.leases else 0)
    return bytes(lessees).rstrip(b"\0")


def turns_ahead(memory: Memory, voters: Electorate, slot: int) -> list[list[int]]:
    """For each agent the slots to come in which it is known to send."""
    rights: list[list[int]] = [[] for _ in range(memory.rules.agents)]
    for turn in range(slot + 1, slot + memory.window):
        sender = memory.scheduled(turn)
        if sender >= 0:
            rights[sender].append(turn)
    return rights


def foresee(memory: Memory, voters: Electorate, turns: range) -> None:
    """Who will send in the turns to come, as far as is known."""
    for turn in turns:
        sender = memory.scheduled(turn)
        if sender >= 0:
            voters.last[sender] = turn


def worth(memory: Memory, voters: Electorate, k: int, turn: int) -> int:
    """What a turn is worth to an agent: p min(n, m), times its need.

    p and n are the distances from the turn to the agent's previous and next slot, as far as they are known or foreseen;
    p is N + 1 at most. p n is what the turn takes off the sum of its ages; n is cut off at m = N_p, because more leases
    will come in between.
    """
    longest = memory.rules.agents + 1
    before = min(turn - voters.last[k], longest)
    after = next((right - turn for right in voters.rights[k] if right > turn), longest)
    return before * min(after, voters.members) * voters.need[k]


def choose_lessee(memory: Memory, voters: Electorate, turn: int, but: int = -1) -> int:
    """To whom a turn is worth most, the lowest id of several; -1: nobody is able.

    :param but: index of an agent that is not asked.
    """
    able = [k for k in range(memory.rules.agents) if voters.able[k] and k != but]
    return max(able, key=lambda k: worth(memory, voters, k, turn), default=-1)  # the first of several


def hand_on(
    memory: Memory, self_index: int, table: Table, slot: int, velocity: Vector, final: bool, leases: bytes
) -> list[int]:
    """Hand on turns that the agent was given; not the next slot's: frames may arrive late.

    If it rests, all within reach that come before its last turn there, in which it can hand on further ones; beyond the
    relay's reach all to one agent, to whom the first of them is worth most. If it moves, those within the relay's reach
    that are worth much more to another agent. The turn's owner, which has given it away, is left out.

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
    voters = electorate(memory, self_index, table, slot, velocity, final)
    voters.rights = turns_ahead(memory, voters, slot)
    voters.last[self_index] = slot
    foreseen = slot + 1  # up to here, excluded
    heir = -1  # to whom all turns beyond the relay's reach go
    for turn in leased:
        far = turn - slot > RELAY_REACH
        if not far and len(handed) == RELAY_IDS:
            continue
        k = heir
        if not far or heir < 0:
            foresee(memory, voters, range(foreseen, turn))
            foreseen = turn
            k = choose_lessee(memory, voters, turn, but=self_index)
        if k < 0 or k == memory.owner(turn):
            continue
        if idle or worth(memory, voters, k, turn) >= MORE * worth(memory, voters, self_index, turn):
            memory.leases[turn] = Lease(k + 1, HANDED)
            handed.append(turn)
            heir = k if far else -1
    return handed


def relay(
    memory: Memory, self_index: int, slot: int, handed: list[int], own_is_said: bool
) -> tuple[tuple[int, int], ...]:
    """Leases that an agent hands on now, and the next ones that it knows of: who missed them learns of them in time.

    :param own_is_said: the frame's lease bytes speak of the own turns already.
    :returns: (slots ahead, lessee), at most eight.
    """
    turns = list(handed)
    for turn in range(slot + 1, slot + min(RELAY_REACH, memory.window - 1) + 1):
        is_named = own_is_said and memory.owner(turn) == self_index
        if turn in memory.leases and turn not in handed and not is_named and len(turns) < RELAY_IDS:
            turns.append(turn)
    return tuple((turn - slot, memory.leases[turn].lessee) for turn in sorted(turns))
