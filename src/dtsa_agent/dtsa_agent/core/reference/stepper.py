"""A swarm whose agents run the specification, for flights that prove it equal to the compiled core.

Only what agents must agree on is stated twice: vehicles and avoiders are the compiled ones, on the same arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import LocalProtocolError, RemoteProtocolError
from dtsa_agent.core.frame import position_step
from dtsa_agent.core.registry import REASONS
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.flight_models import flight_model
from dtsa_agent.core.settings.scenario import Scenario, policy_key
from dtsa_agent.core.swarm import Bytes, Swarm

from .agent import Agent, Foreign, parse
from .arithmetic import Vector
from .lease import DEAF
from .table import ESTIMATORS, Rules, Table


def rules_of(config: SwarmConfig, scenario: Scenario) -> Rules:
    """Return what all agents of a swarm agree on, as the specification has it."""
    same = {field.name: getattr(config, field.name) for field in fields(Rules) if hasattr(config, field.name)}
    return Rules(**{
        **same, "tau": flight_model(config.avoider, config.options).vehicle.tau, "key": policy_key(config.seed),
        "position_step": position_step(config.extent_m), "open_every": config.open_period,
        "targets_known": config.targets_known and scenario.goals_known,
    })  # fmt: skip


class ReferenceSwarm(Swarm):
    """Some or all agents of one swarm, each with a table of its own; parameters are those of :class:`Swarm`."""

    all_in_c = flies_in_c = False
    shares = False  # beside agents that share a table: those that are switched off hear, too

    def __init__(
        self, config: SwarmConfig, scenario: Scenario | None = None, local: Sequence[int] | None = None
    ) -> None:
        super().__init__(config, scenario, local)
        self.rules = rules_of(config, self.scenario)
        start = _vectors(self.scenario.start)
        self.agents = [Agent(Table(agent, self.rules, start)) for agent in self.ids]
        for place in range(len(self.agents)):
            self._publish(place)

    def decide(self, slot: int) -> None:
        self._read_arrays()
        for place, agent in enumerate(self.agents):
            choice = agent.decide(slot)
            self.chosen[place], self.reason[place] = choice.index + 1, REASONS.index(choice.reason)
            self.score[place], self.digest[place], self.sends[place] = choice.g, agent.table.digest, agent.sends
            for array, values in ((self.counter, choice.counters), (self.priority, choice.priorities)):
                if values is not None:
                    array[place] = values

    def emit(self, slot: int) -> tuple[int, ...]:
        self._read_arrays()
        for place, agent in enumerate(self.agents):
            try:
                data = agent.frame(slot) if agent.sends else b""
            except LocalProtocolError:  # its state is not a number
                data = b""
            self.frame_length[place], self.frames[place, : len(data)] = len(data), np.frombuffer(data, np.uint8)
        return tuple(np.flatnonzero(self.frame_length).tolist())

    def steer(self, slot: int, step: int, estimate: bool = True) -> None:
        for place in np.flatnonzero(self.active & (self.present > 0)) if estimate else ():
            self._estimate(place, slot, step)
        super().steer(slot, step, False)

    def estimate(self, slot: int, step: int = 0) -> None:
        for place in range(len(self.agents)):
            self._estimate(place, slot, step)

    def _estimate(self, place: Any, slot: int, step: int) -> None:
        position, velocity = self.estimate_position[place], self.estimate_velocity[place]
        if self.config.estimator_row.needs_everybody:
            position[:], velocity[:] = self.position, self.velocity
        else:
            rows = self.agents[place].table.rows
            believed = [ESTIMATORS[self.rules.estimator](row, self.rules, slot, step) for row in rows]
            position[:], velocity[:] = np.array([p for p, _ in believed]).T, np.array([v for _, v in believed]).T

    def hear(self, slot: int, data: bytes, mask: Bytes | None = None) -> bool:
        try:
            frame, sampled = parse(bytes(data), slot, self.rules)
        except (RemoteProtocolError, Foreign) as error:
            self.rejects[int(isinstance(error, Foreign))] += 1
            return False
        self._read_arrays()
        for place, agent in enumerate(self.agents):
            if mask is not None and not mask[place]:
                continue
            if self.config.extended and (agent.index + 1 == frame.own.sender or not (agent.present or self.shares)):
                continue
            agent.hear(frame, sampled)
            self._publish(place)
        return True

    def end(self, slot: int, collided: Bytes | None = None) -> None:
        self._read_arrays()
        for place, agent in enumerate(self.agents):
            agent.remember_own(slot, self.frame(place))
            agent.end(slot)
            self.present[place] = agent.present
            self._publish(place)

    def restart(self, local_index: int) -> None:
        self.agents[local_index].restart()
        self._publish(local_index)

    def lease_status(self, local_index: int) -> dict[str, Any]:
        memory, index = self.agents[local_index].memory, int(self.local[local_index])
        others = [k for k in range(self.rules.agents) if k != index] if memory.started else []
        alive = 1 + sum(map(memory.is_connected, others)) if memory.started else self.rules.agents
        return {
            "probation": memory.probation, "deaf": memory.silence > DEAF, "woke": memory.woke if memory.started else 0,
            "alive": alive, "absent": sum(memory.absent(k, memory.now) for k in others), "silent_slots": memory.silence,
        }  # fmt: skip

    def _read_arrays(self) -> None:
        """Agents take over what scenario and vehicles have written into the arrays."""
        goals = _vectors(self.known_goal) if self.rules.targets_known else None
        states = (_vectors(planes) for planes in (self.position, self.velocity, self.command, self.goal))
        for place, (agent, *state) in enumerate(zip(self.agents, *states, strict=True)):
            agent.table.known_goals = goals
            agent.position, agent.velocity, agent.command, agent.goal = state
            agent.final, agent.present = bool(self.final[place]), int(self.present[place])
            agent.sends = bool(self.sends[place])

    def _publish(self, place: int) -> None:
        """Write a table into the arrays."""
        table = self.agents[place].table
        for name in ("position", "velocity", "intent"):
            getattr(self, f"sent_{name}")[place] = np.array([getattr(row, name) for row in table.rows]).T
        self.innovation[place] = [row.innovation for row in table.rows]
        self.sent_slot[place] = [row.sent_slot for row in table.rows]
        self.last_turn[place] = [row.last_turn for row in table.rows]
        self.in_ap[place] = [row.in_ap for row in table.rows]
        self.entry_hash[place], self.table_hash[place] = [row.digest for row in table.rows], table.digest


def _vectors(planes: NDArray[np.float64]) -> list[Vector]:
    return [(x, y, z) for x, y, z in zip(*planes.tolist(), strict=True)]
