"""Real agents of the core, stepped through a log: what they decide, and what they know of each other.

Each agent is where the log says it was, and hears what the log says it heard; what it then decides and estimates
follows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import AgentGroup, Scenario, make_scenario
from dtsa_agent.core.errors import RemoteProtocolError
from dtsa_agent.core.frame import TAG_LENGTH, decode_extended
from dtsa_agent.core.plugins import make_swarm
from dtsa_agent.keys import with_key
from dtsa_bench.runs.config import RunConfig
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

    :param ids: the agents, one after the other, which know nothing at first.
    :param tags: check the tags of frames; otherwise they are left out: whether they are right was the agents' to say.
    :param goals_told: they were told goals in flight, and none was known to be the last.
    :param compares: what they decide with the log.
    """

    def __init__(
        self, log: FlightArrays, ids: Sequence[int], tags: bool = False, goals_told: bool = False, compares: bool = True
    ) -> None:
        config = self._config = log.config.swarm
        self._log, self._compares, self._at = log, compares, slice(ids[0] - 1, ids[-1])
        self._tag_length = TAG_LENGTH if config.auth and not tags else 0
        own = config if tags or not config.auth else dataclasses.replace(config, auth=False)
        swarm = make_swarm(own, make_scenario(own), local=list(ids))
        self.swarm = with_key(swarm) if tags else swarm
        if goals_told:
            swarm.final[:] = 0
        self._group = AgentGroup(self.swarm)
        presence = log.presence
        self._presence = np.full_like(log.length, PRESENT)[:, self._at] if presence is None else presence[:, self._at]
        self._sent = log.sent[:, self._at]
        self._ends, self._heard = self._list_heard()
        self.equal = 0  # decisions, of an agent in a slot
        self.differences: list[DecisionDifference] = []  # the first ones
        self.unsent: dict[tuple[int, int], bytes] = {}  # frames that were made and not sent, by slot and agent

    def _list_heard(self) -> tuple[list[int], list[tuple[bool, int, bytes, NDArray[np.uint8]]]]:
        """Where those of each slot begin, and frames that these agents heard: before the slot, sent in, by whom."""
        heard = self._log.heard
        if heard is None:
            return [0] * (len(self._log) + 1), []
        by = np.ascontiguousarray(heard.receivers[:, self._at])
        own = np.flatnonzero(by.any(axis=1))
        ends = np.searchsorted(heard.row[own], np.arange(len(self._log) + 1)).tolist()
        data = [heard.data[k][: len(heard.data[k]) - self._tag_length] for k in own.tolist()]
        columns = heard.before[own].tolist(), heard.slot[own].tolist(), data, list(by[own].view(np.uint8))
        return ends, list(zip(*columns, strict=True))

    def step(self, row: int) -> None:
        """Replay a slot of which the log has the agents' accounts."""
        log, swarm, at, slot = self._log, self.swarm, self._at, self._log.first_slot + row
        presence = self._presence[row]
        for local in np.flatnonzero(presence & NEW).tolist():
            swarm.restart(local)
        self._hear(row, before=True)
        swarm.track[:], swarm.velocity[:] = log.track[row][:, :, at], log.velocity[row][:, at]
        swarm.command[:], swarm.position[:] = log.command[row][:, at], swarm.track[-1]
        if log.merged is not None:
            swarm.goal[:] = log.goal[row][:, at]  # one that flies where it is told to has others than the scenario's
        state = presence & ~np.uint8(NEW | UNRECORDED)
        swarm.present[state != PRESENT] = state[state != PRESENT]
        for local in self._leaving(row):
            swarm.leave(local)
        self._group.on_slot(slot)
        if self._compares:
            self._compare(row, slot)
        for local in np.flatnonzero(~self._sent[row] & (presence & UNRECORDED == 0)).tolist():
            swarm.drop(local)  # silent, or too late to send
        self._hear(row, before=False)
        self._group.on_slot_end()

    def _hear(self, row: int, before: bool) -> None:
        for early, slot, data, by in self._heard[self._ends[row] : self._ends[row + 1]]:
            if early == before:
                self.swarm.hear(slot, data, by)

    def _leaving(self, row: int) -> list[int]:
        """The agents that say in their frame that they leave: what made them leave came from outside."""
        if self._log.merged is not None or not self._config.policy_row.says_leaving:
            return []  # of a network their presence says so
        sent = np.flatnonzero(self._sent[row]).tolist()
        return [local for local in sent if self._says_leaving(self._log.frame(row, self.swarm.ids[local]))]

    def _says_leaving(self, frame: bytes) -> bool:
        try:
            return decode_extended(self._config.protocol_part(frame, sealed=True)).leaving
        except RemoteProtocolError:
            return False

    def _compare(self, row: int, slot: int) -> None:
        """Compare what the agents decided for a slot, and their frames, with the log."""
        log, swarm, found = self._log, self.swarm, dict[int, DecisionDifference]()
        for name in DECIDED:
            expected, recorded = getattr(swarm, name), getattr(log, name)[row, self._at]
            if expected.tobytes() != recorded.tobytes():
                for local in np.flatnonzero(expected.view(np.uint8) != recorded.view(np.uint8)).tolist():
                    local //= expected.itemsize
                    pair = expected[local].item(), recorded[local].item()
                    found.setdefault(local, DecisionDifference(slot, swarm.ids[local], name, *pair))
        for local in np.flatnonzero((swarm.sends > 0) | self._sent[row]).tolist():
            agent, expected_frame = swarm.ids[local], swarm.frame(local) if swarm.sends[local] else b""
            sent = log.frame(row, agent)
            recorded_frame = sent[: len(sent) - self._tag_length]
            if not sent:
                self.unsent[slot, agent] = expected_frame
            elif recorded_frame != expected_frame:
                found.setdefault(local, DecisionDifference(slot, agent, "frame", expected_frame, recorded_frame))
        self.equal += len(swarm.ids) - len(found)
        room = _MAX_DIFFERENCES - len(self.differences)
        self.differences += [found[local] for local in sorted(found)[:room]]


class TableReplay:
    """Tables like those of the agents, fed with what each of them received.

    :param everyone: a table for each agent; otherwise one that hears everything.
    """

    def __init__(self, run: RunConfig, scenario: Scenario, everyone: bool) -> None:
        self.scenario, self.delivery = scenario, DeliveryCounts(run.swarm.agents)
        self.tables = metrics_tables(run, scenario, everyone=everyone)
        self.is_shared = len(self.tables.observer) == 1 and int(self.tables.observer[0]) < 0

    def step(self, slot: int, heard: Iterable[tuple[int, bytes, NDArray[Any]]], senders: Sequence[int] = ()) -> None:
        """Replay a slot.

        :param heard: slot of each frame, its bytes and who received it, (N,).
        :param senders: ids of their senders, which know what they sent.
        """
        self.scenario.advance(slot, self.tables)
        for k, (sent_slot, data, received) in enumerate(heard):
            mask = None if self.is_shared else received.astype(np.uint8)
            if mask is not None and senders:
                mask[senders[k] - 1] = 1
            if self.tables.hear(sent_slot, data, mask):
                self.delivery.add_accepted(received)
        self.tables.end(slot)

    def estimate(self, slot: int, position: NDArray[np.float64]) -> None:
        """Where the agents take each other to be when a slot starts; `position`: (3, N) m, where they are."""
        if self.tables.config.estimator_row.needs_everybody:
            self.tables.estimate_position[:] = position
        else:
            self.tables.estimate(slot)
