"""Policy ``lease``: what an agent remembers, who sends in a slot as it sees it, and what frames and silence change.

docs/reference/protocol.md, "Who sends in slot T" and "States and events of an agent".
"""

from __future__ import annotations

from dataclasses import dataclass, field

from dtsa_agent.core.frame import ExtendedFrame, Gossip

from .arithmetic import mix64, share_of
from .frame import OPEN
from .policies import Choice
from .table import Rules, Table

DEAF = 4  # more silent slots in a row than this, and an agent is presumed deaf
MISSED = 4  # who missed so many expected turns gets no leases
GONE = -(2**61)  # in ``heard``: said that it leaves
HANDED = 255  # in place of an issuer: the agent itself was given the turn, and has handed it on
NEVER = -1  # in ``heard``, ``woke``, ``idle_since``, ``spoke``
_OPEN_DRAW = 0x4F50454E  # "OPEN": these draws are none of another policy's


@dataclass(slots=True)
class Lease:
    """A turn that is given away."""

    lessee: int  # id, or OPEN
    issuer: int  # id of who gave it away, 0: known by a relay only; HANDED


@dataclass(slots=True)
class Memory:
    """What one agent remembers since it started; everything is forgotten when it restarts.

    Agents are numbered from 0 in here, but for the ids in leases.
    """

    rules: Rules
    me: int = 0  # index of the agent itself
    started: bool = False
    born: int = 0  # slot of the first decision
    now: int = 0  # the present slot
    leases: dict[int, Lease] = field(default_factory=dict)  # by turn, of turns to come
    heard: list[int] = field(default_factory=list)  # last slot of which it is known that each lived; NEVER, GONE
    missed: list[int] = field(default_factory=list)  # expected turns that each missed in a row
    quiet: list[bool] = field(default_factory=list)  # in probation: sends in anchors only
    settled: list[bool] = field(default_factory=list)  # gives anchors away, for it knows that it will rest
    resting: list[bool] = field(default_factory=list)  # had nothing to say in its last frame
    moving: bool = False
    idle_since: int = NEVER
    woke: int = NEVER  # slot in which it woke or joined, and since when nobody is known to have heard it
    attempts: int = 0  # frames in OPEN turns since then
    wakers: float = 0.0  # w: about so many agents woke in the last N slots
    silence: int = 0  # own silence: silent slots in a row
    expected: int = -1  # who was expected in this slot, -1: nobody in particular
    heard_now: bool = False  # something was heard in this slot
    probation: bool = False
    anchored: bool = False  # an own anchor is over since probation began
    claimed: int = 0  # slot in which probation began or was last confirmed
    spoke: int = NEVER  # slot of its last frame
    leaving: bool = False  # said in this slot that it leaves

    def patience(self, k: int) -> int:
        """Slots without a sign of life after which an agent is thought absent: six times as many as it may be silent.

        Who rests may speak in its main anchors only, and so may who was never heard.
        """
        rests = self.resting[k] or self.heard[k] == NEVER
        return max(1000, 6 * (self.rules.main_every if rests else self.rules.anchor_every) * self.rules.agents)

    @property
    def window(self) -> int:
        """Turns ahead, the present one included, that can be remembered: more than any lease reaches."""
        return (self.rules.main_every + 2) * self.rules.agents

    @property
    def deaf(self) -> bool:
        """More silence than can be by chance."""
        return self.silence > DEAF

    def owner(self, slot: int) -> int:
        """Whose turn a slot is if nobody gave it away."""
        return slot % self.rules.agents

    def is_anchor(self, slot: int) -> bool:
        """Whether nobody but its owner may give a slot away: (R + T mod N) mod M = 0."""
        n = self.rules.agents
        return (slot // n + slot % n) % self.rules.anchor_every == 0

    def is_main(self, slot: int) -> bool:
        """Whether a slot is its owner's whatever happens, a main anchor: (R + T mod N) mod (K M) = 0."""
        n = self.rules.agents
        return (slot // n + slot % n) % self.rules.main_every == 0

    def is_connected(self, k: int) -> bool:
        """Whether an agent was heard of lately."""
        return self.heard[k] >= 0 and self.now - self.heard[k] <= self.patience(k)

    def absent(self, k: int, slot: int) -> bool:
        """Whether an agent is thought dead: no sign of life for long, or it said that it leaves."""
        sign = self.born if self.heard[k] == NEVER else self.heard[k]
        return slot - sign > self.patience(k)

    def scheduled(self, turn: int) -> int:
        """Who is expected in a turn, -1: nobody in particular."""
        lease = self.leases.get(turn)
        if lease is not None:
            return -1 if lease.lessee == OPEN else lease.lessee - 1
        owner = self.owner(turn)
        if self.absent(owner, turn) or (self.quiet[owner] and not self.is_anchor(turn)):
            return -1
        return owner

    def note(self, slot: int, sender: int, turn: int, lessee: int, issuer: int) -> None:
        """Note what a frame says of a turn.

        The lessee may hand the turn on, in a frame of its own; what is relayed later changes nothing. So a turn can
        come back to the agent itself, but not by an older frame than its own last one, which may not know what that
        said of the turn. Of two that gave the turn away, which adoption alone can cause, the smaller lessee stays, so
        that all who know both agree.

        :param slot: of the frame.
        :param issuer: id of who gave it away, 0: the sender relays it.
        """
        if not self.now < turn < self.now + self.window or self.is_main(turn):
            return
        entry, mine = self.leases.get(turn), lessee == self.me + 1
        if entry is None:
            self.leases[turn] = Lease(lessee, issuer)
        elif lessee == entry.lessee:
            entry.issuer = entry.issuer or issuer
        elif sender == entry.lessee:
            if not mine:
                entry.lessee = lessee
            elif slot > self.spoke:
                self.leases[turn] = Lease(lessee, 0)
        elif entry.issuer not in (0, issuer, self.me + 1, HANDED) and issuer and lessee < entry.lessee:
            self.leases[turn] = Lease(lessee, issuer)

    def turns_of_leases(self, slot: int, c_s: int, room: int) -> list[int]:
        """The turns that the lease bytes of a frame speak of, in order; the same for sender and receiver.

        T + j N - i for j = 1 .. K M, and within each j for i = c_s .. 0; anchors of others (i > 0) are left out, and of
        the sender's own turns (i = 0) those from its next main anchor on.
        """
        turns, own = [], True
        for j in range(1, self.rules.main_every + 1):
            for i in range(c_s, -1, -1):
                turn = slot + j * self.rules.agents - i
                if i == 0 and self.is_main(turn):
                    own = False
                if not self.is_anchor(turn) if i > 0 else own:
                    turns.append(turn)
        return turns[:room]

    def start(self, slot: int) -> None:
        """The first slot.

        An agent that begins with slot 0 begins with everybody else. One that comes later may have flown before, and may
        have given turns away that it knows nothing of.
        """
        n = self.rules.agents
        self.started = True
        self.born = self.now = self.claimed = slot
        self.heard, self.missed = [NEVER] * n, [0] * n
        self.quiet, self.settled, self.resting = ([False] * n for _ in range(3))
        if slot > 0:
            self.probation = True
            self.woke = slot

    def roll(self, slot: int) -> None:
        """A slot begins: earlier turns are over; the estimate of how many woke falls."""
        for turn in [turn for turn in self.leases if turn < slot]:
            del self.leases[turn]
        self.now = self.heard[self.me] = slot
        self.wakers -= self.wakers / self.rules.agents


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
            table.learn_gossip(entry, alive)
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
