"""How old the agents' knowledge of each other was, and how wrong their estimates, slot by slot; and the results."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import DtsaError
from dtsa_agent.core.settings.scenario import make_scenario
from dtsa_bench.runs.delivery import as_sentence
from dtsa_bench.runs.metrics import FlightMetrics

from .arrays import UNKNOWN, FlightArrays, recorded_config
from .merged_flight import KnownSlot, MergedReplay
from .replay import TableReplay


@dataclass(frozen=True, slots=True)
class MeanAges:
    """By slot and agent: means over all observers that still have that agent in A_p; NaN without any."""

    age: NDArray[np.float64]  # slots, (S, N)
    error: NDArray[np.float64]  # m, (S, N)
    observers: NDArray[np.int64]  # (S, N)
    results: NDArray[np.bool_]  # (S,) slots that the means of a flight take


class ObservedPairs(NamedTuple):
    """What each observer knew of each other agent that it had heard, at the end of one slot: P pairs."""

    slot: NDArray[np.int64]  # (P,)
    observer: NDArray[np.int64]  # (P,) ids
    agent: NDArray[np.int64]  # (P,) ids
    age: NDArray[np.int64]  # slots, (P,)
    error: NDArray[np.float64]  # m, (P,)
    counted: NDArray[np.bool_]  # (P,) the observer still has it in A_p, and it moves


@dataclass(frozen=True, slots=True)
class Knowledge:
    """What a log gives when it is followed slot by slot; nothing where it does not hold enough."""

    ages: MeanAges | None
    summary: dict[str, Any]  # as in summary.json
    notes: list[str] = field(default_factory=list)  # what is left out, and why


def knowledge_of(log: FlightArrays) -> Knowledge:
    """What the agents of a log knew, and the results, by the one definition of `FlightMetrics`; computed once."""
    known = log.__dict__.get("_knowledge")
    if not isinstance(known, Knowledge):
        known = log.__dict__["_knowledge"] = _follow(log)
    return known


def why_without_ages(log: FlightArrays) -> str:
    """Why a log does not hold enough to know what the agents knew; empty: it does."""
    try:
        config = recorded_config(log.settings)
        make_scenario(config.swarm)
    except (DtsaError, TypeError, ValueError) as error:
        return f"Ages, estimates and results are left out: the configuration cannot be used ({error})."
    complete = len(log) and log.recorded.all() and log.agents == config.swarm.agents
    if not complete or (log.merged is None and not log.known.any(axis=0).all()):
        return f"Ages, estimates and results are left out: {log.missing or 'all slots'} are missing in the bag."
    return ""


def _follow(log: FlightArrays) -> Knowledge:
    if why := why_without_ages(log):
        return Knowledge(None, {}, [why])
    replay = _replay_of(log)
    shape = len(log), log.agents
    age, error, observers = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, np.int64)
    results = np.zeros(len(log), np.bool_)
    for slot in replay:
        counted, ages, gaps = slot.pairs()
        counted &= slot.counted
        observers[slot.row] = counted.sum(axis=0)
        results[slot.row] = slot.results
        some = observers[slot.row] > 0
        for mean, values in ((age, ages), (error, gaps)):
            mean[slot.row, some] = np.where(counted, values, 0).sum(axis=0)[some] / observers[slot.row, some]
    if replay.is_shared:
        observers *= log.agents - 1
    return Knowledge(MeanAges(age, error, observers, results), replay.results or {}, replay.notes)


def observed(log: FlightArrays) -> Iterator[ObservedPairs]:
    """What each observer knew, slot by slot; nothing where the log does not hold enough."""
    if why_without_ages(log):
        return
    replay, ids = _replay_of(log), np.arange(1, log.agents + 1)
    for slot in replay:
        expected, age, error = slot.pairs()
        observers = ids if replay.is_shared else slot.tables.observer + 1  # one table may stand for those of all
        known = (slot.tables.sent_slot >= 0) & (ids != observers[:, None])
        if log.merged is not None:
            expected &= slot.results
            known &= log.known[slot.row, observers - 1][:, None]
        at, column = np.nonzero(known)
        values = [np.broadcast_to(array, known.shape)[at, column] for array in (age, error, expected & slot.counted)]
        rows = np.full(len(at), slot.row, np.int64)
        yield ObservedPairs(rows, observers[at].astype(np.int64), column + 1, *values)


def _replay_of(log: FlightArrays) -> _WholeReplay | MergedReplay:
    return _WholeReplay(log) if log.merged is None else MergedReplay(log, compares=False)


class _WholeReplay(TableReplay):
    """The tables of all agents of a log that was recorded as one, slot by slot."""

    def __init__(self, log: FlightArrays) -> None:
        assert log.scenario is not None
        everyone = log.heard is not None or bool(log.lost.any()) or bool(log.collided.any())
        super().__init__(log.config, log.scenario, everyone)
        self._log, self._metrics = log, FlightMetrics(log.config, log.scenario)
        self._absent = np.zeros(log.agents, np.bool_)  # in the slot that is replayed

    @property
    def results(self) -> dict[str, Any]:
        """The results, as in summary.json."""
        return self._metrics.summary()

    @property
    def notes(self) -> list[str]:
        """Why agents did not hear each other."""
        return [as_sentence(problem)] if (problem := self.delivery.problem()) else []

    def __iter__(self) -> Iterator[KnownSlot]:
        log, metrics, sent = self._log, self._metrics, self._log.sent_frames
        track, digest = self._filled_track(), np.zeros(log.agents, np.uint32)
        for row in range(len(log)):
            self._note_absent(row)
            frames = slice(log.sent_ends[row], log.sent_ends[row + 1])
            self.delivery.add_slot(frames.stop - frames.start, log.reached[frames])
            if log.heard is None:
                slots = [row] * (frames.stop - frames.start)
                heard = zip(slots, sent.data[frames], sent.received[frames], strict=True)
                self.step(row, heard, sent.sender[frames].tolist())
            else:
                part = slice(log.heard_ends[row], log.heard_ends[row + 1])
                columns = log.heard.slot[part].tolist(), log.heard.data[part], log.heard.receivers[part]
                self.step(row, zip(*columns, strict=True))
            digest = np.where(log.known[row], log.digest[row], digest)
            metrics.compare_tables(row, digest, log.chosen[row])
            outcome = int(log.outcome[row])
            sizes = [len(data) for data in sent.data[frames]]
            metrics.update(row, track[row + 1], self.tables, outcome if outcome < UNKNOWN else 0, sizes)
            self.estimate(row + 1, track[row + 1, -1])
            yield KnownSlot(row, row, self.tables, track[row + 1, -1], metrics.counted, row + 1 >= log.agents)

    def _note_absent(self, row: int) -> None:
        """Agents come and go before a slot, as in flight."""
        if self._log.absent is None:
            return
        before, self._absent = self._absent, self._log.absent[row]
        for column in np.flatnonzero(self._absent & ~before).tolist():
            self._metrics.lose(column + 1)
            if not self._log.absent[row:, column].all():
                self._metrics.awaited.add(column + 1)
        for column in np.flatnonzero(before & ~self._absent).tolist():
            self._metrics.regain(column + 1)

    def _filled_track(self) -> NDArray[np.float64]:
        """Positions, with the last known one where an agent has not told: its vehicle is taken to stay."""
        track = self._log.track
        unknown = np.isnan(track).any(axis=(1, 2))  # (S + 1, N)
        if not unknown.any():
            return track
        filled, last = track.copy(), self.scenario.start
        for row in range(len(track)):
            filled[row][:, :, unknown[row]] = last[:, unknown[row]]
            last = filled[row, -1]
        return filled
