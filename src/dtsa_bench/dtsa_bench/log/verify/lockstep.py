"""Checks a flight in lockstep: everything follows from its configuration, so everything must be equal."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_bench.log.arrays import FlightArrays, LogBuilder
from dtsa_bench.log.bag.errors import UnusableBag
from dtsa_bench.log.replay import replay_lockstep
from dtsa_bench.log.rules import Judge
from dtsa_bench.runs.hearing import Hearing
from dtsa_bench.runs.metrics import FlightMetrics, may_share

from .contents import BagContents, recorded_summary
from .differences import WHY, first_difference, frame_difference
from .result import Difference, Mismatch, Result

_BLOCK = 128  # slots that are compared at once
_NOT_COMPARED = ("wall_time_s", "realtime_factor", "unusable_messages", "not_taken_in")
_ARRAYS = ("length", "chosen", "reason", "digest", "score", "track", "velocity", "command", "goal", "outcome", "lost",
           "collided")  # fmt: skip


class LockstepCheck:
    """A flight in lockstep: everything follows from its configuration, so everything must be equal."""

    def __init__(
        self, log: FlightArrays, contents: BagContents, result: Result, progress: Callable[[int], None] | None
    ) -> None:
        self._log, self._contents, self._result, self._progress = log, contents, result, progress
        self.run = log.config
        self._frames = log.sent_frames
        self._starts = np.searchsorted(self._frames.row, np.arange(len(log) + 1)).tolist()
        self._agreement, self._crowded = True, 0  # all chose alike in every slot; slots with more than one sender

    def check(self) -> None:
        """Compare all slots.

        :raises Mismatch: at the first difference.
        """
        log, result, run = self._log, self._result, self.run
        changes: dict[int, dict[str, Any]] = {}
        for slot, values in self._contents.changes:
            changes.setdefault(slot, {}).update(values)
        builder, judge = LogBuilder(run), Judge(run.swarm)
        done, swarm, hearing = 0, None, Hearing(log.agents)
        metrics: FlightMetrics | None = None
        try:
            for row, swarm, verdict in replay_lockstep(run, len(log), changes, builder, hearing):
                if metrics is None:
                    metrics = FlightMetrics(run, swarm.scenario)
                assert verdict is not None
                frames = builder.frames[row]
                self._crowded += len(frames) > 1
                metrics.compare_tables(row, swarm.digest, swarm.chosen)
                self._agreement = self._agreement and bool((swarm.chosen == swarm.chosen[0]).all())
                judge.slot(row, frames)
                metrics.update(row, swarm.track, swarm, verdict.outcome, [len(data) for data in frames.values()])
                if row + 1 - done == _BLOCK:
                    self._compare(builder, done, row + 1)
                    done = row + 1
                    if self._progress is not None:
                        self._progress(row)
            self._compare(builder, done, len(log))
            done = len(log)
        except Mismatch as mismatch:
            done = mismatch.difference.slot or 0
            raise
        finally:  # those that are equal, wherever it ends
            result.slots = done
            result.simulated_s = done * run.swarm.slot_s
            self._count(done)
        if swarm is None or metrics is None:
            raise UnusableBag(str(log.file), "it holds no whole slot")
        self._check_track(len(log), swarm.track)
        self._check_summary(metrics)
        result.unheard = hearing.problem()
        self._note_safety(metrics, judge)

    def _count(self, slots: int) -> None:
        if slots:
            result = self._result
            result.count("slot records", slots)
            result.count("decisions", slots * self._log.agents)
            result.count("frames", self._starts[slots])

    def _compare(self, builder: LogBuilder, first: int, last: int) -> None:
        """Compare some slots.

        :raises Mismatch: at the first difference.
        """
        log, part = self._log, slice(first, last)
        found: list[tuple[int, Mismatch]] = []
        if not log.known[part].all():
            row, column = (int(index[0]) for index in np.nonzero(~log.known[part]))
            raise Mismatch(Difference("agent", "an account", "none", WHY["known"], first + row, column + 1))
        for name in _ARRAYS:
            expected, recorded = builder.arrays[name][part], getattr(log, name)[part]
            if expected.tobytes() != recorded.tobytes():
                found.append(first_difference(name, expected, recorded, first, log))
        for row in range(first, last):
            expected_frames, a, b = builder.frames[row], self._starts[row], self._starts[row + 1]
            sent = dict(zip(self._frames.sender[a:b].tolist(), self._frames.data[a:b], strict=True))
            if expected_frames != sent:
                found.append((row, frame_difference(expected_frames, sent, row, self.run.swarm.extent_m)))
                break
            if builder.received[row].tobytes() != log.received[a:b].tobytes():
                frame, column = (int(index[0]) for index in np.nonzero(builder.received[row] != log.received[a:b]))
                values = [str(bool(mask[frame, column])) for mask in (builder.received[row], log.received[a:b])]
                sender = int(self._frames.sender[a + frame])
                what = f"received, frame of cf{sender}"
                found.append((row, Mismatch(Difference(what, *values, WHY["received"], row, column + 1))))
                break
        if found:
            raise min(found, key=lambda entry: entry[0])[1]

    def _check_track(self, row: int, expected: NDArray[np.float64]) -> None:
        """Where all were at the end of the last slot."""
        recorded = self._log.track[row]
        if expected.tobytes() != recorded.tobytes():
            raise first_difference("track", expected[None], recorded[None], row, self._log)[1]

    def _check_summary(self, metrics: FlightMetrics) -> None:
        recorded = recorded_summary(self._log, self._result)
        for key, value in json.loads(json.dumps(metrics.summary())).items():
            if key in _NOT_COMPARED or key not in recorded or (key == "end" and recorded[key] == "stopped"):
                continue
            if recorded[key] != value:
                why = "computed from the recorded flight"
                raise Mismatch(Difference(f"summary.json: {key}", str(value), str(recorded[key]), why))
            self._result.count("summary.json")

    def _note_safety(self, metrics: FlightMetrics, judge: Judge) -> None:
        closest, pair = metrics.closest()
        result = self._result
        result.safety = {
            "slots_with_two_senders": self._crowded,
            "all_agents_chose_alike": self._agreement,
            "closest_pair_m": closest,
            "closest_pair": list(pair),
            "crashed": metrics.crash_slot >= 0,
        }
        result.take_judgement(judge)
        lossless = may_share(self.run) and not self._contents.changes
        if lossless and (self._crowded or not self._agreement):
            why = "without loss all agents hear the same and choose the same"
            raise Mismatch(Difference("two senders in one slot", "never", f"{self._crowded} slots", why))


