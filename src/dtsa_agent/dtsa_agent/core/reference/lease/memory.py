"""What an agent remembers under policy ``lease``, and what that says about a turn."""

from __future__ import annotations

from dataclasses import dataclass, field

from dtsa_agent.core.reference.frame import OPEN
from dtsa_agent.core.reference.table import Rules

DEAF = 4  # more silent slots in a row than this, and an agent is presumed deaf
MISSED = 4  # who missed so many expected turns gets no leases
GONE = -(2**61)  # in ``heard``: said that it leaves
HANDED = 255  # in place of an issuer: the agent itself was given the turn, and has handed it on
NEVER = -1  # in ``heard``, ``woke``, ``idle_since``, ``spoke``


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
