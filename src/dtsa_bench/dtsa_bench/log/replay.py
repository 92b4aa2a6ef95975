"""Real agents of the core, stepped through a log: what they decide, and what they know of each other.

Each agent is where the log says it was, and hears what the log says it heard; what it then decides and estimates
follows. In lockstep everything follows from the configuration alone: vehicles and channel are stepped too.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import AgentGroup, Swarm, SwarmConfig, make_scenario
from dtsa_agent.core.errors import RemoteProtocolError
from dtsa_agent.core.frame import TAG_LENGTH, decode_extended
from dtsa_agent.core.plugins.entry_points import make_swarm
from dtsa_agent.keys import with_key
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.runs.hearing import Hearing
from dtsa_bench.runs.metrics import metrics_tables
from dtsa_channel_sim import Channel
from dtsa_channel_sim.model.verdict import Verdict

from .arrays import NEW, PRESENT, UNRECORDED, FlightArrays

class HeardBy(NamedTuple):
    """A frame that some of the agents heard."""

    slot: int  # as its sender counts
    data: bytes
    by: NDArray[np.uint8] | None  # (n,) by whom; None: by all


class AgentReplay:
    """Agents with clocks of their own that are where they said they were, and hear what they said they heard.

    In each slot: :meth:`decide`, :meth:`complete`. Arrays have a column an agent (n).

    :param ids: the agents, which know nothing at first.
    :param tags: check the tags of frames; otherwise they are left out: whether they are right was the agents' to say.
    :param goals_told: they were told goals in flight, and none was known to be the last.
    """

    def __init__(self, config: SwarmConfig, ids: Sequence[int], tags: bool = False, goals_told: bool = False) -> None:
        self._config, self._tags = config, tags
        own = config if tags or not config.auth else dataclasses.replace(config, auth=False)
        swarm = make_swarm(own, make_scenario(own), local=list(ids))
        self.swarm = with_key(swarm) if tags else swarm
        if goals_told:
            swarm.final[:] = 0
        self._group = AgentGroup(self.swarm)

    def decide(self, slot: int, state: AgentState, before: Sequence[HeardBy] = ()) -> None:
        """Let the agents decide for a slot.

        :param before: what agents that are new heard before it.
        """
        swarm = self.swarm
        for local in np.flatnonzero(state.presence & NEW).tolist():
            swarm.restart(local)
        self._hear(before)
        swarm.track[:], swarm.position[:] = state.track, state.track[-1]
        swarm.velocity[:], swarm.command[:] = state.velocity, state.command
        if state.goal is not None:
            swarm.goal[:] = state.goal  # one that flies where it is told to has others than the scenario's
        presence = state.presence & ~np.uint8(NEW)
        swarm.present[presence != PRESENT] = presence[presence != PRESENT]
        for local in state.leaving:
            swarm.leave(local)
        self._group.on_slot(slot)

    def complete(self, silent: Sequence[int], heard: Sequence[HeardBy]) -> None:
        """Let the agents hear what they heard in the slot, and close it.

        :param silent: columns of those that did not send, or were too late to.
        """
        for local in silent:
            self.swarm.drop(local)
        self._hear(heard)
        self._group.on_slot_end()

    def _hear(self, heard: Sequence[HeardBy]) -> None:
        tag = TAG_LENGTH if self._config.auth and not self._tags else 0
        for slot, data, by in heard:
            self.swarm.hear(slot, data[: len(data) - tag], by)


class AgentState(NamedTuple):
    """Where agents were at a slot's start; a column an agent (n)."""

    track: NDArray[np.float64]  # (K, 3, n) m
    velocity: NDArray[np.float64]  # (3, n) m/s
    command: NDArray[np.float64]  # (3, n) m/s
    goal: NDArray[np.float64] | None  # (3, n) m; None: those of the scenario
    presence: NDArray[np.uint8]  # (n,) PRESENT or LEAVING, and NEW added
    leaving: Sequence[int] = ()  # columns of those that say in this slot's frame that they leave


def replay_log(log: FlightArrays, tags: bool) -> Iterator[tuple[int, Swarm]]:
    """All agents of a log with clocks of their own, together, up to the first slot that one of them has not told of.

    :param tags: check the tags of frames.
    :returns: each row and the agents, when they have decided.
    """
    config, everybody = log.config.swarm, np.full(log.agents, PRESENT, np.uint8)
    assert log.heard is not None
    replay = AgentReplay(config, range(1, log.agents + 1), tags)
    ends = np.searchsorted(log.heard.row, np.arange(len(log) + 1)).tolist()
    silent = log.length == 0
    if log.presence is not None:
        silent &= (log.presence & UNRECORDED) == 0
    for row in range(len(log)):
        if not log.known[row].all():
            return
        leaving = [column for column in np.flatnonzero(log.length[row]).tolist() if _leaves(config, log, row, column)]
        state = AgentState(log.track[row], log.velocity[row], log.command[row], None, everybody, leaving)
        replay.decide(row, state)
        yield row, replay.swarm
        heard = [
            HeardBy(int(log.heard.slot[k]), log.heard.data[k], log.heard.by[k].view(np.uint8))
            for k in range(ends[row], ends[row + 1])
        ]
        replay.complete(np.flatnonzero(silent[row]).tolist(), heard)


def _leaves(config: SwarmConfig, log: FlightArrays, row: int, column: int) -> bool:
    """Whether an agent says in a frame that it leaves: what made it leave came from outside."""
    if not config.policy_row.says_leaving:
        return False
    try:
        return decode_extended(config.protocol_part(log.frame(row, column + 1), sealed=True)).leaving
    except RemoteProtocolError:
        return False


def knowledge_tables(log: FlightArrays) -> Swarm:
    """Tables like those of the agents: one that hears everything, or one an agent."""
    config, scenario = log.config, log.scenario
    assert scenario is not None
    shared = log.heard is None and not log.lost.any() and not log.collided.any()
    return metrics_tables(config, scenario, everyone=not shared)


def replay_tables(log: FlightArrays, tables: Swarm, hearing: Hearing | None = None) -> Iterator[int]:
    """Feed what the agents received to their tables; yields each row at its end.

    :param hearing: counts what was sent, arrived, and was taken in.
    """
    frames = log.sent_frames
    starts = np.searchsorted(frames.row, np.arange(len(log) + 1)).tolist()
    entries = None if log.heard is None else np.searchsorted(log.heard.row, np.arange(len(log) + 1)).tolist()
    shared = len(tables.observer) == 1 and tables.observer[0] < 0
    scenario = log.scenario
    assert scenario is not None
    for row in range(len(log)):
        scenario.advance(row, tables)
        if hearing is not None:
            hearing.slot(starts[row + 1] - starts[row], frames.received[starts[row] : starts[row + 1]])
        if log.heard is not None and entries is not None:
            for k in range(entries[row], entries[row + 1]):
                if tables.hear(int(log.heard.slot[k]), log.heard.data[k], log.heard.by[k].astype(np.uint8)) and hearing:
                    hearing.take_in(log.heard.by[k])
        else:
            for k in range(starts[row], starts[row + 1]):
                mask = None
                if not shared:
                    mask = frames.received[k].astype(np.uint8)
                    mask[frames.sender[k] - 1] = 1  # who sends knows what it said
                if tables.hear(row, frames.data[k], mask) and hearing is not None:
                    hearing.take_in(frames.received[k])
        tables.end(row)
        yield row
