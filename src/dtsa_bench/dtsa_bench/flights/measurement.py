"""Measures a flight of nodes and knows when it is over."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Scenario
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.runs.delivery import DeliveryCounts
from dtsa_bench.runs.metrics import FlightMetrics, metrics_tables
from dtsa_channel_sim.model.verdict import Verdict
from dtsa_channel_sim.ros.answers import Answers
from dtsa_channel_sim.ros.observer import ChannelObserver

from .statistics import EvenlySpread

_MAX_PATH_BYTES = 1 << 24


class FlightPath(EvenlySpread[NDArray[np.float64]]):
    """Where all were at the starts of slots, each (3, N) m, frame map."""

    def __init__(self, agents: int) -> None:
        super().__init__(_MAX_PATH_BYTES // (3 * agents * 8))
        self._agents = agents

    def array(self) -> NDArray[np.float64]:
        """(T, 3, N) m, frame map."""
        return np.array(self.kept).reshape(-1, 3, self._agents)


class FlightMeasurement(ChannelObserver):
    """Follows a flight with the metrics, and knows when they say that it is over."""

    def __init__(self, run: RunConfig, scenario: Scenario) -> None:
        self.scenario = scenario
        self.metrics = FlightMetrics(run, scenario)
        self.hearing = DeliveryCounts(run.swarm.agents)
        self.positions = FlightPath(run.swarm.agents)
        self.begin_s = self.end_s = 0.0  # wall clock: slot 0 answered by all, flight over; 0: not yet
        self.tables = metrics_tables(run, scenario, everyone=True)  # what each agent knows by what it has received
        self._agents = run.swarm.agents
        self._oracle = run.swarm.estimator_row.needs_everybody
        self._outcome = 0
        self._lengths: list[int] = []  # of the frames of the slot that is being flown
        self._compared = self.tables.digest, self.tables.chosen  # of the slot that is being flown

    @property
    def wall_time_s(self) -> float:
        """Wall-clock time of the flight so far, s."""
        return max(0.0, (self.end_s or time.monotonic()) - self.begin_s) if self.begin_s else 0.0

    def start_known(self, at_s: float) -> None:
        self.begin_s = at_s

    def all_answered(self, slot: int, answers: Answers) -> None:
        self.positions.append(answers.position.copy())
        if not slot:
            self.begin_s = self.begin_s or time.monotonic()
            return
        self.metrics.compare_tables(slot - 1, *self._compared)
        if self._oracle:
            self.tables.estimate_position[:] = answers.position
        if self.metrics.update(slot - 1, answers.track, self.tables, self._outcome, self._lengths):
            self.end_s = time.monotonic()

    def over(self) -> str:
        """Why the flight is over; empty: it goes on."""
        return str(self.metrics.end or "")

    def arbitrated(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        self._outcome, frames = verdict.outcome, answers.frames
        self._compared = answers.digest.copy(), answers.chosen.copy()
        self._lengths = [len(frames[sender]) for sender in verdict.senders]
        self.scenario.advance(slot, self.tables)  # what all know about each other's goals
        mask = verdict.mask(self._agents)
        self.hearing.add_slot(len(verdict.senders), mask)
        heard = [(slot, frames[sender], mask[row]) for row, sender in enumerate(verdict.senders) if mask[row].any()]
        if answers.receipts is not None:  # in real time the receivers themselves know best
            heard = [(taken.slot, taken.data, taken.mask) for taken in answers.receipts.values()]
        for sent_slot, data, receivers in heard:
            if self.tables.hear(sent_slot, data, receivers):
                self.hearing.add_accepted(receivers)
        self.tables.end(slot)

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
