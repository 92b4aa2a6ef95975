"""Real agents of the core, stepped through a log: what they decide, and what they know of each other.

Each agent is where the log says it was, and hears what the log says it heard; what it then decides and estimates
follows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import AgentGroup, Swarm, SwarmConfig, make_scenario
from dtsa_agent.core.errors import RemoteProtocolError
from dtsa_agent.core.frame import TAG_LENGTH, decode_extended
from dtsa_agent.core.plugins.entry_points import make_swarm
from dtsa_agent.keys import with_key
from dtsa_bench.runs.delivery import DeliveryCounts
from dtsa_bench.runs.metrics import metrics_tables

from .arrays import DECIDED, NEW, PRESENT, UNRECORDED, FlightArrays

_MAX_DIFFERENCES = 5  # kept of each replay


class DecisionDifference(NamedTuple):
    """What an agent decided in a slot, by its replay and by the log."""

    slot: int  # as the agent counts
    agent: int  # id
    field: str  # chosen, reason, digest, score or frame
    expected: Any  # bytes of a frame
    recorded: Any


class AgentReplay:
    """Agents with clocks of their own, replayed from a log, slot by slot.

    :param ids: the agents, which know nothing at first.
    :param tags: check the tags of frames; otherwise they are left out: whether they are right was the agents' to say.
    :param goals_told: they were told goals in flight, and none was known to be the last.
    :param compares: what they decide with the log.
    """

    def __init__(
        self, config: SwarmConfig, ids: Sequence[int], tags: bool = False, goals_told: bool = False,
        compares: bool = True,
    ) -> None:  # fmt: skip
        self._config, self._tag_length = config, TAG_LENGTH if config.auth and not tags else 0
        own = config if tags or not config.auth else dataclasses.replace(config, auth=False)
        swarm = make_swarm(own, make_scenario(own), local=list(ids))
        self.swarm = with_key(swarm) if tags else swarm
        if goals_told:
            swarm.final[:] = 0
        self._group, self._columns = AgentGroup(self.swarm), np.array(ids, np.intp) - 1
        self._compares = compares
        self.equal = 0  # decisions, of an agent in a slot
        self.differences: list[DecisionDifference] = []  # the first ones
        self.unsent: dict[tuple[int, int], bytes] = {}  # frames that were made and not sent, by slot and agent

    def step(self, log: FlightArrays, row: int) -> None:
        """Replay a slot of which the log has the agents' accounts."""
        swarm, at, slot = self.swarm, self._columns, log.first_slot + row
        presence = np.full(len(at), PRESENT, np.uint8) if log.presence is None else log.presence[row, at]
        for local in np.flatnonzero(presence & NEW).tolist():
            swarm.restart(local)
        self._hear(log, row, before=True)
        swarm.track[:], swarm.velocity[:] = log.track[row][:, :, at], log.velocity[row][:, at]
        swarm.command[:], swarm.position[:] = log.command[row][:, at], swarm.track[-1]
        if log.merged is not None:
            swarm.goal[:] = log.goal[row][:, at]  # one that flies where it is told to has others than the scenario's
        state = presence & ~np.uint8(NEW | UNRECORDED)
        swarm.present[state != PRESENT] = state[state != PRESENT]
        for local in self._leaving(log, row):
            swarm.leave(local)
        self._group.on_slot(slot)
        if self._compares:
            self._compare(log, row, slot)
        for local in np.flatnonzero((log.length[row, at] == 0) & (presence & UNRECORDED == 0)).tolist():
            swarm.drop(local)  # silent, or too late to send
        self._hear(log, row, before=False)
        self._group.on_slot_end()

    def _hear(self, log: FlightArrays, row: int, before: bool) -> None:
        heard = log.heard
        if heard is None:
            return
        for k in range(log.heard_ends[row], log.heard_ends[row + 1]):
            by = heard.receivers[k, self._columns]
            if heard.before[k] == before and by.any():
                data = heard.data[k]
                self.swarm.hear(int(heard.slot[k]), data[: len(data) - self._tag_length], by.view(np.uint8))

    def _leaving(self, log: FlightArrays, row: int) -> list[int]:
        """The agents that say in their frame that they leave: what made them leave came from outside."""
        if log.merged is not None or not self._config.policy_row.says_leaving:
            return []  # of a network their presence says so
        sent = np.flatnonzero(log.length[row, self._columns]).tolist()
        return [local for local in sent if self._says_leaving(log.frame(row, self.swarm.ids[local]))]

    def _says_leaving(self, frame: bytes) -> bool:
        try:
            return decode_extended(self._config.protocol_part(frame, sealed=True)).leaving
        except RemoteProtocolError:
            return False

    def _compare(self, log: FlightArrays, row: int, slot: int) -> None:
        """Compare what the agents decided for a slot, and their frames, with the log."""
        swarm, at, found = self.swarm, self._columns, {}
        for name in DECIDED:
            expected, recorded = getattr(swarm, name), getattr(log, name)[row, at]
            if expected.tobytes() != recorded.tobytes():
                for local in np.flatnonzero(expected.view(np.uint8) != recorded.view(np.uint8)).tolist():
                    local //= expected.itemsize
                    pair = expected[local].item(), recorded[local].item()
                    found.setdefault(local, DecisionDifference(slot, swarm.ids[local], name, *pair))
        for local in np.flatnonzero((swarm.sends > 0) | (log.length[row, at] > 0)).tolist():
            agent, expected_frame = swarm.ids[local], swarm.frame(local) if swarm.sends[local] else b""
            sent = log.frame(row, agent)
            recorded_frame = sent[: len(sent) - self._tag_length]
            if not sent:
                self.unsent[slot, agent] = expected_frame
            elif recorded_frame != expected_frame:
                found.setdefault(local, DecisionDifference(slot, agent, "frame", expected_frame, recorded_frame))
        self.equal += len(at) - len(found)
        room = _MAX_DIFFERENCES - len(self.differences)
        self.differences += [found[local] for local in sorted(found)[:room]]


def knowledge_tables(log: FlightArrays) -> Swarm:
    """Tables like those of the agents: one that hears everything, or one an agent."""
    config, scenario = log.config, log.scenario
    assert scenario is not None
    shared = log.heard is None and not log.lost.any() and not log.collided.any()
    return metrics_tables(config, scenario, everyone=not shared)


def replay_tables(log: FlightArrays, tables: Swarm, delivery: DeliveryCounts | None = None) -> Iterator[int]:
    """Feed what the agents received to their tables; yields each row at its end.

    :param delivery: counts what was sent, arrived, and was taken in.
    """
    frames = log.sent_frames
    starts = log.sent_ends
    shared = len(tables.observer) == 1 and tables.observer[0] < 0
    scenario = log.scenario
    assert scenario is not None
    for row in range(len(log)):
        scenario.advance(row, tables)
        if delivery is not None:
            delivery.add_slot(starts[row + 1] - starts[row], frames.received[starts[row] : starts[row + 1]])
        if log.heard is not None:
            for k in range(log.heard_ends[row], log.heard_ends[row + 1]):
                if tables.hear(int(log.heard.slot[k]), log.heard.data[k], log.heard.receivers[k].astype(np.uint8)) and delivery:
                    delivery.add_accepted(log.heard.receivers[k])
        else:
            for k in range(starts[row], starts[row + 1]):
                mask = None
                if not shared:
                    mask = frames.received[k].astype(np.uint8)
                    mask[frames.sender[k] - 1] = 1  # who sends knows what it said
                if tables.hear(row, frames.data[k], mask) and delivery is not None:
                    delivery.add_accepted(frames.received[k])
        tables.end(row)
        yield row


# -- ages and errors --------------------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class MeanAges:
    """By slot and agent: means over all observers that still have that agent in A_p; NaN without any."""

    age: NDArray[np.float64]  # slots, (S, N)
    error: NDArray[np.float64]  # m, (S, N)
    observers: NDArray[np.int64]  # (S, N)
    results: NDArray[np.bool_]  # (S,) slots that the means of a flight take

    @classmethod
    def empty(cls, slots: int, agents: int) -> MeanAges:
        """Without an observer in any slot."""
        shape = slots, agents
        return cls(np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, np.int64), np.zeros(slots, np.bool_))

    def set_means(self, slot: int, counted: NDArray[Any], age: NDArray[Any], error: NDArray[Any]) -> None:
        """Set the means of a slot from pairs of observers and agents: who counts, ages and errors, (V, N)."""
        observers = self.observers[slot] = counted.sum(axis=0)
        some = observers > 0
        for mean, values in ((self.age, age), (self.error, error)):
            mean[slot, some] = np.where(counted, values, 0).sum(axis=0)[some] / observers[some]


@dataclass(frozen=True, slots=True)
class ObservedPairs:
    """What each observer knew of each other agent that it had heard, at the end of one slot: P pairs."""

    slot: int
    observer: NDArray[np.int64]  # (P,) ids
    agent: NDArray[np.int64]  # (P,) ids
    age: NDArray[np.int64]  # slots, (P,)
    error: NDArray[np.float64]  # m, (P,)
    counted: NDArray[np.bool_]  # (P,) the observer still has it in A_p, and it moves
