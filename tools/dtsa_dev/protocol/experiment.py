"""One run of a slot protocol without flight: agents that have or have not something to say, a channel, and faults."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Scenario, SwarmConfig
from dtsa_agent.core.plugins import make_swarm
from dtsa_bench.log.rules import GrantLedger
from dtsa_channel_sim import Channel, ChannelConfig

RADIUS, TURN = 2.0, 0.5  # m, rad/s: those that move fly circles, at 1 m/s
FAR = 1e6  # m, a goal that nobody reaches: the agent has something to say for as long as it has it


@dataclass(frozen=True, slots=True)
class FlightEvent:
    """Something that happens to an agent before a slot begins.

    ``kind``: ``go`` (gets a goal), ``stop`` (its goal is where it is), ``join``, ``leave`` (says so in its next turn),
    ``die`` (silent from now on), ``restart`` (forgets everything, within one slot).
    """

    slot: int
    kind: str
    agent: int  # id


@dataclass(slots=True)
class Wait:
    """How long it took an agent to be heard after it woke or joined."""

    agent: int
    kind: str
    since: int  # slot
    first: int = -1  # slot of its first frame that did not collide
    all: int = -1  # slot after which everybody present had heard it

    @property
    def to_first(self) -> int:
        """Slots until its first frame; -1: none."""
        return self.first - self.since if self.first >= 0 else -1

    @property
    def to_all(self) -> int:
        """Slots until all had heard it; -1: not yet."""
        return self.all - self.since if self.all >= 0 else -1


@dataclass(slots=True)
class Outcome:
    """Result of one run."""

    slots: int = 0
    idle: int = 0
    collisions: int = 0
    collision_slots: list[int] = field(default_factory=list)
    age_sum: int = 0  # over pairs (observer, agent that it takes for a mover), every slot after the warm-up
    age_count: int = 0
    waits: list[Wait] = field(default_factory=list)
    ledger: GrantLedger | None = None

    @property
    def age(self) -> float:
        """Mean age of the movers' states, slots, over agents that their observers take for movers."""
        return self.age_sum / self.age_count if self.age_count else float("nan")


def still_scenario(agents: int, seed: int, spread: float = 6.0) -> Scenario:
    """Agents at random places in a cube (half its width: ``spread``, m), with nowhere to go."""
    places = np.round(np.random.default_rng(seed).uniform(-spread, spread, (3, agents)), 3)
    return Scenario(places, places.copy(), np.zeros(agents, dtype=np.bool_), goals_known=False)


class Experiment:
    """One swarm, all agents with a table of their own, and its channel; the scenario in its settings is not used.

    :param movers: ids that have something to say from the start.
    :param absent: ids that are not there at the start.
    :param events: what happens; any order.
    :param final: whether an agent that rests knows that no further goal will come.
    :param warmup: slots before ages count.
    :param shared: one table serves all agents: right only where nothing is lost and no agent comes or goes.
    """

    def __init__(
        self,
        config: SwarmConfig,
        channel: ChannelConfig | None = None,
        *,
        movers: Iterable[int] = (),
        absent: Iterable[int] = (),
        events: Sequence[FlightEvent] = (),
        final: bool = True,
        warmup: int = 0,
        shared: bool = False,
    ) -> None:
        self.config = config
        self.swarm = make_swarm(config, still_scenario(config.agents, config.seed), shared_table=shared)
        self.channel = Channel(channel or ChannelConfig(agents=config.agents, slot_ns=config.slot_ns, seed=config.seed))
        self.warmup = warmup
        self.moving: NDArray[np.bool_] = np.zeros(config.agents, dtype=np.bool_)
        # A mover flies a circle through its place, so that positions and velocities mean something to a protocol that
        # looks at them; no agent avoids another one.
        self._phase = np.random.default_rng(config.seed + 1).uniform(0.0, 2.0 * np.pi, config.agents)
        self._centre = self.swarm.position[:2] - RADIUS * np.stack((np.cos(self._phase), np.sin(self._phase)))
        self.outcome = Outcome()
        self.slot = 0
        self._waiting: list[Wait] = []
        self._events: dict[int, list[FlightEvent]] = {}
        for event in events:
            self._events.setdefault(event.slot, []).append(event)
        if config.policy_row.agent_state:
            self.outcome.ledger = GrantLedger(config.agents, config.anchor_every, config.main_every)
        self.swarm.active[:] = 0
        self.swarm.final[:] = final
        for agent in movers:
            self._go(agent)
        for agent in absent:
            self.swarm.present[agent - 1] = 0
        self._not_self = np.ones((1, config.agents), np.bool_) if shared else ~np.eye(config.agents, dtype=np.bool_)

    def _go(self, agent: int) -> None:
        self.swarm.goal[0, agent - 1] = FAR
        self.moving[agent - 1] = True

    def happen(self, event: FlightEvent) -> None:
        """Let an event happen now."""
        swarm, k = self.swarm, event.agent - 1
        if event.kind == "go" and not self.moving[k]:
            self._go(event.agent)
            if swarm.present[k]:
                self._wait(event)
        elif event.kind == "stop":
            swarm.goal[:, k] = swarm.position[:, k]
            self.moving[k] = False
            self._waiting = [wait for wait in self._waiting if wait.agent != event.agent or wait.kind != "go"]
        elif event.kind == "join" and not swarm.present[k]:
            swarm.present[k] = 1
            self._wait(event)
        elif event.kind == "leave" and swarm.present[k]:
            swarm.present[k] = 2
        elif event.kind == "die":
            swarm.present[k] = 0
            self._waiting = [wait for wait in self._waiting if wait.agent != event.agent]
        elif event.kind == "restart" and swarm.present[k]:
            swarm.restart(k)
            self._waiting = [wait for wait in self._waiting if wait.agent != event.agent]
            self._wait(event)

    def _wait(self, event: FlightEvent) -> None:
        wait = Wait(event.agent, event.kind, self.slot)
        self._waiting.append(wait)
        self.outcome.waits.append(wait)

    def run(self, slots: int, each: Callable[[Experiment, tuple[int, ...]], None] | None = None) -> Outcome:
        """Run on; ``each`` is called after every slot with the ids that sent in it."""
        for _ in range(slots):
            senders = self.step()
            if each is not None:
                each(self, senders)
        return self.outcome

    def step(self) -> tuple[int, ...]:
        """One slot; returns the ids that sent."""
        swarm, slot, out = self.swarm, self.slot, self.outcome
        for event in self._events.pop(slot, ()):
            self.happen(event)
        self._move()
        senders = swarm.begin(slot)
        ids = tuple(k + 1 for k in senders)
        if out.ledger is not None:
            out.ledger.check_slot(slot, {k + 1: swarm.frame(k) for k in senders})
        if senders:
            verdict = self.channel.arbitrate(slot, ids, positions=swarm.position)
            for row, k in enumerate(senders):
                if len(senders) == 1 or (verdict.received is not None and verdict.received[row].any()):
                    swarm.hear(slot, swarm.frame(k), None if verdict.received is None else verdict.received[row])
        swarm.end(slot)
        out.slots += 1
        out.idle += not senders
        if len(senders) > 1:
            out.collisions += 1
            out.collision_slots.append(slot)
        if slot >= self.warmup:
            self._ages()
        if self._waiting:
            self._check_waiting(ids if len(ids) == 1 else ())
        self.slot += 1
        return ids

    def _move(self) -> None:
        """One slot of flight."""
        swarm, phase = self.swarm, self._phase
        phase[self.moving] += TURN * self.config.slot_s
        cos, sin = np.cos(phase), np.sin(phase)
        swarm.position[0], swarm.position[1] = self._centre[0] + RADIUS * cos, self._centre[1] + RADIUS * sin
        speed = RADIUS * TURN * self.moving
        swarm.velocity[0], swarm.velocity[1] = -speed * sin, speed * cos

    def _ages(self) -> None:
        swarm, out = self.swarm, self.outcome
        movers = np.flatnonzero(self.moving & (swarm.present > 0))
        sent = swarm.sent_slot[:, movers]
        heard = (sent >= 0) & self._not_self[:, movers]
        if not swarm.shared:
            heard &= (swarm.present > 0)[:, None]
        believed = heard & (swarm.in_ap[:, movers] > 0)
        out.age_sum += int((self.slot - sent)[believed].sum())
        out.age_count += int(np.count_nonzero(believed))

    def _check_waiting(self, ids: tuple[int, ...]) -> None:
        swarm = self.swarm
        for wait in self._waiting:
            if wait.first < 0 and wait.agent in ids:
                wait.first = self.slot
            if wait.first >= 0:
                others = swarm.present > 0
                others[wait.agent - 1] = False
                tables = swarm.sent_slot if swarm.shared else swarm.sent_slot[others]
                if (tables[:, wait.agent - 1] >= wait.since).all():
                    wait.all = self.slot
        self._waiting = [wait for wait in self._waiting if wait.all < 0]


def random_schedule(random: np.random.Generator, agents: int, slots: int) -> list[dict[str, Any]]:
    """Jams and partitions, one after the other."""
    entries: list[dict[str, Any]] = []
    slot = 0
    while slot < slots:
        slot += int(random.integers(50, 800))
        length = int(random.integers(5, 600))
        kind = random.integers(0, 3)
        if kind == 0:
            entries.append({"slot": slot, "until": slot + length, "jam": True})
        elif kind == 1 and agents > 3:
            ids = [int(k) + 1 for k in random.permutation(agents)]
            cut = int(random.integers(1, agents))
            entries.append({"slot": slot, "until": slot + length, "partition": [ids[:cut], ids[cut:]]})
        slot += length
    return entries
