"""The settings that all agents share, and what one observer believes about all of them: one row an agent."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from dtsa_agent.core.frame import Frame

from .arithmetic import ZERO, Vector, bits_of, minus, mix64, norm1

OFF, ON, LEAVES = 0, 1, 2  # of an agent: not there, there, about to be switched off
PROFILES = PAPER, PAPER_INTENT, EXTENDED = "paper", "paper-intent", "extended"  # of frames


@dataclass(frozen=True, slots=True)
class Rules:
    """What all agents of one swarm must agree on."""

    agents: int  # N
    slot_s: float  # t_s, s
    steps: int = 1  # control instants in a slot
    policy: str = "dtsa"
    estimator: str = "linear"
    tau: float = 0.25  # s, time constant of the vehicles (estimator intent)
    # dtsa
    selection: str = "candidates"
    epsilon: float = 0.5  # eq:pfs
    age_cap: float = 1.5
    boot_round: bool = True
    return_every: int = 20
    # frames
    profile: str = PAPER
    position_step: float = 0.002  # m
    r_min: float = 0.3  # m, eq:remaining_t_slots
    c_r: int = 1  # C, eq:remaining_t_slots
    targets_known: bool = True  # who has arrived is taken to stand at its target
    gossip: bool = True
    key: int = 0  # of the draws
    # lease
    anchor_every: int = 3  # M
    main_every: int = 3  # K M
    open_every: int = 11  # S; 0: none
    adoption: bool = True
    depth_rate: float = 0.5  # c
    lease_share: float = 1.0

    @property
    def slot_cycle(self) -> int:
        """Slot numbers on the air count modulo this: a multiple of all that policies count in slots."""
        period = math.lcm(2 * self.agents * self.main_every, max(self.open_every, 1))
        return 2**32 // period * period

    def slot_on_air(self, slot: int) -> int:
        """The number of a slot as frames have it."""
        return slot % self.slot_cycle

    @property
    def dt(self) -> float:
        """Control period, s."""
        return self.slot_s / self.steps


@dataclass(slots=True)
class Row:
    """What is known of one agent: the last state heard of it (own row: last sent), as it was on the air."""

    position: Vector  # m, frame map
    velocity: Vector = ZERO  # m/s
    intent: Vector = ZERO  # m/s, commanded velocity, zero where frames do not carry it
    innovation: float = 0.0  # m/s, change of velocity in that state against the one before: sum over the axes
    sent_slot: int = -1  # m in eq:estimate: slot of that state, -1: never heard
    last_turn: int = -1  # slot of its last turn
    in_ap: bool = True  # it is a member of A_p: it has something to say
    digest: int = 0  # of this row, 32 bits

    def h(self, slot: int) -> int:
        """Slots since the agent's last turn, h (eq:secondary)."""
        return slot - 1 - self.last_turn


@dataclass(slots=True)
class Table:
    """What one observer knows.

    :param known_goals: where those that rest are taken to stand, m; None: nobody knows that.
    :param by_innovation: decisions depend on the innovation, too, so digests do.
    """

    observer: int
    start: Sequence[Vector]
    known_goals: Sequence[Vector] | None = None
    by_innovation: bool = False
    rows: list[Row] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Knows nothing but the settings: all are at their starts and have something to say."""
        self.rows = [Row(position) for position in self.start]
        for index in range(len(self.rows)):
            self._digest_row(index)

    def learn(self, frame: Frame, sampled: int) -> None:
        """Receive the state that an agent has sent.

        Whoever says c_r = 0 leaves A_p; where all know its target it is then taken to stand there, at rest.
        """
        row, rests = self.rows[frame.sender - 1], frame.c_r == 0
        row.position = self.known_goals[frame.sender - 1] if rests and self.known_goals is not None else frame.position
        velocity = ZERO if rests else frame.velocity
        row.innovation, row.velocity = norm1(minus(velocity, row.velocity)), velocity
        row.intent = ZERO if rests or frame.intent is None else frame.intent
        row.sent_slot = sampled
        row.in_ap = not rests
        row.last_turn = max(row.last_turn, sampled)
        self._digest_row(frame.sender - 1)

    def note_turn(self, index: int, slot: int) -> None:
        """An agent was taken for the sender of a slot: its counter h begins anew (eq:secondary)."""
        row = self.rows[index]
        if row.last_turn < slot:
            row.last_turn = slot
            self._digest_row(index)

    @property
    def digest(self) -> int:
        """32 bits over everything that decisions depend on: equal digests, equal tables."""
        total = 0
        for row in self.rows:
            total ^= row.digest  # one changed row costs one hash
        return total

    def _digest_row(self, index: int) -> None:
        row = self.rows[index]
        x = mix64(index + 1)
        x = mix64(x ^ row.sent_slot & 2**64 - 1)
        x = mix64(x ^ row.last_turn & 2**64 - 1)
        x = mix64(x ^ row.in_ap)
        for axis in range(3):
            x = mix64(x ^ bits_of(row.position[axis]))
            x = mix64(x ^ bits_of(row.velocity[axis]))
        if self.by_innovation:
            x = mix64(x ^ bits_of(row.innovation))
        row.digest = (x ^ x >> 32) & 0xFFFFFFFF
