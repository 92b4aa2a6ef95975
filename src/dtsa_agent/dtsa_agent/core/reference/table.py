"""The settings that all agents share, and what one observer believes about all of them: one row an agent.

Extended frames carry gossip, what their sender last heard of others. Where an agent is by now: eq:estimate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

from dtsa_agent.core.frame import Frame, Gossip

from .arithmetic import ZERO, Vector, bits_of, minus, mix64, norm1
from .frame import GOSSIP_AGE_MAX, PROFILE_PAPER, SECTIONS, gossip_fits

OFF, ON, LEAVES = 0, 1, 2  # of an agent: not there, there, about to be switched off
DECAY_STEPS = 4096  # beyond this many control periods a vehicle has settled at its command


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
    profile: int = PROFILE_PAPER
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

    :param observer: its id.
    :param known_goals: where those that rest are taken to stand, m; None: nobody knows that.
    """

    observer: int
    rules: Rules
    start: Sequence[Vector]
    known_goals: Sequence[Vector] | None = None
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

    def collect_gossip(self, slot: int, room: int) -> tuple[Gossip, ...]:
        """The states that a frame carries: the newest, the newest of k slots or more, and of 2 k; k = 2 + N div 16.

        The first mends single losses at once; the others reach receivers that heard nothing for a while. What is left
        of the room carries the next newest.
        """
        later = 2 + self.rules.agents // 16
        chosen: list[int] = []
        for age in (1, later, 2 * later, *[1] * SECTIONS):
            if len(chosen) < room:
                chosen += self._newest_of_age(slot, age, chosen)
        rows = [(k, self.rows[k]) for k in chosen]
        return tuple(Gossip(k + 1, slot - row.sent_slot, row.in_ap, row.position, row.velocity) for k, row in rows)

    def _newest_of_age(self, slot: int, age: int, chosen: list[int]) -> list[int]:
        """The newest state of an agent not yet chosen that is ``age`` slots old or older and can be said; or none."""
        fit = [
            k
            for k, row in enumerate(self.rows)
            if k != self.observer - 1
            and row.sent_slot >= 0
            and age <= slot - row.sent_slot <= GOSSIP_AGE_MAX
            and k not in chosen
            and gossip_fits(row.position, row.velocity, self.rules.position_step)
        ]
        return [max(fit, key=lambda k: self.rows[k].sent_slot)] if fit else []

    def learn_gossip(self, entry: Gossip, sampled: int) -> None:
        """A state that another agent heard replaces an older one only.

        One at the codec's limit may be a wrong one and is not believed. The observer's entry for itself counts only
        where that confirms that it was heard (:func:`.lease.hear_gossip`).
        """
        if sampled < 0 or self.rows[entry.agent - 1].sent_slot >= sampled:
            return
        if gossip_fits(entry.position, entry.velocity, self.rules.position_step):
            velocity = entry.velocity
            self.learn(Frame(entry.agent, sampled, int(entry.moving), entry.position, velocity, velocity), sampled)

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
        if self.rules.policy == "innovation":  # decisions depend on it
            x = mix64(x ^ bits_of(row.innovation))
        row.digest = (x ^ x >> 32) & 0xFFFFFFFF


def age_s(row: Row, rules: Rules, slot: int, step: int = 0) -> float:
    """Age of a known state, (i - m) t_s in eq:estimate, s; 0 for an agent never heard of."""
    return 0.0 if row.sent_slot < 0 else (slot - row.sent_slot) * rules.slot_s + step * rules.dt


def hold(row: Row, rules: Rules, slot: int, step: int = 0) -> tuple[Vector, Vector]:
    """Position and velocity as last heard."""
    return row.position, row.velocity


def linear(row: Row, rules: Rules, slot: int, step: int = 0) -> tuple[Vector, Vector]:
    """On with the velocity last heard: p + (i - m) t_s v (eq:estimate)."""
    age, p, v = age_s(row, rules, slot, step), row.position, row.velocity
    return (p[0] + v[0] * age, p[1] + v[1] * age, p[2] + v[2] * age), v


def intent(row: Row, rules: Rules, slot: int, step: int = 0) -> tuple[Vector, Vector]:
    """Towards the commanded velocity c, as an unsaturated vehicle answers it.

    After k control periods: velocity c + (v - c) q^k, position p + c a + (v - c) dt (q + .. + q^k).
    """
    age = age_s(row, rules, slot, step)
    ago = 0 if row.sent_slot < 0 else (slot - row.sent_slot) * rules.steps + step
    powers, ways = decay_table(rules.tau, rules.dt)
    ago = max(0, min(ago, DECAY_STEPS - 1))  # a frame of the next slot may be heard before this one is over
    q, distance = powers[ago], ways[ago]
    moved = []
    for p, v, c in zip(row.position, row.velocity, row.intent, strict=True):
        d = v - c
        moved.append((p + c * age + d * distance, c + d * q))
    (x, vx), (y, vy), (z, vz) = moved
    return (x, y, z), (vx, vy, vz)


@lru_cache(maxsize=8)
def decay_table(tau: float, dt: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """How an unsaturated vehicle approaches its command: q^k (1), and dt (q + .. + q^k) (s), for k = 0, 1, ...

    q = 1 - dt / tau is the vehicle's own integrator. By multiplication alone, so that all agents compute the same bits.
    """
    q = max(0.0, 1.0 - dt / tau)
    powers, ways = [], []
    power, distance = 1.0, 0.0
    for _ in range(DECAY_STEPS):
        powers.append(power)
        ways.append(distance)
        power *= q
        distance += dt * power
    return tuple(powers), tuple(ways)


ESTIMATORS = {"hold": hold, "linear": linear, "intent": intent}  # the oracle knows the truth, there is nothing to state
