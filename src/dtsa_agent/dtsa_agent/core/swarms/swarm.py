"""Agents in slots, moved by the compiled core."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dtsa_agent.core.binding import SWARM
from dtsa_agent.core.compiled import COMPILED, CORES, MISSING, REFERENCE
from dtsa_agent.core.compiled import kernel as _kernel
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.frame import PROFILE_EXTENDED, PROFILE_PAPER, PROFILE_PAPER_INTENT, position_step
from dtsa_agent.core.reference.estimators import decay_table
from dtsa_agent.core.registry import ESTIMATORS, POLICIES, REASONS, SELECTIONS
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.flight_models import flight_model
from dtsa_agent.core.settings.scenario import Scenario, policy_key

from .abstract_swarm import PRESENT_LEAVING, AbstractSwarm, Bytes

LEASE_STATUS = ("probation", "deaf", "woke", "alive", "absent", "silent_slots")


class Swarm(AbstractSwarm):
    """Some or all agents of one swarm, on the compiled core.

    The simulator holds all agents in one; a ROS process holds those it hosts; the verifier and the metrics hold tables
    only. All of them run the same code on the same arrays.

    :param config: the settings that all agents share.
    :param scenario: starts and goals; default: made from ``config``.
    :param local: ids of the agents that live here, ascending; default: all.
    :param shared_table: one table serves all local agents. Right only where all hear the same, i.e. without loss.
    :param observers: with ``local=[]``: ids of the observers whose tables are kept (0: one that hears everything).
    :param core: ``reference``: a :class:`.reference_swarm.ReferenceSwarm` comes into being instead.
    :raises ConfigError: for ids that do not exist, or settings that need agents or a kernel that are not here.
    """

    kernel: _kernel.Swarm

    def __new__(cls, *given: Any, core: str = COMPILED, **named: Any) -> Any:
        if core not in CORES or (core == COMPILED and MISSING):
            raise ConfigError("core", core, REFERENCE + f": {MISSING}" if MISSING else ", ".join(CORES))
        if core == COMPILED:
            return super().__new__(cls)
        from .reference_swarm import ReferenceSwarm  # nodes start without it

        return ReferenceSwarm(*given, **named)

    def __init__(
        self,
        config: SwarmConfig,
        scenario: Scenario | None = None,
        local: Sequence[int] | None = None,
        shared_table: bool = False,
        observers: Sequence[int] | None = None,
        *,
        core: str = COMPILED,
    ) -> None:
        self._begin(config, scenario, local, shared_table, observers)
        count = len(self.ids)
        state = _kernel.policy_bytes(POLICIES.number(config.policy), config.agents, config.main_every)
        if state:
            self.lease_state = np.zeros((count, state), dtype=np.uint8)
        self._length = np.zeros(count, dtype=np.uint8)  # (L,) bytes of each frame, 0: silent
        self._encoded = np.zeros((count, _kernel.FRAME_MAX), dtype=np.uint8)
        self._rejects = np.zeros(2, dtype=np.uint64)  # frames heard that were malformed, foreign
        parameters = self._parameters(count)
        self._arrays = self._shared_arrays()
        sizes = {
            "n": config.agents, "v": len(self.observer), "l": count, "s": config.steps, "k": self._decay.shape[1],
            "f": _kernel.FRAME_MAX, "p": state,
        }  # fmt: skip
        self.kernel = _kernel.swarm(SWARM.image(parameters, self._arrays, sizes), self._arrays)

    def _parameters(self, count: int) -> dict[str, Any]:
        config, model = self.config, flight_model(self.config.avoider, self.config.options)
        given = self.scenario.policy_key
        key = policy_key(config.seed) if given is None else given
        profile = PROFILE_PAPER_INTENT if config.estimator_row.needs_intent else PROFILE_PAPER
        self._decay = np.array(decay_table(model.vehicle.tau, config.slot_s / config.steps))
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
            "gossip": int(config.gossip), **model.avoider.to_dict(),
            "position_step": position_step(config.extent_m), "anchor_every": config.anchor_every,
            "main_every": config.main_every, "open_every": config.open_period, "adoption": int(config.adoption),
            "depth_rate": float(config.depth_rate), "share": float(config.lease_share), "patience": 0,
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
            "sends": self.sends, "frame_len": self._length, "frames": self._encoded, "decay": self._decay,
            "lease_state": self.lease_state, "rejects": self._rejects,
        }  # fmt: skip

    # The steps are documented in AbstractSwarm.

    def decide(self, slot: int) -> None:
        _kernel.decide(self.kernel, slot)

    def emit(self, slot: int) -> tuple[int, ...]:
        return _kernel.emit(self.kernel, slot)

    def begin(self, slot: int) -> tuple[int, ...]:
        return _kernel.begin(self.kernel, slot)

    def frame(self, local_index: int) -> bytes:
        return _kernel.frame(self.kernel, local_index)

    def drop(self, local_index: int) -> None:
        self._length[local_index] = 0

    def fly(self, slot: int) -> None:
        _kernel.fly(self.kernel, slot)

    def steer(self, slot: int, step: int, estimate: bool = True) -> None:
        _kernel.steer(self.kernel, slot, step, estimate)

    def move(self, step: int) -> None:
        _kernel.move(self.kernel, step)

    def hear(self, slot: int, data: bytes, mask: Bytes | None = None) -> bool:
        return _kernel.hear(self.kernel, slot, bytes(data), None if mask is None else mask.tobytes())

    def end(self, slot: int, collided: Bytes | None = None) -> None:
        _kernel.end(self.kernel, slot)

    def estimate(self, slot: int, step: int = 0) -> None:
        _kernel.estimate(self.kernel, slot, step)

    def unseal(self, data: bytes, slot: int, late: int = 0) -> bytes | None:
        return data

    def reset(self) -> None:
        self.known_goal[:] = self.scenario.target
        self.final[:] = 1
        if self.course is not None:
            self.course.reset()
        _kernel.reset(self.kernel)

    def restart(self, local_index: int) -> None:
        _kernel.restart(self.kernel, local_index)

    def leave(self, local_index: int) -> None:
        if self.present[local_index]:
            self.present[local_index] = PRESENT_LEAVING if self.config.policy_row.says_leaving else 0

    def with_own_tables(self, slot: int) -> Swarm:
        swarm = Swarm(self.config, self.scenario, local=self.ids)
        # Lists the senders of the present slot; the state that they sent is copied over what this encodes.
        swarm.sends[:] = self.sends
        swarm.emit(slot)
        for name, values in self._arrays.items():
            if name != "observer":
                swarm._arrays[name][...] = values  # the one table becomes everybody's
        swarm.course = self.course
        return swarm

    def lease_status(self, local_index: int) -> dict[str, Any]:
        return dict(zip(LEASE_STATUS, _kernel.lease_status(self.kernel, local_index), strict=True))

    def reason_name(self, local_index: int) -> str:
        return REASONS[int(self.reason[local_index])]

    @property
    def malformed(self) -> int:
        """Frames heard that were none: wrong length, version or fields."""
        return int(self._rejects[0])

    @property
    def foreign(self) -> int:
        """Frames of unknown agents or of another time."""
        return int(self._rejects[1])
