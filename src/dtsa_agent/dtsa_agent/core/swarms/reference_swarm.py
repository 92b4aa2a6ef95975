"""Agents in slots, moved by the specification (:mod:`dtsa_agent.core.reference`) instead of the compiled core.

For studying the protocol with a debugger, for machines without a compiler, and as the oracle of the tests: a flight on
it is the same as on :class:`~dtsa_agent.core.swarms.swarm.Swarm`, bit for bit, where both have the compiled avoiders.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import LocalProtocolError, RemoteProtocolError
from dtsa_agent.core.frame import position_step
from dtsa_agent.core.reference import estimators, vehicle
from dtsa_agent.core.reference.agent import Agent, Foreign, Receiver, hear, parse
from dtsa_agent.core.reference.arithmetic import Vector
from dtsa_agent.core.reference.lease.memory import DEAF
from dtsa_agent.core.reference.rules import Rules
from dtsa_agent.core.reference.selection import Choice
from dtsa_agent.core.reference.table import Table
from dtsa_agent.core.registry import PROFILES, REASONS
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.flight_models import FlightModel, flight_model
from dtsa_agent.core.settings.scenario import STREAM_POLICY, Scenario, generator

from .abstract_swarm import PRESENT_LEAVING, AbstractSwarm, Bytes


def rules_of(config: SwarmConfig, scenario: Scenario) -> Rules:
    """What all agents of a swarm agree on, as the specification has it.

    :param config: the settings.
    :param scenario: starts and goals.
    """
    intent = config.estimator_row.needs_intent
    return Rules(
        agents=config.agents, slot_s=config.slot_s, steps=config.steps, policy=config.policy,
        estimator=config.estimator, tau=flight_model(config.avoider, config.options).vehicle.tau,
        selection=config.selection, epsilon=config.epsilon, age_cap=config.age_cap, boot_round=config.boot_round,
        return_every=config.return_every, profile=PROFILES[2 if config.extended else 1 if intent else 0],
        position_step=position_step(config.extent_m), r_min=config.r_min, c_r=config.c_r,
        targets_known=config.targets_known and scenario.goals_known, gossip=config.gossip,
        key=int(generator(config.seed, STREAM_POLICY).integers(0, 2**63)), anchor_every=config.anchor_every,
        main_every=config.main_every, open_every=config.open_period, adoption=config.adoption,
        depth_rate=config.depth_rate, lease_share=config.lease_share,
    )  # fmt: skip


class ReferenceSwarm(AbstractSwarm):
    """Some or all agents of one swarm, on the specification. Parameters are those of ``Swarm``, and:

    :param plain_avoiders: avoiders of the specification even where there are compiled ones. They agree to 1e-12 m/s, so
        flights differ in the last bits, and after a while in more.
    """

    def __init__(
        self,
        config: SwarmConfig,
        scenario: Scenario | None = None,
        local: Sequence[int] | None = None,
        shared_table: bool = False,
        observers: Sequence[int] | None = None,
        *,
        plain_avoiders: bool = False,
    ) -> None:
        self._begin(config, scenario, local, shared_table, observers)
        self.kernel = None
        self.plain_avoiders = plain_avoiders
        self.rules = rules_of(config, self.scenario)
        self._model: FlightModel = flight_model(config.avoider, config.options)
        self.known_goal = np.array(self.scenario.target, dtype=np.float64)
        start = _vectors(self.scenario.start)
        self.tables = [Table(int(index) + 1, start) for index in self.observer]
        self.agents = [
            Agent(int(index), self.rules, self.tables[0 if self.shared else place])
            for place, index in enumerate(self.local)
        ]
        self._sent: list[bytes] = [b"" for _ in self.agents]  # frames of the present slot
        self._malformed = self._foreign = 0
        self._back_to_start()

    # The steps are documented in AbstractSwarm.

    def decide(self, slot: int) -> None:
        self._look()
        for place, agent in enumerate(self.agents):
            if place and self.shared and self.rules.policy != "aloha":
                first = self.agents[0].choice
                agent.choice, agent.sends = first, first.index == agent.index and bool(agent.present)
            else:
                agent.decide(slot)
            self.chosen[place] = agent.choice.index + 1
            self.reason[place] = REASONS.index(agent.choice.reason)
            self.score[place] = agent.choice.g
            self.digest[place] = agent.table.digest
            self.sends[place] = agent.sends
        self._publish_weights()

    def emit(self, slot: int) -> tuple[int, ...]:
        self._look()
        self._sent[:] = [_frame_of(agent, slot) if agent.sends else b"" for agent in self.agents]
        return tuple(place for place, data in enumerate(self._sent) if data)

    def begin(self, slot: int) -> tuple[int, ...]:
        self.decide(slot)
        return self.emit(slot)

    def frame(self, local_index: int) -> bytes:
        return self._sent[local_index]

    def drop(self, local_index: int) -> None:
        self._sent[local_index] = b""

    def fly(self, slot: int) -> None:
        for step in range(self.config.steps):
            self.steer(slot, step)
            self.move(step)

    def steer(self, slot: int, step: int, estimate: bool = True) -> None:
        flying = [place for place in range(len(self.agents)) if self.active[place] and self.present[place]]
        self.command[:] = 0.0
        if estimate:
            for table in [0] if self.shared and self.agents else flying:
                self._estimate(table, slot, step)
        for place in flying:
            table = 0 if self.shared else place
            ages = [estimators.age_s(row, self.rules, slot, step) for row in self.tables[table].rows]
            self.command[:, place] = self._model.command(
                int(self.local[place]), self.position[:, place], self.velocity[:, place], self.goal[:, place],
                self.estimate_position[table], self.estimate_velocity[table], np.array(ages), plain=self.plain_avoiders,
            )  # fmt: skip

    def move(self, step: int) -> None:
        limits = self._model.vehicle
        for place in range(len(self.agents)):
            if self.present[place] and (self.active[place] or self.velocity[:, place].any()):
                self.position[:, place], self.velocity[:, place] = vehicle.step(
                    limits.tau, limits.a_max, self.rules.dt, _vector(self.position, place),
                    _vector(self.velocity, place), _vector(self.command, place),
                )  # fmt: skip
        self.track[step] = self.position

    def hear(self, slot: int, data: bytes, mask: Bytes | None = None) -> bool:
        try:
            frame, sampled = parse(bytes(data), slot, self.rules)
        except RemoteProtocolError:
            self._malformed += 1
            return False
        except Foreign:
            self._foreign += 1
            return False
        self._look()
        sender = data[1] if self.config.extended else int.from_bytes(data[1:3], "little")
        reached = [row for row in range(len(self.tables)) if self._hears(row, sender, mask)]
        hear([self._receiver(row) for row in reached], frame, sampled, self.rules)
        for row in reached:
            self._publish(row)
        return True

    def _hears(self, row: int, sender: int, mask: Bytes | None) -> bool:
        received = mask is None or bool(mask[row])
        if not self.config.extended:
            return received
        if self.tables[row].observer == sender:
            return not self.agents  # a local sender knows what it said
        here = self.shared or row >= len(self.agents) or bool(self.present[row])
        return received and here

    def _receiver(self, row: int) -> Receiver:
        own = not self.shared and row < len(self.agents)
        return Receiver(self.tables[row], self.agents[row] if own else None)

    def end(self, slot: int, collided: Bytes | None = None) -> None:
        self._look()
        for agent, data in zip(self.agents, self._sent, strict=True):
            agent.remember_own(slot, data)
        for place, agent in enumerate(self.agents):
            if place == 0 or not self.shared:
                agent.end(slot)
            if agent.present != self.present[place]:
                self.present[place] = agent.present
        for row in range(len(self.tables)):
            self._publish(row)

    def estimate(self, slot: int, step: int = 0) -> None:
        for table in range(len(self.tables)):
            self._estimate(table, slot, step)

    def _estimate(self, table: int, slot: int, step: int) -> None:
        position, velocity = self.estimate_position[table], self.estimate_velocity[table]
        if self.config.estimator_row.needs_everybody:
            position[:, self.local], velocity[:, self.local] = self.position, self.velocity
        elif self.rules.estimator in estimators.ESTIMATORS:
            estimator = estimators.ESTIMATORS[self.rules.estimator]
            believed = [estimator(row, self.rules, slot, step) for row in self.tables[table].rows]
            position[:] = np.array([p for p, _ in believed]).T
            velocity[:] = np.array([v for _, v in believed]).T

    def unseal(self, data: bytes, slot: int, late: int = 0) -> bytes | None:
        return data

    def reset(self) -> None:
        self.known_goal[:] = self.scenario.target
        self.final[:] = 1
        if self.course is not None:
            self.course.reset()
        self._back_to_start()

    def _back_to_start(self) -> None:
        self.position[:] = self.scenario.start[:, self.local]
        self.goal[:] = self.scenario.target[:, self.local]
        self.velocity[:] = self.command[:] = 0.0
        self.track[:] = self.position
        self.active[:] = self.present[:] = 1
        self.sends[:] = 0
        self._malformed = self._foreign = 0
        self._sent = [b"" for _ in self.agents]
        for table in self.tables:
            table.reset()
        for agent in self.agents:
            agent.restart()
        for row in range(len(self.tables)):
            self._publish(row)

    def restart(self, local_index: int) -> None:
        if self.shared:
            raise ValueError("restart: agents that share a table cannot restart alone")
        self.agents[local_index].restart()
        self._publish(local_index)

    def leave(self, local_index: int) -> None:
        if self.present[local_index]:
            self.present[local_index] = PRESENT_LEAVING if self.config.policy_row.says_leaving else 0

    def with_own_tables(self, slot: int) -> ReferenceSwarm:
        swarm = ReferenceSwarm(self.config, self.scenario, self.ids, plain_avoiders=self.plain_avoiders)
        for name, value in vars(self).items():
            there = getattr(swarm, name)
            if isinstance(value, np.ndarray) and name != "observer":
                there[...] = value  # the one table becomes everybody's
        swarm.course, swarm._sent = self.course, self._sent
        swarm._malformed, swarm._foreign = self._malformed, self._foreign
        for own, agent, table in zip(swarm.agents, self.agents, swarm.tables, strict=True):
            table.rows = copy.deepcopy(self.tables[0].rows)
            own.choice, own.sends = agent.choice, agent.sends
        return swarm

    def lease_status(self, local_index: int) -> dict[str, Any]:
        if self.rules.policy != "lease":
            raise ValueError("lease_status: the policy is not lease")
        memory, index = self.agents[local_index].memory, int(self.local[local_index])
        others = [k for k in range(self.rules.agents) if k != index] if memory.started else []
        return {
            "probation": memory.probation,
            "deaf": memory.silence > DEAF,
            "woke": memory.woke if memory.started else 0,
            "alive": 1 + sum(memory.alive(k) for k in others) if memory.started else self.rules.agents,
            "absent": sum(memory.absent(k, memory.now) for k in others),
            "silent_slots": memory.silence,
        }

    def reason_name(self, local_index: int) -> str:
        return REASONS[int(self.reason[local_index])]

    @property
    def malformed(self) -> int:
        """Frames heard that were none: wrong length, version or fields."""
        return self._malformed

    @property
    def foreign(self) -> int:
        """Frames of unknown agents or of another time."""
        return self._foreign

    # Arrays are what others read and write; agents and tables are plain objects.

    def _look(self) -> None:
        """Agents take over what scenario, vehicles and wrappers have written into the arrays."""
        goals = _vectors(self.known_goal) if self.rules.targets_known else None
        for table in self.tables:
            table.known_goals = goals
        external = self.config.policy not in ("tdma", "dtsa", "age", "aloha", "lease")
        for place, agent in enumerate(self.agents):
            agent.position, agent.velocity = _vector(self.position, place), _vector(self.velocity, place)
            agent.command, agent.goal = _vector(self.command, place), _vector(self.goal, place)
            agent.final, agent.present = bool(self.final[place]), int(self.present[place])
            agent.sends = bool(self.sends[place])
            if external:  # a plug-in decides
                agent.choice = Choice(int(self.chosen[place]) - 1, "plugin")

    def _publish(self, index: int) -> None:
        """Writes a table into the arrays."""
        rows = self.tables[index].rows
        self.sent_position[index] = np.array([row.position for row in rows]).T
        self.sent_velocity[index] = np.array([row.velocity for row in rows]).T
        self.sent_intent[index] = np.array([row.intent for row in rows]).T
        self.sent_slot[index] = [row.sent_slot for row in rows]
        self.last_turn[index] = [row.last_turn for row in rows]
        self.in_ap[index] = [row.in_ap for row in rows]
        self.entry_hash[index] = [row.digest for row in rows]
        self.table_hash[index] = self.tables[index].digest

    def _publish_weights(self) -> None:
        for place, agent in enumerate(self.agents[:1] if self.shared else self.agents):
            if agent.weights.h is not None:
                self.counter[place] = agent.weights.h
            if agent.weights.g is not None:
                self.priority[place] = agent.weights.g


def _vector(planes: NDArray[np.float64], column: int) -> Vector:
    x, y, z = planes[:, column].tolist()
    return (x, y, z)


def _vectors(planes: NDArray[np.float64]) -> list[Vector]:
    return [(x, y, z) for x, y, z in zip(*planes.tolist(), strict=True)]


def _frame_of(agent: Agent, slot: int) -> bytes:
    """Return what an agent sends; nothing if its state is not a number."""
    try:
        return agent.frame(slot)
    except LocalProtocolError:
        return b""
