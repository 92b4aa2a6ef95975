"""Agents in slots: the state of some or all agents of a swarm as arrays, moved by the compiled core.

One slot ``i`` goes, everywhere and always, in this order::

    senders = swarm.begin(i)        # who sends, from what was heard before slot i
    swarm.fly(i)                    # commands and motion during slot i
    swarm.hear(i, data, mask)       # what the air carried in slot i, once a frame
    swarm.end(i)

The fast simulator holds all agents in one ``Swarm``; a ROS process holds those it hosts; the verifier and the metrics
hold tables only. All of them run the same code on the same arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import _kernel
from .authentication import Authenticator
from .config import ESTIMATORS, POLICIES, SELECTIONS, SwarmConfig
from .errors import ConfigError
from .flight_models import flight_model
from .frame import PROFILE_EXTENDED, PROFILE_PAPER, PROFILE_PAPER_INTENT
from .scenario import STREAM_POLICY, Scenario, generator, make_scenario

REASONS = (
    "nobody",
    "tdma",
    "boot",
    "age-cap",
    "priority",
    "tie",
    "oldest",
    "return",
    "random",
    "plugin",
    "own",
    "anchor",
    "leased",
    "adopted",
    "open",
    "absent",
    "probation",
)

FRAME_MAX: int = _kernel.FRAME_MAX
PRESENT_LEAVING = 2  # in Swarm.present: will be switched off after a last frame
DECAY_STEPS = 4096  # intent: beyond this many control periods a vehicle has settled at its command


class Swarm:
    """Some or all agents of one swarm.

    N agents in all, L of them local, V tables (one an observer; one in all if shared). Vectors are planes.

    :param config: the settings that all agents share.
    :param scenario: starts and goals; default: made from ``config``.
    :param local: ids of the agents that live here, ascending; default: all.
    :param shared_view: one table serves all local agents. Right only where all hear the same, i.e. without loss.
    :param observers: with ``local=[]``: ids of the observers whose tables are kept (0: one that hears everything).
    :raises ConfigError: for ids that do not exist, or settings that need agents that are not here.
    """

    def __init__(
        self,
        config: SwarmConfig,
        scenario: Scenario | None = None,
        local: Sequence[int] | None = None,
        shared_view: bool = False,
        observers: Sequence[int] | None = None,
    ) -> None:
        self.config = config
        self.scenario = make_scenario(config) if scenario is None else scenario
        self.ids: tuple[int, ...] = tuple(range(1, config.agents + 1) if local is None else local)
        self._check_ids("local", self.ids)
        count, agents = len(self.ids), config.agents
        self.local: NDArray[np.int32] = np.array(self.ids, dtype=np.int32) - 1  # (L,) index of each local agent
        seen = observers if observers is not None else ([0] if shared_view else self.ids)
        self._check_ids("observers", tuple(i for i in seen if i))
        self.observer: NDArray[np.int32] = np.array(seen, dtype=np.int32) - 1  # (V,) -1: serves all
        self.shared = bool(shared_view)
        self.rows = np.arange(count)  # table of each local agent, unless shared
        if config.estimator == "oracle" and 0 < count < agents:
            raise ConfigError("estimator", "oracle", "hold, linear or intent: it needs all agents in one process")
        if shared_view and config.policy == "lease":
            raise ConfigError("shared_view", True, "False: with policy lease every agent knows something of its own")
        self._make_tables(len(self.observer), agents)
        self._make_agents(count, config.steps)
        self.course = self.scenario.course(self.local)
        parameters = self._parameters(count)
        self._state = self._arrays()
        self.kernel = _kernel.Swarm(parameters, self._state)
        self.authenticator: Authenticator | None = None
        self.begin = self.kernel.begin
        self.decide = self.kernel.decide
        self.emit = self.kernel.emit
        self.fly = self.kernel.fly
        self.steer = self.kernel.steer
        self.move = self.kernel.move
        self.hear = self.kernel.hear
        self.end = self.kernel.end
        self.estimate = self.kernel.estimate
        self.frame = self.kernel.frame

    def _check_ids(self, name: str, ids: tuple[int, ...]) -> None:
        if list(ids) != sorted(set(ids)) or (ids and not 1 <= ids[0] <= ids[-1] <= self.config.agents):
            raise ConfigError(name, ids, f"ascending ids from 1 to {self.config.agents}")

    def _make_tables(self, views: int, agents: int) -> None:
        planes = (views, 3, agents)
        self.sent_position = np.zeros(planes)  # m, last heard (own entry: last sent), quantised
        self.sent_velocity = np.zeros(planes)  # m/s
        self.sent_intent = np.zeros(planes)  # m/s, commanded velocity, zero where frames do not carry it
        self.sent_slot = np.full((views, agents), -1, dtype=np.int64)  # slot of that state, -1: never heard
        self.last_turn = np.full((views, agents), -1, dtype=np.int64)  # slot of the last turn; h = slot - 1 - last_turn
        self.in_ap = np.ones((views, agents), dtype=np.uint8)  # A_p
        self.estimate_position = np.zeros(planes)  # m, filled by estimate(), fly() and the metrics
        self.estimate_velocity = np.zeros(planes)  # m/s
        self.priority = np.zeros((views, agents))  # g, where the policy computed it
        self.counter = np.zeros((views, agents), dtype=np.int64)  # h (eq:secondary), likewise
        self._entry_hash = np.zeros((views, agents), dtype=np.uint32)
        self._view_hash = np.zeros(views, dtype=np.uint32)

    def _make_agents(self, count: int, steps: int) -> None:
        self.position = np.zeros((3, count))  # m, frame map, true state
        self.velocity = np.zeros((3, count))  # m/s
        self.command = np.zeros((3, count))  # m/s, commanded velocity
        self.goal = np.zeros((3, count))  # m, where each flies to now
        self.track = np.zeros((steps, 3, count))  # m, true positions at the control instants of the last slot
        self.active = np.ones(count, dtype=np.uint8)  # 0: hovers, does not run its avoider
        self.final = np.ones(count, dtype=np.uint8)  # no further goal is scheduled
        self.present = np.ones(count, dtype=np.uint8)  # 0: switched off, neither sends nor flies; 2: leaving
        self.chosen = np.zeros(count, dtype=np.uint16)  # id each takes for this slot's sender, 0: nobody
        self.reason = np.zeros(count, dtype=np.uint8)  # index into REASONS
        self.digest = np.zeros(count, dtype=np.uint32)  # of each agent's table
        self.score = np.zeros(count)  # g of the chosen
        self.sends = np.zeros(count, dtype=np.uint8)
        self.frame_length = np.zeros(count, dtype=np.uint8)  # bytes, 0: silent
        self.frames = np.zeros((count, FRAME_MAX), dtype=np.uint8)
        config = self.config
        lease = _kernel.lease_state_bytes(config.agents, config.anchor_every) if config.policy == "lease" else 0
        self._lease_state = np.zeros((count, lease), dtype=np.uint8)

    def _parameters(self, count: int) -> dict[str, Any]:
        config, model = self.config, flight_model(self.config.avoider, self.config.options)
        key = int(generator(config.seed, STREAM_POLICY).integers(0, 2**63))
        profile = PROFILE_PAPER_INTENT if config.estimator == "intent" else PROFILE_PAPER
        self._decay = decay_table(model.vehicle.tau, config.slot_s / config.steps)
        return {
            "agents": config.agents, "local_count": count, "view_count": len(self.observer), "steps": config.steps,
            "shared": int(self.shared), "slot_s": config.slot_s, "policy": _index(POLICIES, config.policy),
            "estimator": _index(ESTIMATORS, config.estimator), "avoider": model.kind,
            "selection": SELECTIONS.index(config.selection), "epsilon": float(config.epsilon),
            "age_cap": float(config.age_cap), "boot_round": int(config.boot_round), "return_every": config.return_every,
            "r_min": float(config.r_min), "c_r": config.c_r,
            "targets_known": int(config.targets_known and self.scenario.goals_known),
            "profile": PROFILE_EXTENDED if config.extended else profile, "key": key,
            "decay_len": self._decay.shape[1], "tau": model.vehicle.tau, "a_max": model.vehicle.a_max,
            "avoid": model.avoider.to_dict(), "gossip": int(config.gossip), "anchor_every": config.anchor_every,
            "open_every": config.open_period, "adoption": int(config.adoption), "depth_rate": float(config.depth_rate),
            "share": float(config.lease_share),
        }  # fmt: skip

    def _arrays(self) -> dict[str, Any]:
        scenario = self.scenario
        self._start = np.ascontiguousarray(scenario.start, dtype=np.float64)
        self._target = np.array(scenario.target, dtype=np.float64)
        self.known_goal = self._target  # (3, N) m, where all take those to be that rest
        return {
            "local": self.local, "observer": self.observer, "start": self._start, "target": self._target,
            "sent_p": self.sent_position, "sent_v": self.sent_velocity, "sent_c": self.sent_intent,
            "sent_slot": self.sent_slot, "last": self.last_turn, "in_ap": self.in_ap, "entry_hash": self._entry_hash,
            "view_hash": self._view_hash, "est_p": self.estimate_position, "est_v": self.estimate_velocity,
            "g": self.priority, "h": self.counter, "pos": self.position, "vel": self.velocity, "cmd": self.command,
            "goal": self.goal, "track": self.track, "active": self.active, "final": self.final, "present": self.present,
            "chosen": self.chosen, "reason": self.reason, "digest": self.digest, "score": self.score,
            "sends": self.sends, "frame_len": self.frame_length, "frames": self.frames, "decay": self._decay,
            "lease_state": self._lease_state,
        }  # fmt: skip

    def authenticate(self, authenticator: Authenticator) -> None:
        """From now on own frames leave with a tag, and only frames with a right one come in; others are counted.

        :param authenticator: holds the key; one for this swarm alone, because it counts.
        """
        begin, emit, frame, hear = self.begin, self.emit, self.frame, self.hear
        now = 0

        def begin_sealed(slot: int) -> tuple[int, ...]:
            nonlocal now
            now = slot
            return begin(slot)

        def emit_sealed(slot: int) -> tuple[int, ...]:
            nonlocal now
            now = slot
            return emit(slot)

        def frame_sealed(index: int) -> bytes:
            data = frame(index)
            return authenticator.seal(data, now) if data else data

        def hear_opened(slot: int, data: bytes, mask: Any = None) -> bool:
            opened = authenticator.open(bytes(data), slot, late=1)
            return opened is not None and hear(slot, opened, mask)

        self.authenticator = authenticator
        self.begin, self.emit, self.frame, self.hear = begin_sealed, emit_sealed, frame_sealed, hear_opened

    @property
    def rejected(self) -> int:
        """Frames heard that were not authentic: forged, changed, replayed or cut. 0 without a key."""
        return self.authenticator.rejected if self.authenticator else 0

    @property
    def malformed(self) -> int:
        """Frames heard that were none: wrong length, version or fields."""
        return int(self.kernel.malformed)

    @property
    def foreign(self) -> int:
        """Frames of unknown agents or of another time."""
        return int(self.kernel.foreign)

    def reset(self) -> None:
        """Everything back to the start of the run."""
        self.known_goal[:] = self.scenario.target
        self.final[:] = 1
        self.course = self.scenario.course(self.local)
        self.kernel.reset()

    def restart(self, local_index: int) -> None:
        """A local agent's program starts anew: it knows nothing but its settings. Where it is and flies stays as it is.

        :param local_index: position in ``ids``.
        :raises ValueError: with a shared table.
        """
        self.kernel.restart(local_index)

    def with_own_tables(self, slot: int) -> Swarm:
        """The same agents in the same state, each with a table of its own: for the first frame that not all have heard.

        :param slot: the slot that is under way: after ``fly(slot)``, before ``end(slot)``.
        :returns: what takes the place of this swarm, which must not be used any more.
        """
        swarm = Swarm(self.config, self.scenario, local=self.ids)
        if self.authenticator:
            swarm.authenticate(self.authenticator)
        # Lists the senders of the open slot; the state that they sent is copied over what this encodes.
        swarm.sends[:] = self.sends
        swarm.emit(slot)
        for name, values in self._state.items():
            if name != "observer":
                swarm._state[name][...] = values  # the one table becomes everybody's
        swarm.course = self.course
        return swarm

    def leave(self, local_index: int) -> None:
        """A local agent leaves: with policy ``lease`` it says so in its next own turn and is switched off then.

        With other policies it is switched off at once.

        :param local_index: position in ``ids``.
        """
        if self.present[local_index]:
            self.present[local_index] = PRESENT_LEAVING if self.config.policy == "lease" else 0

    def lease_status(self, local_index: int) -> dict[str, Any]:
        """What an agent with policy ``lease`` knows about itself, for diagnostics.

        :param local_index: position in ``ids``.
        :returns: ``probation``, ``deaf`` (bool), ``woke`` (slot, -1: known to be heard), ``alive``, ``absent`` (ids),
            ``silent_slots``.
        """
        status: dict[str, Any] = self.kernel.lease_status(local_index)
        return status

    def reason_name(self, local_index: int) -> str:
        """Why the agent decided as it did in this slot.

        :param local_index: position in ``ids``.
        """
        return REASONS[self.reason[local_index]]


def _index(names: tuple[str, ...], name: str) -> int:
    return names.index(name) if name in names else len(names)


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
