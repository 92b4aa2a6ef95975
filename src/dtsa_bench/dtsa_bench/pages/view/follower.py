"""Follows a run by its messages on the ROS graph, and adds its moments to a history."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import make_scenario
from dtsa_agent.core.errors import DtsaError
from dtsa_agent.ros.common.cdr import split_frames, unpack_received
from dtsa_bench.log.arrays import recorded_config
from dtsa_bench.log.replay import TableReplay
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.runs.delivery import OncePerFault

from .history import MAX_BELIEVERS, PROCESS_COMMANDS, MomentBuilder, RunHistory

_MAX_CRASH_AGENTS = 100  # in larger swarms no crashes are detected
_FARTHEST_M = 1e6


class Follower:
    """Receives a run's messages slot by slot; those that cannot be used are counted and left out.

    Objects of rclpy and of other decoders will do: only the fields' names and contents matter.
    """

    def __init__(self, history: RunHistory, info: Mapping[str, Any]) -> None:
        """:param info: further values for the page."""
        self._history, self._more = history, dict(info)
        self._run: RunConfig | None = None
        self._end_reason = ""
        self.unusable = 0

    @property
    def has_settings(self) -> bool:
        """Whether the run's settings are known."""
        return self._run is not None

    def start(self, settings: Mapping[str, Any]) -> None:
        """Set up for a run with settings as its Configuration message and its bag hold them.

        :raises DtsaError: if they cannot be used.
        """
        if self._run is not None:
            return
        run = recorded_config(settings)
        self._run, self.scenario, self.agents = run, make_scenario(run.swarm), run.swarm.agents
        self._replay: TableReplay | None = None
        if self.agents <= MAX_BELIEVERS:
            with suppress(DtsaError):  # frames with a key that is not here, or a policy that is not installed
                self._replay = TableReplay(run, self.scenario, everyone=True)
        self._delivery_fault = OncePerFault(run.swarm.slot_ns)
        self._builder = MomentBuilder(self._history, run, self.scenario, self._more)
        self._position = np.array(self.scenario.start)  # (3, N) m
        self._chosen = np.zeros(self.agents, np.uint16)
        self._digest = np.zeros(0, np.uint32)  # of those that have reported the last slot
        self._reason = np.zeros(self.agents, np.uint8)
        self._slot = 0  # the slot that is under way
        self._next = 0  # first slot of the next moment
        self._crashed: set[tuple[int, int]] = set()
        self._lag_ms = 0.0
        self._pairs = np.triu_indices(self.agents, 1)

    def receive(self, kind: str, message: Any) -> None:
        """Receive a message; `kind` is its type without the package, as ``SlotRecord``."""
        try:
            if kind == "Configuration":
                settings = json.loads(message.settings)
                if isinstance(settings, dict):
                    self.start(settings)
            elif self._run is not None and (handler := self._HANDLERS.get(kind)):
                handler(self, message)
        except (ValueError, TypeError, IndexError, KeyError, OverflowError, RecursionError, DtsaError):
            self.unusable += 1

    def _index(self, ids: Any) -> NDArray[np.intp]:
        index = np.asarray(ids, dtype=np.intp) - 1
        if len(index) and not (index.min() >= 0 and index.max() < self.agents):
            raise ValueError("an id that is none of the swarm's")
        return index

    def note(self, text: str) -> None:
        """Add an event of now."""
        if self._run is not None:
            self._builder.add_event(self._slot, "note", text)

    def _receive_record(self, record: Any) -> None:
        """One slot: where agents are at its start, what they decide, its frames, and which agents received them."""
        slot, index, senders = int(record.slot), self._index(record.agent), np.asarray(record.sender).tolist()
        self._index(senders)
        mask = unpack_received(bytes(np.asarray(record.received, np.uint8)), len(senders), self.agents)
        mask[:, [agent - 1 for agent in self._builder.absent]] = 0  # no frame reaches those that do not take part
        frames = split_frames(bytes(np.asarray(record.data, np.uint8)), np.asarray(record.length).tolist())
        received = [(slot, frame, row) for frame, row in zip(frames, mask, strict=True) if row.any()]
        position = self._position.copy()  # of agents that are lost: the last one
        position[:, index] = np.reshape(record.track, (record.steps, 3, len(index)))[-1]
        if not np.abs(position).max() < _FARTHEST_M:
            raise ValueError("positions that are no numbers, or far away")
        if not len(record.chosen) == len(record.digest) == len(record.reason) == len(index):
            raise ValueError("decisions of other agents")
        self._position = position
        self._chosen[:], self._reason[:] = 0, 0
        self._chosen[index] = np.asarray(record.chosen, np.uint16)
        self._digest = np.asarray(record.digest, np.uint32)
        self._reason[index] = np.asarray(record.reason, np.uint8)
        self._detect_crashes(slot)
        if slot >= self._next:
            self._next = slot + self._builder.period
            self._builder.add_positions(slot, position)
            self._add_moment(slot)
        if self._replay is not None:
            self._replay.delivery.add_slot(len(senders), mask)
            self._replay.step(slot, received)
        self._builder.add_frames(slot, int(record.outcome), senders, self._reason, mask.astype(bool))
        self._builder.add_choices(self._chosen[index])
        self._slot = slot + 1

    def _add_moment(self, slot: int) -> None:
        tables, problem = None, ""
        if self._replay is not None:
            self._replay.estimate(slot, self._position)
            tables, problem = self._replay.tables, self._replay.delivery.problem()
        if problem := self._delivery_fault.fault_to_report(slot, problem):
            self._builder.add_event(slot, "bad", problem)
        self._builder.append_moment(slot, tables, self._chosen, self._digest, lag_ms=round(self._lag_ms, 2))

    def _detect_crashes(self, slot: int) -> None:
        if self.agents > _MAX_CRASH_AGENTS or self.agents < 2 or self._run is None:
            return
        one, other = self._pairs
        gap = ((self._position[:, one] - self._position[:, other]) ** 2).sum(axis=0)
        for k in np.flatnonzero(gap < self._run.limits.collision_m**2).tolist():
            pair = int(one[k]) + 1, int(other[k]) + 1
            if pair not in self._crashed:
                self._crashed.add(pair)
                self._builder.add_crash(slot, pair, math.sqrt(gap[k]))

    def _receive_status(self, message: Any) -> None:
        """Which agents have fallen silent, how late the channel is, and whether the run is over."""
        slot, lost = int(message.slot), set((self._index(message.lost) + 1).tolist())
        lag_ms = float(message.lag_ms)
        if not math.isfinite(lag_ms):  # no page reads that
            raise ValueError("a lag that is no number")
        for agent in sorted(lost - self._builder.absent):
            self._builder.lose(slot, agent, f"cf{agent} has fallen silent")
        for agent in sorted(self._builder.absent - lost):
            self._builder.regain(slot, agent, f"cf{agent} takes part again")
        self._lag_ms = lag_ms
        if message.phase == 2 and not self._end_reason:  # RunStatus.ENDED
            self._end_reason = str(message.reason)[:300] or "over"
            self._builder.add_event(slot, "end", f"the run has ended: {self._end_reason}")

    def _receive_change(self, message: Any) -> None:
        """A setting of the channel was changed while it ran."""
        for parameter in list(message.changed_parameters)[:20]:
            value = parameter.value
            fields = (value.bool_value, value.integer_value, value.double_value, value.string_value)
            text = repr(fields[int(value.type) - 1])[:80] if 1 <= int(value.type) <= 4 else "?"
            if parameter.name in PROCESS_COMMANDS:
                self._builder.add_event(self._slot, "note", f"{parameter.name} cf{text}")
            else:
                self._builder.add_event(self._slot, "air", f"{str(parameter.name)[:40]} is {text} from now on")

    def finish(self, state: str) -> None:
        """Add the last moment; `state` tells people why no more will come."""
        if self._run is not None and self._slot:
            self._add_moment(self._slot)
        self._history.state = f"{state}: {self._end_reason}" if self._end_reason else state

    _HANDLERS: Mapping[str, Callable[[Follower, Any], None]] = {
        "SlotRecord": _receive_record,
        "RunStatus": _receive_status,
        "ParameterEvent": _receive_change,
    }
