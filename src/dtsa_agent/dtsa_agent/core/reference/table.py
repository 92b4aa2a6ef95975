"""What one observer believes about all agents: one row an agent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from dtsa_agent.core.frame import Frame

from .arithmetic import ZERO, Vector, bits_of, minus, mix64, norm1


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
        """Takes in the state that an agent has sent.

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
