"""What every swarm is: the state of its agents as arrays, and the steps of a slot.

:class:`.swarm.Swarm` runs the steps on the compiled core. A :class:`SwarmWrapper` changes some of
them and hands the rest on: authentication, plug-ins and vehicles that fly elsewhere are made of it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.compiled import kernel as _kernel
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.reference import frame, rules
from dtsa_agent.core.registry import ESTIMATORS
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.course import Course
from dtsa_agent.core.settings.scenario import Scenario, check_extent, make_scenario

Floats = NDArray[np.float64]
Slots = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Hashes = NDArray[np.uint32]

FRAME_MAX = frame.FRAME_MAX  # bytes
PRESENT_LEAVING = rules.LEAVES  # in ``present``: will be switched off after a last frame


class SwarmState:
    """State of some or all agents of one swarm: what each is, and the table of what each knows.

    N agents in all, L of them local, V tables (one an observer; one in all if shared), S control instants a slot.
    Vectors are planes. The arrays are shared with the compiled core: write into them, never replace them.
    """

    config: SwarmConfig
    scenario: Scenario
    course: Course | None  # where the local agents are in the scenario's plan
    kernel: _kernel.Swarm | None  # for the metrics, which read tables without a copy; None: the reference has none
    ids: tuple[int, ...]  # (L,) of the local agents, ascending
    local: NDArray[np.int32]  # (L,) index of each local agent
    observer: NDArray[np.int32]  # (V,) index of the agent whose table it is, -1: serves all
    shared: bool  # one table serves all local agents
    rows: NDArray[np.intp]  # (L,) table of each local agent, unless shared

    sent_position: Floats  # (V, 3, N) m, last heard (own entry: last sent), quantised
    sent_velocity: Floats  # (V, 3, N) m/s
    sent_intent: Floats  # (V, 3, N) m/s, commanded velocity, zero where frames do not carry it
    sent_slot: Slots  # (V, N) slot of that state, -1: never heard
    last_turn: Slots  # (V, N) slot of the last turn; h = slot - 1 - last_turn
    in_ap: Bytes  # (V, N) A_p
    estimate_position: Floats  # (V, 3, N) m, filled by estimate(), fly() and the metrics
    estimate_velocity: Floats  # (V, 3, N) m/s
    priority: Floats  # (V, N) g of those on whom the policy's choice depended; others NaN (the specification has all)
    counter: Slots  # (V, N) h (eq:secondary), likewise
    entry_hash: Hashes  # (V, N)
    table_hash: Hashes  # (V,) equal hashes, equal tables
    known_goal: Floats  # (3, N) m, where all take those to be that rest

    position: Floats  # (3, L) m, frame map, true state
    velocity: Floats  # (3, L) m/s
    command: Floats  # (3, L) m/s, commanded velocity
    goal: Floats  # (3, L) m, where each flies to now
    track: Floats  # (S, 3, L) m, true positions at the control instants of the last slot
    active: Bytes  # (L,) 0: hovers, does not run its avoider
    final: Bytes  # (L,) no further goal is scheduled
    present: Bytes  # (L,) 0: switched off, neither sends nor flies; 2: leaving
    chosen: NDArray[np.uint16]  # (L,) id each takes for this slot's sender, 0: nobody
    reason: Bytes  # (L,) index into REASONS
    digest: Hashes  # (L,) of each agent's table
    score: Floats  # (L,) g of the chosen
    sends: Bytes  # (L,)
    lease_state: Bytes  # (L, bytes of policy lease), of the compiled core

    def _begin(
        self,
        config: SwarmConfig,
        scenario: Scenario | None,
        local: Sequence[int] | None,
        shared_table: bool,
        observers: Sequence[int] | None,
    ) -> None:
        """Who is here, and arrays for all of it; see :class:`~dtsa_agent.core.swarms.swarm.Swarm`."""
        self.config = config
        self.scenario = make_scenario(config) if scenario is None else scenario
        check_extent(config, self.scenario)
        self.ids = tuple(range(1, config.agents + 1) if local is None else local)
        self._check_ids("local", self.ids)
        count = len(self.ids)
        self.local = np.array(self.ids, dtype=np.int32) - 1
        seen = observers if observers is not None else ([0] if shared_table else self.ids)
        self._check_ids("observers", tuple(i for i in seen if i))
        self.observer = np.array(seen, dtype=np.int32) - 1
        self.shared = bool(shared_table)
        self.rows = np.arange(count)
        if config.estimator_row.needs_everybody and 0 < count < config.agents:
            others = ", ".join(row.name for row in ESTIMATORS.rows.values() if not row.needs_everybody)
            allowed = f"{others}: it needs all agents in one process"
            raise ConfigError("estimator", config.estimator, allowed)
        if config.policy_row.needs_everybody and 0 < count < config.agents:
            raise ConfigError("policy", config.policy, "one that does not look into all agents, or all in one process")
        if shared_table and config.policy_row.agent_state:
            why = f"False: with policy {config.policy} every agent knows something of its own"
            raise ConfigError("shared_table", True, why)
        self._make_tables(len(self.observer), config.agents)
        self._make_agents(count, config.steps)
        self.course = self.scenario.course(self.local)

    def _check_ids(self, name: str, ids: tuple[int, ...]) -> None:
        if list(ids) != sorted(set(ids)) or (ids and not 1 <= ids[0] <= ids[-1] <= self.config.agents):
            raise ConfigError(name, ids, f"ascending ids from 1 to {self.config.agents}")

    def _make_tables(self, tables: int, agents: int) -> None:
        planes = (tables, 3, agents)
        self.sent_position, self.sent_velocity, self.sent_intent = (np.zeros(planes) for _ in range(3))
        self.sent_slot = np.full((tables, agents), -1, dtype=np.int64)
        self.last_turn = np.full((tables, agents), -1, dtype=np.int64)
        self.in_ap = np.ones((tables, agents), dtype=np.uint8)
        self.estimate_position, self.estimate_velocity = np.zeros(planes), np.zeros(planes)
        self.priority = np.zeros((tables, agents))
        self.counter = np.zeros((tables, agents), dtype=np.int64)
        self.entry_hash = np.zeros((tables, agents), dtype=np.uint32)
        self.table_hash = np.zeros(tables, dtype=np.uint32)

    def _make_agents(self, count: int, steps: int) -> None:
        self.position, self.velocity, self.command, self.goal = (np.zeros((3, count)) for _ in range(4))
        self.track = np.zeros((steps, 3, count))
        self.active, self.final, self.present = (np.ones(count, dtype=np.uint8) for _ in range(3))
        self.chosen = np.zeros(count, dtype=np.uint16)
        self.reason, self.sends = (np.zeros(count, dtype=np.uint8) for _ in range(2))
        self.digest = np.zeros(count, dtype=np.uint32)
        self.score = np.zeros(count)
        self.lease_state = np.zeros((count, 0), dtype=np.uint8)


class AbstractSwarm(SwarmState, ABC):
    """Some or all agents of one swarm, and what happens to them in a slot.

    One slot ``i`` goes, everywhere and always, in this order::

        senders = swarm.begin(i)        # who sends, from what was heard before slot i
        swarm.fly(i)                    # commands and motion during slot i
        swarm.hear(i, data, mask)       # what the air carried in slot i, once a frame
        swarm.end(i)
    """

    @abstractmethod
    def decide(self, slot: int) -> None:
        """Fills ``chosen``, ``reason``, ``score``, ``digest`` and ``sends`` from what was heard before the slot.

        :param slot: the slot that begins.
        """

    @abstractmethod
    def emit(self, slot: int) -> tuple[int, ...]:
        """Encodes the frames of all local agents whose ``sends`` is set.

        :param slot: the slot that begins.
        :returns: their positions in ``ids``.
        """

    @abstractmethod
    def begin(self, slot: int) -> tuple[int, ...]:
        """Decides who sends in a slot, and encodes the frames: :meth:`decide` and :meth:`emit`.

        :param slot: the slot that begins.
        :returns: positions in ``ids`` of those that send.
        """

    @abstractmethod
    def frame(self, local_index: int) -> bytes:
        """The frame that a local agent sends in this slot, as the air carries it; empty if it is silent.

        :param local_index: position in ``ids``.
        """

    @abstractmethod
    def drop(self, local_index: int) -> None:
        """The frame of this slot does not leave: its agent has been silent.

        :param local_index: position in ``ids``.
        """

    @abstractmethod
    def fly(self, slot: int) -> None:
        """Commands and motion of the local agents during a slot, :meth:`steer` and :meth:`move` at each instant.

        :param slot: the slot, after :meth:`begin`.
        """

    @abstractmethod
    def steer(self, slot: int, step: int, estimate: bool = True) -> None:
        """Fills ``command`` for one control instant.

        :param slot: the slot.
        :param step: control instant within the slot, 0 .. steps.
        :param estimate: whether to fill the estimates first.
        """

    @abstractmethod
    def move(self, step: int) -> None:
        """Moves the simulated vehicles on by one control period and notes ``track``.

        :param step: control instant at which the period begins, 0 .. steps - 1.
        """

    @abstractmethod
    def hear(self, slot: int, data: bytes, mask: Bytes | None = None) -> bool:
        """Takes in a frame that the air carried.

        :param slot: the slot in which it is heard.
        :param data: its bytes; malformed and foreign frames are counted and change nothing.
        :param mask: (V,) which tables hear it; None: all.
        :returns: whether it was a frame of this swarm and this time.
        """

    @abstractmethod
    def end(self, slot: int, collided: Bytes | None = None) -> None:
        """Closes a slot: counters, silence, and the senders' entries for themselves.

        :param slot: the slot, after all that was heard in it.
        :param collided: (V,) which receivers noticed a collision; None: they cannot tell it from silence.
        """

    @abstractmethod
    def estimate(self, slot: int, step: int = 0) -> None:
        """Fills ``estimate_position`` and ``estimate_velocity`` of all tables (eq:estimate).

        :param slot: the slot.
        :param step: control instant within the slot, 0 .. steps.
        """

    @abstractmethod
    def unseal(self, data: bytes, slot: int, late: int = 0) -> bytes | None:
        """The frame in some bytes from the air; None (and counted) if its authentication fails.

        :param data: the bytes heard.
        :param slot: the slot they were heard in.
        :param late: slots by which a frame may arrive after its own.
        """

    def begin_session(self, session: int) -> None:
        """A flight begins: from now on only frames of its session are authentic. Without a key nothing changes.

        :param session: number of the flight.
        """

    @abstractmethod
    def reset(self) -> None:
        """Everything back to the start of the run."""

    @abstractmethod
    def restart(self, local_index: int) -> None:
        """A local agent's program starts anew, knowing nothing but its settings; where it is and flies stays.

        :param local_index: position in ``ids``.
        :raises ValueError: with a shared table.
        """

    @abstractmethod
    def leave(self, local_index: int) -> None:
        """A local agent leaves: with a policy that says so, after its next own turn; with others at once.

        :param local_index: position in ``ids``.
        """

    @abstractmethod
    def with_own_tables(self, slot: int) -> AbstractSwarm:
        """The same agents in the same state, each with a table of its own: for the first frame that not all have heard.

        :param slot: the slot that is under way: after ``fly(slot)``, before ``end(slot)``.
        :returns: what takes the place of this swarm, which must not be used any more.
        """

    @abstractmethod
    def lease_status(self, local_index: int) -> dict[str, Any]:
        """What an agent with policy ``lease`` knows about itself, for diagnostics.

        :param local_index: position in ``ids``.
        :returns: ``probation``, ``deaf`` (bool), ``woke`` (slot, -1: known to be heard), ``alive``, ``absent`` (ids),
            ``silent_slots``.
        """

    @abstractmethod
    def reason_name(self, local_index: int) -> str:
        """Why the agent decided as it did in this slot, one of ``REASONS``.

        :param local_index: position in ``ids``.
        """

    @property
    def rejected(self) -> int:
        """Frames heard that were not authentic: forged, changed, replayed or cut. 0 without a key."""
        return 0

    @property
    def malformed(self) -> int:
        """Frames heard that were none: wrong length, version or fields."""
        return 0

    @property
    def foreign(self) -> int:
        """Frames of unknown agents or of another time."""
        return 0


class SwarmWrapper(AbstractSwarm):
    """Another swarm with some steps changed: a wrapper overrides these, and the rest goes to the swarm inside.

    State is that of the swarm inside, array by array.

    :param inner: the swarm inside; from now on it is used through the wrapper only.
    """

    def __init__(self, inner: AbstractSwarm) -> None:
        self.inner = inner
        for name in SwarmState.__annotations__:
            setattr(self, name, getattr(inner, name))

    # The steps are documented in AbstractSwarm.

    def decide(self, slot: int) -> None:
        self.inner.decide(slot)

    def emit(self, slot: int) -> tuple[int, ...]:
        return self.inner.emit(slot)

    def begin(self, slot: int) -> tuple[int, ...]:
        return self.inner.begin(slot)

    def frame(self, local_index: int) -> bytes:
        return self.inner.frame(local_index)

    def drop(self, local_index: int) -> None:
        self.inner.drop(local_index)

    def fly(self, slot: int) -> None:
        self.inner.fly(slot)

    def steer(self, slot: int, step: int, estimate: bool = True) -> None:
        self.inner.steer(slot, step, estimate)

    def move(self, step: int) -> None:
        self.inner.move(step)

    def hear(self, slot: int, data: bytes, mask: Bytes | None = None) -> bool:
        return self.inner.hear(slot, data, mask)

    def end(self, slot: int, collided: Bytes | None = None) -> None:
        self.inner.end(slot, collided)

    def estimate(self, slot: int, step: int = 0) -> None:
        self.inner.estimate(slot, step)

    def unseal(self, data: bytes, slot: int, late: int = 0) -> bytes | None:
        return self.inner.unseal(data, slot, late)

    def begin_session(self, session: int) -> None:
        self.inner.begin_session(session)

    def reset(self) -> None:
        self.inner.reset()

    def restart(self, local_index: int) -> None:
        self.inner.restart(local_index)

    def leave(self, local_index: int) -> None:
        self.inner.leave(local_index)

    def with_own_tables(self, slot: int) -> AbstractSwarm:
        """Only swarms that can share a table have to give it up.

        :raises ValueError: always: a wrapper that may share a table overrides this.
        """
        raise ValueError(f"{type(self).__name__}: agents have tables of their own already")

    def lease_status(self, local_index: int) -> dict[str, Any]:
        return self.inner.lease_status(local_index)

    def reason_name(self, local_index: int) -> str:
        return self.inner.reason_name(local_index)

    @property
    def rejected(self) -> int:
        """Frames heard that were not authentic."""
        return self.inner.rejected

    @property
    def malformed(self) -> int:
        """Frames heard that were none."""
        return self.inner.malformed

    @property
    def foreign(self) -> int:
        """Frames of unknown agents or of another time."""
        return self.inner.foreign
