"""Measures a flight of nodes and knows when it is over."""

from __future__ import annotations

import tempfile
import time
import weakref
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Scenario, Swarm
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.runs.delivery import DeliveryCounts
from dtsa_bench.runs.metrics import FlightMetrics, metrics_tables
from dtsa_channel_sim.model.verdict import Verdict
from dtsa_channel_sim.ros.answers import Answers
from dtsa_channel_sim.ros.observer import ChannelObserver


class FlightMeasurement(ChannelObserver):
    """Follows a flight with the metrics, and knows when they say that it is over."""

    def __init__(self, run: RunConfig, scenario: Scenario) -> None:
        self.scenario = scenario
        self.metrics = FlightMetrics(run, scenario)
        self.hearing = DeliveryCounts(run.swarm.agents)
        self.positions = PositionLog(run.swarm.agents)
        self.begin_s = self.end_s = 0.0  # wall clock: slot 0 answered by all, flight over; 0: not yet
        self._tables = metrics_tables(run, scenario, everyone=True)
        self._agents = run.swarm.agents
        self._oracle = run.swarm.estimator_row.needs_everybody
        self._outcome = 0
        self._lengths: list[int] = []  # of the frames of the slot that is being flown
        self._compared = self._tables.digest, self._tables.chosen  # of the slot that is being flown

    @property
    def tables(self) -> Swarm:
        """What each agent knows by what it has received: one table an agent."""
        return self._tables

    @property
    def wall_time_s(self) -> float:
        """Wall-clock time of the flight so far, s."""
        return max(0.0, (self.end_s or time.monotonic()) - self.begin_s) if self.begin_s else 0.0

    def start_known(self, at_s: float) -> None:
        self.begin_s = at_s

    def all_answered(self, slot: int, answers: Answers) -> None:
        self.positions.append(answers.position)
        if not slot:
            self.begin_s = self.begin_s or time.monotonic()
            return
        self.metrics.compare_tables(slot - 1, *self._compared)
        if self._oracle:
            self._tables.estimate_position[:] = answers.position
        if self.metrics.update(slot - 1, answers.track, self._tables, self._outcome, self._lengths):
            self.end_s = time.monotonic()

    def over(self) -> str:
        """Why the flight is over; empty: it goes on."""
        return str(self.metrics.end or "")

    def arbitrated(self, slot: int, answers: Answers, frames: dict[int, bytes], verdict: Verdict) -> None:
        self._outcome = verdict.outcome
        self._compared = answers.digest.copy(), answers.chosen.copy()
        self._lengths = [len(frames[sender]) for sender in verdict.senders]
        self.scenario.advance(slot, self._tables)  # what all know about each other's goals
        mask = verdict.mask(self._agents)
        self.hearing.add_slot(len(verdict.senders), mask)
        if answers.receipts is not None:  # in real time the receivers themselves know best
            for taken in answers.receipts:
                self._hear(taken.slot, taken.data, taken.mask)
        else:
            for row, sender in enumerate(verdict.senders):
                if mask[row].any():
                    self._hear(slot, frames[sender], mask[row])
        self._tables.end(slot)

    def _hear(self, slot: int, data: bytes, mask: NDArray[np.bool_]) -> None:
        if self._tables.hear(slot, data, mask):
            self.hearing.add_accepted(mask)

    def agent_silent(self, agent: int) -> None:
        self.metrics.lose(agent)

    def agents_back(self, agents: list[int]) -> None:
        for agent in agents:
            self.metrics.regain(agent)

    def close(self) -> None:
        self.end_s = self.end_s or (time.monotonic() if self.begin_s else 0.0)

    def summary(self) -> dict[str, Any]:
        """The results so far, with the keys of ``summary.json``."""
        return self.metrics.summary(self.wall_time_s)


_IN_MEMORY = 1 << 20  # bytes; what is longer goes to a temporary file


class PositionLog:
    """(3, N) m at each slot's start, one after the other."""

    def __init__(self, agents: int) -> None:
        self._agents = agents
        self._count = 0
        self._recent = bytearray()
        self._file: IO[bytes] | None = None
        self._full = False

    def __len__(self) -> int:
        return self._count

    def append(self, position: NDArray[np.float64]) -> None:
        """Adds a slot. Where there is no more room on the disk, what comes later is not kept.

        :param position: (3, N) m, frame map.
        """
        if self._full:
            return
        self._recent += position.tobytes()
        self._count += 1
        if len(self._recent) > _IN_MEMORY:
            self._save()

    def _save(self) -> None:
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile()  # noqa: SIM115
                weakref.finalize(self, self._file.close)
            self._file.write(self._recent)
            self._file.flush()
        except OSError:  # a picture then ends early; the flight does not
            self._full = True
            self._count -= len(self._recent) // (24 * self._agents)
        self._recent.clear()

    def array(self) -> NDArray[np.float64]:
        """(T, 3, N) m, all that is kept; a long flight's stays on the disk and is read when it is used."""
        shape = (self._count, 3, self._agents)
        if self._file is None:
            return np.frombuffer(bytes(self._recent), dtype=np.float64).reshape(shape)
        if self._recent:
            self._save()
            shape = (self._count, 3, self._agents)
        return np.memmap(self._file, np.float64, "r", shape=shape)
