"""Agents in slots as arrays, moved by the compiled core."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from .authentication import Authenticator
from .errors import ConfigError
from .frame import FRAME_MAX, position_step
from .kernel import ffi, fields_of, lib, memory, shared_arrays
from .registry import ESTIMATORS, POLICIES, SELECTIONS
from .settings.config import SwarmConfig
from .settings.flight_models import flight_model
from .settings.scenario import Course, Scenario, check_extent, make_scenario, policy_key

Floats = NDArray[np.float64]
Slots = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Hashes = NDArray[np.uint32]

DECAY_STEPS = 4096  # beyond this many control periods a vehicle has settled at its command (estimator intent)


@lru_cache(maxsize=16)
def _decay(tau: float, step_s: float) -> Floats:
    """Return how a vehicle approaches its command (``dtsa_decay``), read-only, (2, DECAY_STEPS)."""
    decay = np.zeros((2, DECAY_STEPS))
    lib.dtsa_decay(tau, step_s, DECAY_STEPS, memory(decay, writable=True))
    decay.setflags(write=False)
    return decay


class Presence(IntEnum):
    """Whether an agent takes part."""

    ABSENT = 0
    PRESENT = 1
    LEAVING = lib.PRESENT_LEAVING  # it will be switched off after a last frame


class SlotOutcome(IntEnum):
    """Outcome of a slot, as one receiver knows it. Who sends hears nothing else: its own frame counts as FRAME."""

    SILENCE = 0  # nothing was heard; a receiver that cannot tell takes a collision for silence
    FRAME = 1  # a frame of this swarm and this time was heard or sent
    COLLISION = 2  # something was heard that was no frame


class Swarm:
    """Some or all agents of one swarm: what each is, the table of what each knows, and what happens to them in a slot.

    The simulator holds all agents in one; a ROS process holds those it hosts; the verifier and the metrics hold tables
    only. All of them run the same code on the same arrays. One slot ``i`` goes, everywhere and always, in this order::

        senders = swarm.begin(i)        # who sends, from what was heard before slot i
        swarm.fly(i)                    # commands and motion during slot i
        swarm.hear(i, data, mask)       # what the air carried in slot i, once a frame
        swarm.end(i)

    Vectors are planes, in m and m/s, frame map. The arrays are shared with the compiled core: write into them, never
    replace them. There is a table for each observer; one in all if shared.

    :param config: the settings that all agents share.
    :param scenario: starts and goals; default: made from ``config``.
    :param local: ids of the agents that live here, ascending; default: all.
    :param shared_table: one table serves all local agents. Right only where all hear the same, i.e. without loss.
    :param observers: with ``local=[]``: ids of the observers whose tables are kept (0: one that hears everything).
    :raises ConfigError: for ids that do not exist, or settings that need agents that are not here.
    """

    all_in_c = True  # no step is overridden
    flies_in_c = True  # nor are estimates and commands

    # What C borrows, by the names in ``swarm`` (libdtsa_sim/swarm.h). Letters of shapes: n agents, v tables, l local
    # agents, s control instants, f bytes of a frame, p bytes of a policy's state.
    local: Annotated[NDArray[np.int32], "l"]  # index of each local agent
    observer: Annotated[NDArray[np.int32], "v"]  # index of the agent whose table it is, -1: serves all
    sent_position: Annotated[Floats, "v3n"]  # m, last heard (own entry: last sent), quantised
    sent_velocity: Annotated[Floats, "v3n"]  # m/s
    sent_intent: Annotated[Floats, "v3n"]  # m/s, commanded velocity, zero where frames do not carry it
    innovation: Annotated[Floats, "vn"]  # m/s, change of velocity in that state: sum over the axes
    sent_slot: Annotated[Slots, "vn"]  # slot of that state, -1: never heard
    last_turn: Annotated[Slots, "vn"]  # slot of the last turn; h = slot - 1 - last_turn
    in_ap: Annotated[Bytes, "vn"]  # A_p
    estimate_position: Annotated[Floats, "v3n"]  # m, filled by estimate(), fly() and the metrics
    estimate_velocity: Annotated[Floats, "v3n"]  # m/s
    priority: Annotated[Floats, "vn"]  # g of those on whom the policy's choice depended; others NaN
    counter: Annotated[Slots, "vn"]  # h (eq:secondary), likewise
    entry_hash: Annotated[Hashes, "vn"]
    table_hash: Annotated[Hashes, "v"]  # equal hashes, equal tables
    position: Annotated[Floats, "3l"]  # m, frame map, true state
    velocity: Annotated[Floats, "3l"]  # m/s
    command: Annotated[Floats, "3l"]  # m/s, commanded velocity
    goal: Annotated[Floats, "3l"]  # m, where each flies to now
    known_goal: Annotated[Floats, "3n"]  # m, where all take those who rest
    track: Annotated[Floats, "s3l"]  # m, true positions at the control instants of the last slot
    active: Annotated[Bytes, "l"]  # 0: hovers, does not run its avoider
    final: Annotated[Bytes, "l"]  # no further goal is scheduled
    present: Annotated[Bytes, "l"]  # 0: switched off, neither sends nor flies; 2: leaving
    chosen: Annotated[NDArray[np.uint16], "l"]  # id each takes for this slot's sender, 0: nobody
    reason: Annotated[Bytes, "l"]  # index into REASONS
    digest: Annotated[Hashes, "l"]  # of each agent's table
    score: Annotated[Floats, "l"]  # g of the chosen
    sends: Annotated[Bytes, "l"]
    senders: Annotated[NDArray[np.int32], "l"]  # the first are the places of those that send
    frame_length: Annotated[Bytes, "l"]  # of the frames that they send, without bytes of plug-ins and tags; 0: silent
    frames: Annotated[Bytes, "lf"]
    lease_state: Annotated[Bytes, "lp"]
    rejects: Annotated[NDArray[np.uint64], "2"]  # frames heard that were malformed, foreign

    def __init__(
        self, config: SwarmConfig, scenario: Scenario | None = None, local: Sequence[int] | None = None,
        shared_table: bool = False, observers: Sequence[int] | None = None,
    ) -> None:  # fmt: skip
        self.config = config
        self.scenario = make_scenario(config) if scenario is None else scenario
        check_extent(config, self.scenario)
        self.ids = tuple(range(1, config.agents + 1) if local is None else local)  # (L,) ascending
        self._check_ids("local", self.ids)
        tables = tuple(observers if observers is not None else [0] if shared_table else self.ids)
        self._check_ids("observers", tuple(agent for agent in tables if agent))
        self.shared = bool(shared_table)  # one table serves all local agents
        self._check_company()
        self.authenticator: Authenticator | None = None  # seals what leaves, and opens what is heard
        self._slot = 0  # the one that frames are sealed for
        count, steps = len(self.ids), config.steps
        model = flight_model(config.avoider, config.options)
        self._start = np.ascontiguousarray(self.scenario.start, dtype=np.float64)
        self._decay = _decay(model.vehicle.tau, config.slot_s / steps)
        kernel = ffi.new("swarm *", {
            "config": self._protocol(model), "local_count": count, "table_count": len(tables), "shared": self.shared,
            "vehicle": model.vehicle.to_dict(), "announce": config.announce, "goals_known": self.scenario.goals_known,
        })  # fmt: skip
        sizes = {
            "n": config.agents, "v": len(tables), "l": count, "s": steps, "f": FRAME_MAX,
            "p": lib.swarm_policy_bytes(ffi.addressof(kernel, "config")),
        }  # fmt: skip
        self._share_arrays(kernel, sizes)
        self.local[:], self.observer[:], self.final[:] = np.array(self.ids) - 1, np.array(tables) - 1, 1
        self.known_goal[:] = self.scenario.target
        self.course: Course | None = self.scenario.course(self.local, config.r_min)  # how far they are in its plan
        self.kernel = ffi.gc(kernel, lib.swarm_close)
        fault = lib.swarm_open(self.kernel)
        if fault:
            raise ValueError(f"{ffi.string(fault).decode()}: out of range")

    def _check_ids(self, name: str, ids: tuple[int, ...]) -> None:
        if list(ids) != sorted({*ids} & {*range(1, self.config.agents + 1)}):
            raise ConfigError(name, ids, f"ascending ids from 1 to {self.config.agents}")

    def _check_company(self) -> None:
        """Check that all agents are here where policy or estimator needs them, and that they may share a table."""
        config, some = self.config, 0 < len(self.ids) < self.config.agents
        if some and config.estimator_row.needs_everybody:
            others = ", ".join(row.name for row in ESTIMATORS.rows.values() if not row.needs_everybody)
            raise ConfigError("estimator", config.estimator, f"{others}: it needs all agents in one process")
        if some and config.policy_row.needs_everybody:
            raise ConfigError("policy", config.policy, "one that does not look into all agents, or all in one process")
        if self.shared and config.policy_row.agent_state:
            why = f"False: with policy {config.policy} every agent knows something of its own"
            raise ConfigError("shared_table", True, why)

    def _protocol(self, model: Any) -> dict[str, Any]:
        """Return the fields of ``dtsa_config``; what is not named here has the names of the settings."""
        config = self.config
        lease = fields_of("dtsa_lease_config", config, open_every=config.open_period, share=config.lease_share)
        return fields_of(
            "dtsa_config", config, policy=POLICIES.number(config.policy), estimator=ESTIMATORS.number(config.estimator),
            avoider=model.kind, selection=SELECTIONS.index(config.selection),
            profile=config.profile,
            targets_known=config.targets_known and self.scenario.goals_known,
            position_step=position_step(config.extent_m), key=policy_key(config.seed),
            avoid=model.avoider.to_dict(), lease=lease, start=memory(self._start),
            decay=memory(self._decay), decay_len=DECAY_STEPS,
        )  # fmt: skip

    def _share_arrays(self, kernel: Any, sizes: dict[str, int]) -> None:
        """Make the arrays and lend them to C."""
        self._borrowed = []
        for name, (letters, item) in _ARRAYS.items():
            array = np.zeros(tuple(sizes[letter] if letter in sizes else int(letter) for letter in letters), item)
            self._borrowed.append(memory(array, writable=True))
            setattr(self, name, array)
            setattr(kernel, name, self._borrowed[-1])
        self._senders, self._lengths = self.senders.data, self.frame_length.data
        self._frames: list[memoryview] = [row.data for row in self.frames]

    def decide(self, slot: int) -> None:
        """Fill ``chosen``, ``reason``, ``score``, ``digest`` and ``sends`` from what was heard before the slot."""
        lib.swarm_decide(self.kernel, slot)

    def emit(self, slot: int) -> tuple[int, ...]:
        """Encode the frames of all local agents whose ``sends`` is set; returns their positions in ``ids``."""
        self._slot = slot
        return tuple(self._senders[: lib.swarm_emit(self.kernel, slot)])

    def begin(self, slot: int) -> tuple[int, ...]:
        """Decide who sends in a slot, and encode the frames; returns the positions in ``ids`` of those that send."""
        if not self.all_in_c:
            self.decide(slot)
            return self.emit(slot)
        self._slot = slot
        count = lib.swarm_begin(self.kernel, slot)
        return (self._senders[0],) if count == 1 else tuple(self._senders[:count])

    def complete(self, slot: int, senders: Sequence[int], heard: Bytes | None = None, all_hear: bool = True) -> None:
        """The rest of a slot in which the air carries the frames of this swarm alone: :meth:`fly`, `hear`, `end`.

        :param senders: as :meth:`begin` gave them.
        :param heard: (F, V) which tables hear each frame; None: ``all_hear``, or none does.
        """
        if self.all_in_c and self.authenticator is None:
            tables = ffi.NULL if heard is None else heard.tobytes()
            if heard is not None and heard.shape != (len(senders), len(self.observer)):
                raise ValueError(f"heard: shape {heard.shape}")
            lib.swarm_complete(self.kernel, slot, 0, all_hear, tables)
            return
        frames = [self.frame(index) for index in senders]
        self.fly(slot)
        for row, data in enumerate(frames):
            if heard is not None or all_hear:
                self.hear(slot, data, None if heard is None else heard[row])
        self.end(slot)

    def frame(self, local_index: int) -> bytes:
        """The frame that a local agent sends in this slot, as the air carries it; empty if it is silent."""
        data = self._encoded(local_index)
        return data if self.authenticator is None or not data else self.authenticator.seal(data, self._slot)

    def _encoded(self, local_index: int) -> bytes:
        return self._frames[local_index][: self._lengths[local_index]].tobytes()

    def drop(self, local_index: int) -> None:
        """The frame of this slot does not leave: its agent has been silent."""
        self.frame_length[local_index] = 0

    def fly(self, slot: int) -> None:
        """Commands and motion of the local agents during a slot, :meth:`steer` and :meth:`move` at each instant."""
        if self.flies_in_c:
            lib.swarm_fly(self.kernel, slot, 0)
            return
        for step in range(self.config.steps):
            self.steer(slot, step)
            self.move(step)

    def steer(self, slot: int, step: int, estimate: bool = True) -> None:
        """Fill ``command`` for one control instant, 0 .. steps; ``estimate``: whether to fill the estimates first."""
        lib.swarm_steer(self.kernel, slot, self._instant(step), estimate)

    def move(self, step: int) -> None:
        """Move the simulated vehicles on by one control period and note ``track``; step: 0 .. steps - 1."""
        lib.swarm_move(self.kernel, self._instant(step, last=False))

    def estimate(self, slot: int, step: int = 0) -> None:
        """Fill ``estimate_position`` and ``estimate_velocity`` of all tables (eq:estimate); step: 0 .. steps."""
        lib.swarm_estimate_all(self.kernel, slot, self._instant(step))

    def observations(self, slot: int, first: int = 0, end: int | None = None) -> NDArray[np.float32]:
        """What some local agents have heard before a slot, and their own states (docs/how-to/learning.md), (V, F)."""
        end = len(self.ids) if end is None else end
        if self.shared or not 0 <= first <= end <= len(self.ids):
            raise ValueError("observations: of local agents with tables of their own")
        own, planes = lib.SWARM_OBSERVED_OWN, lib.SWARM_OBSERVED_PLANES
        observed = np.empty((end - first, own + planes * self.config.agents), dtype=np.float32)
        lib.swarm_observe(self.kernel, slot, first, end, memory(observed, writable=True))
        return observed

    def _instant(self, step: int, last: bool = True) -> int:
        if not 0 <= step < self.config.steps + last:
            raise ValueError(f"step: got {step}")
        return step

    def hear(self, slot: int, data: bytes, mask: Bytes | None = None) -> bool:
        """Receive what the air carried in a slot; returns whether it was a frame of this swarm and this time.

        :param data: malformed, foreign and forged frames are counted and change nothing.
        :param mask: (V,) which tables hear it; None: all.
        """
        frame = data if self.authenticator is None else self.authenticator.open(bytes(data), slot, late=1)
        return frame is not None and self._receive(slot, frame, mask)

    def _receive(self, slot: int, frame: bytes, mask: Bytes | None) -> bool:
        tables = ffi.NULL if mask is None else mask.tobytes()
        if mask is not None and len(tables) != len(self.observer):
            raise ValueError(f"mask: got {len(tables)} bytes")
        return bool(lib.swarm_hear(self.kernel, slot, bytes(frame), len(frame), tables))

    def end(self, slot: int, collided: Bytes | None = None) -> None:
        """Close a slot after all that was heard in it: counters, silence, and the senders' entries for themselves.

        :param collided: (V,) which receivers noticed a collision; None: they cannot tell it from silence.
        """
        lib.swarm_end(self.kernel, slot)

    def begin_session(self, session: int) -> None:
        """A flight begins: from now on only frames of its session are authentic. Without a key nothing changes."""
        if self.authenticator is not None:
            self.authenticator.begin(session)

    def reset(self) -> None:
        """Everything back to the start of the run."""
        self.known_goal[:] = self.scenario.target
        self.final[:] = 1
        if self.course is not None:
            self.course.reset()
        lib.swarm_reset(self.kernel)

    def restart(self, local_index: int) -> None:
        """A local agent's program starts anew, knowing nothing but its settings; where it is and flies stays."""
        if self.shared:
            raise ValueError("restart: agents that share a table cannot restart alone")
        lib.swarm_restart(self.kernel, self._place(local_index))

    def leave(self, local_index: int) -> None:
        """A local agent leaves: with a policy that says so, after its next own turn; with others at once."""
        if self.present[local_index]:
            self.present[local_index] = Presence.LEAVING if self.config.policy_row.says_leaving else 0

    def with_own_tables(self, slot: int) -> Swarm:
        """The same agents in the same state, each with a table of its own: for the first frame that not all have heard.

        Between ``fly(slot)`` and ``end(slot)``. The result takes the place of this swarm, which is not used any more.
        """
        swarm = Swarm(self.config, self.scenario, local=self.ids)
        swarm.sends[:] = self.sends
        swarm.emit(slot)  # lists the senders of the present slot; what this encodes is written over below
        for name in _ARRAYS.keys() - {"observer"}:
            getattr(swarm, name)[...] = getattr(self, name)  # the one table becomes everybody's
        swarm.course, swarm.authenticator = self.course, self.authenticator
        return swarm

    def lease_status(self, local_index: int) -> dict[str, Any]:
        """What an agent with policy ``lease`` knows about itself, for diagnostics.

        :returns: ``probation``, ``deaf`` (bool), ``woke`` (slot, -1: known to be heard), ``alive``, ``absent`` (ids),
            ``silent_slots``.
        """
        if self.config.policy != "lease":
            raise ValueError(f"policy: got {self.config.policy}")
        status = lib.dtsa_agent_status(self.kernel.agents + self._place(local_index))
        return {
            "probation": bool(status.probation), "deaf": bool(status.deaf), "woke": status.woke, "alive": status.alive,
            "absent": status.absent, "silent_slots": status.silent_slots,
        }  # fmt: skip

    def _place(self, local_index: int) -> int:
        if not 0 <= local_index < len(self.ids):
            raise ValueError(f"local index: got {local_index}")
        return int(local_index)

    @property
    def rejected(self) -> int:
        """Frames heard that were not authentic: forged, changed, replayed or cut. 0 without a key."""
        return 0 if self.authenticator is None else self.authenticator.rejected

    @property
    def malformed(self) -> int:
        """Frames heard that were none: wrong length, version or fields."""
        return int(self.rejects[0])

    @property
    def foreign(self) -> int:
        """Frames of unknown agents or of another time."""
        return int(self.rejects[1])


_ARRAYS = shared_arrays(Swarm, "swarm")
