"""Agents in slots, moved by the compiled core."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import _kernel
from .abstract_swarm import PRESENT_LEAVING, AbstractSwarm, Bytes
from .config import SwarmConfig
from .errors import ConfigError
from .flight_models import flight_model
from .frame import PROFILE_EXTENDED, PROFILE_PAPER, PROFILE_PAPER_INTENT, position_step
from .registry import ESTIMATORS, POLICIES, REASONS, SELECTIONS
from .scenario import STREAM_POLICY, Scenario, check_extent, generator, make_scenario

DECAY_STEPS = 4096  # intent: beyond this many control periods a vehicle has settled at its command


class Swarm(AbstractSwarm):
    """Some or all agents of one swarm, on the compiled core.

    The simulator holds all agents in one; a ROS process holds those it hosts; the verifier and the metrics hold tables
    only. All of them run the same code on the same arrays.

    :param config: the settings that all agents share.
    :param scenario: starts and goals; default: made from ``config``.
    :param local: ids of the agents that live here, ascending; default: all.
    :param shared_table: one table serves all local agents. Right only where all hear the same, i.e. without loss.
    :param observers: with ``local=[]``: ids of the observers whose tables are kept (0: one that hears everything).
    :raises ConfigError: for ids that do not exist, or settings that need agents that are not here.
    """

    def __init__(
        self,
        config: SwarmConfig,
        scenario: Scenario | None = None,
        local: Sequence[int] | None = None,
        shared_table: bool = False,
        observers: Sequence[int] | None = None,
    ) -> None:
        self.config = config
        self.scenario = make_scenario(config) if scenario is None else scenario
        check_extent(config, self.scenario)
        self.ids = tuple(range(1, config.agents + 1) if local is None else local)
        self._check_ids("local", self.ids)
        count, agents = len(self.ids), config.agents
        self.local = np.array(self.ids, dtype=np.int32) - 1
        seen = observers if observers is not None else ([0] if shared_table else self.ids)
        self._check_ids("observers", tuple(i for i in seen if i))
        self.observer = np.array(seen, dtype=np.int32) - 1
        self.shared = bool(shared_table)
        self.rows = np.arange(count)
        if config.estimator_row.needs_everybody and 0 < count < agents:
            others = ", ".join(row.name for row in ESTIMATORS.rows.values() if not row.needs_everybody)
            allowed = f"{others}: it needs all agents in one process"
            raise ConfigError("estimator", config.estimator, allowed)
        row = config.policy_row
        if shared_table and row.agent_state:
            why = f"False: with policy {row.name} every agent knows something of its own"
            raise ConfigError("shared_table", True, why)
        lease = _kernel.lease_state_bytes(agents, config.anchor_every) if row.agent_state else 0
        self._make_tables(len(self.observer), agents)
        self._make_agents(count, config.steps, lease)
        self.course = self.scenario.course(self.local)
        parameters = self._parameters(count)
        self._arrays = self._shared_arrays()
        self.kernel = _kernel.Swarm(parameters, self._arrays)

    def _check_ids(self, name: str, ids: tuple[int, ...]) -> None:
        if list(ids) != sorted(set(ids)) or (ids and not 1 <= ids[0] <= ids[-1] <= self.config.agents):
            raise ConfigError(name, ids, f"ascending ids from 1 to {self.config.agents}")

    def _parameters(self, count: int) -> dict[str, Any]:
        config, model = self.config, flight_model(self.config.avoider, self.config.options)
        key = int(generator(config.seed, STREAM_POLICY).integers(0, 2**63))
        profile = PROFILE_PAPER_INTENT if config.estimator_row.needs_intent else PROFILE_PAPER
        self._decay = decay_table(model.vehicle.tau, config.slot_s / config.steps)
        return {
            "agents": config.agents, "local_count": count, "table_count": len(self.observer), "steps": config.steps,
            "shared": int(self.shared), "slot_s": config.slot_s, "policy": POLICIES.number(config.policy),
            "estimator": ESTIMATORS.number(config.estimator), "avoider": model.kind,
            "selection": SELECTIONS.index(config.selection), "epsilon": float(config.epsilon),
            "age_cap": float(config.age_cap), "boot_round": int(config.boot_round), "return_every": config.return_every,
            "r_min": float(config.r_min), "c_r": config.c_r,
            "targets_known": int(config.targets_known and self.scenario.goals_known),
            "profile": PROFILE_EXTENDED if config.extended else profile, "key": key,
            "decay_len": self._decay.shape[1], "tau": model.vehicle.tau, "a_max": model.vehicle.a_max,
            "avoid": model.avoider.to_dict(), "gossip": int(config.gossip),
            "position_step": position_step(config.extent_m), "anchor_every": config.anchor_every,
            "open_every": config.open_period, "adoption": int(config.adoption), "depth_rate": float(config.depth_rate),
            "share": float(config.lease_share),
        }  # fmt: skip

    def _shared_arrays(self) -> dict[str, Any]:
        scenario = self.scenario
        self._start = np.ascontiguousarray(scenario.start, dtype=np.float64)
        self._target = np.array(scenario.target, dtype=np.float64)
        self.known_goal = self._target  # (3, N) m, where all take those to be that rest
        return {
            "local": self.local, "observer": self.observer, "start": self._start, "target": self._target,
            "sent_p": self.sent_position, "sent_v": self.sent_velocity, "sent_c": self.sent_intent,
            "sent_slot": self.sent_slot, "last": self.last_turn, "in_ap": self.in_ap, "entry_hash": self.entry_hash,
            "table_hash": self.table_hash, "est_p": self.estimate_position, "est_v": self.estimate_velocity,
            "g": self.priority, "h": self.counter, "pos": self.position, "vel": self.velocity, "cmd": self.command,
            "goal": self.goal, "track": self.track, "active": self.active, "final": self.final, "present": self.present,
            "chosen": self.chosen, "reason": self.reason, "digest": self.digest, "score": self.score,
            "sends": self.sends, "frame_len": self.frame_length, "frames": self.frames, "decay": self._decay,
            "lease_state": self.lease_state,
        }  # fmt: skip

    # The steps are documented in AbstractSwarm.

    def decide(self, slot: int) -> None:
        self.kernel.decide(slot)

    def emit(self, slot: int) -> tuple[int, ...]:
        return self.kernel.emit(slot)

    def begin(self, slot: int) -> tuple[int, ...]:
        return self.kernel.begin(slot)

    def frame(self, local_index: int) -> bytes:
        return self.kernel.frame(local_index)

    def fly(self, slot: int) -> None:
        self.kernel.fly(slot)

    def steer(self, slot: int, step: int, estimate: bool = True) -> None:
        self.kernel.steer(slot, step, estimate)

    def move(self, step: int) -> None:
        self.kernel.move(step)

    def hear(self, slot: int, data: bytes, mask: Bytes | None = None) -> bool:
        return self.kernel.hear(slot, data, mask)

    def end(self, slot: int, collided: Bytes | None = None) -> None:
        self.kernel.end(slot)

    def estimate(self, slot: int, step: int = 0) -> None:
        self.kernel.estimate(slot, step)

    def unseal(self, data: bytes, slot: int, late: int = 0) -> bytes | None:
        return data

    def reset(self) -> None:
        self.known_goal[:] = self.scenario.target
        self.final[:] = 1
        if self.course is not None:
            self.course.reset()
        self.kernel.reset()

    def restart(self, local_index: int) -> None:
        self.kernel.restart(local_index)

    def leave(self, local_index: int) -> None:
        if self.present[local_index]:
            self.present[local_index] = PRESENT_LEAVING if self.config.policy_row.says_leaving else 0

    def with_own_tables(self, slot: int) -> Swarm:
        swarm = Swarm(self.config, self.scenario, local=self.ids)
        # Lists the senders of the open slot; the state that they sent is copied over what this encodes.
        swarm.sends[:] = self.sends
        swarm.emit(slot)
        for name, values in self._arrays.items():
            if name != "observer":
                swarm._arrays[name][...] = values  # the one table becomes everybody's
        swarm.course = self.course
        return swarm

    def lease_status(self, local_index: int) -> dict[str, Any]:
        return self.kernel.lease_status(local_index)

    def reason_name(self, local_index: int) -> str:
        return REASONS[self.reason[local_index]]


def decay_table(tau: float, dt: float) -> NDArray[np.float64]:
    """How an unsaturated vehicle approaches its command, for estimator ``intent``.

    With q = 1 - dt / tau the velocity after k control periods is ``c + (v - c) q^k`` and the way
    ``c k dt + (v - c) dt (q + .. + q^k)``: the vehicle's own integrator, by multiplication alone, so that all agents
    compute the same bits.

    :param tau: time constant of the velocity response, s.
    :param dt: control period, s.
    :returns: (2, DECAY_STEPS): q^k (1), and dt times the sum (s).
    """
    q = max(0.0, 1.0 - dt / tau)
    table = np.empty((2, DECAY_STEPS))
    power, way = 1.0, 0.0
    for k in range(DECAY_STEPS):
        table[0, k], table[1, k] = power, way
        power *= q
        way += dt * power
    return table
