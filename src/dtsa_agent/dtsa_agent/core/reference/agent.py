"""One agent in a slot: what it decides, what it says, and what it makes of what it hears.

One slot i goes, everywhere and always, in this order: :meth:`Agent.decide` and :meth:`Agent.frame` from what was heard
before slot i, then flight, then :meth:`Agent.hear` once a frame, then :meth:`Agent.end`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from dtsa_agent.core.frame import ExtendedFrame, Frame

from . import lease, policies
from .arithmetic import ZERO, Vector, minus, norm
from .frame import (
    OPEN,
    PROFILE_EXTENDED,
    PROFILE_PAPER,
    SECTION_BYTES,
    SECTIONS,
    WRONG_HEADER,
    Refused,
    decode,
    decode_extended,
    encode,
    encode_extended,
)  # fmt: skip
from .lease_issue import announce_turns
from .policies import NOBODY, Choice
from .table import LEAVES, OFF, ON, Rules, Table


@dataclass(slots=True)
class Agent:
    """One agent: its own state, its table, and what its policy remembers."""

    table: Table
    position: Vector = ZERO  # m, frame map, true state
    velocity: Vector = ZERO  # m/s
    command: Vector = ZERO  # m/s, commanded velocity
    goal: Vector = ZERO  # m
    final: bool = True  # no further goal is scheduled
    present: int = ON
    sends: bool = False  # in this slot
    choice: Choice = NOBODY  # of this slot
    rules: Rules = field(init=False)
    index: int = field(init=False)  # id - 1
    memory: lease.Memory = field(init=False)

    def __post_init__(self) -> None:
        self.rules, self.index = self.table.rules, self.table.observer - 1
        self.memory = lease.Memory(self.rules, self.index)

    def restart(self) -> None:
        """Its program starts anew, knowing nothing but its settings; where it is and flies stays."""
        self.table.reset()
        self.memory = lease.Memory(self.rules, self.index)

    def far_from_goal(self) -> bool:
        """Whether it has something to say: p_e > r_min (eq:remaining_t_slots)."""
        return norm(minus(self.goal, self.position)) > self.rules.r_min

    def decide(self, slot: int) -> Choice:
        """Who sends in a slot, in the agent's eyes; if it is itself, it sends."""
        self.choice = self._decide(slot)
        self.sends = self.choice.index == self.index and self.present != OFF
        return self.choice

    def _decide(self, slot: int) -> Choice:
        if self.rules.policy != "lease":
            return policies.choose(self.table, slot)
        if self.present != OFF:
            return lease.decide(self.memory, slot, self.far_from_goal())
        if self.memory.started:
            self.restart()  # whatever it knew is gone when it comes back
        return NOBODY

    def frame(self, slot: int) -> bytes:
        """The frame that the agent sends in a slot."""
        rules = self.rules
        c_r = rules.c_r if self.far_from_goal() else 0
        intent = None if rules.profile == PROFILE_PAPER else self.command
        own = Frame(self.index + 1, rules.slot_on_air(slot), c_r, self.position, self.velocity, intent)
        if rules.profile != PROFILE_EXTENDED:
            return encode(own, rules.position_step)
        frame = ExtendedFrame(own)
        if rules.policy == "lease":
            leaves = self.present == LEAVES
            frame = announce_turns(self.memory, self.table, own, slot, self.velocity, self.final, leaves)
        if rules.gossip:
            room = SECTIONS - (-(-len(frame.leases) // SECTION_BYTES) + bool(frame.relay) + bool(frame.far))
            frame = replace(frame, gossip=self.table.collect_gossip(slot, room))
        return encode_extended(frame, rules.position_step)

    def end(self, slot: int) -> None:
        """The slot is over: counters and silence, after :meth:`remember_own` and all that was heard."""
        if self.rules.policy != "lease":
            if self.choice.index >= 0:
                self.table.note_turn(self.choice.index, slot)
        elif self.present != OFF and self.memory.started:
            lease.end_slot(self.memory, slot, self.sends, self.choice.reason)
            if self.memory.leaving:
                self.present = OFF

    def remember_own(self, slot: int, sent: bytes) -> None:
        """A sender knows what it said, whether or not anybody heard it: its own entry is the last sent state.

        A frame in an OPEN turn is left out: others may send there, too, and gossip says whether it was heard.
        """
        if sent and self.choice.reason != "open" and self.table.rows[self.index].sent_slot != slot:
            self.table.learn(decode(sent, self.rules.position_step), slot)

    def hear(self, frame: ExtendedFrame, sampled: int) -> None:
        """Receive a frame that was sent in a slot: the present one, or the one before."""
        own, table = frame.own, self.table
        row = table.rows[own.sender - 1]
        wakes = not row.in_ap and own.c_r != 0
        if row.sent_slot < sampled:
            table.learn(own, sampled)
        if table.observer == own.sender:
            return
        for entry in frame.gossip:
            if entry.agent != table.observer:
                table.learn_gossip(entry, sampled - entry.age)
        if self.rules.policy == "lease":
            lease.listen(self.memory, table, sampled, frame, wakes)


class Foreign(Exception):
    """A frame of an unknown agent or of another time."""


def parse(data: bytes, slot: int, rules: Rules) -> tuple[ExtendedFrame, int]:
    """What the air carried, and the slot in which it was sent: the present one, or the one before.

    :raises RemoteProtocolError: if they are no frame of the swarm's kind.
    :raises Foreign: for a frame of an unknown agent or of another time.
    """
    if rules.profile == PROFILE_EXTENDED:
        frame = decode_extended(data, rules.position_step)
    else:
        frame = ExtendedFrame(decode(data, rules.position_step))
        if data[0] & 0xF == PROFILE_EXTENDED:
            raise Refused(WRONG_HEADER, data)
    own = frame.own
    sampled = slot - (own.slot != rules.slot_on_air(slot))
    if sampled < 0 or own.slot != rules.slot_on_air(sampled) or own.sender > rules.agents:
        raise Foreign
    if rules.profile == PROFILE_EXTENDED and not fits_swarm(frame, sampled, rules):
        raise Foreign
    return frame, sampled


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
