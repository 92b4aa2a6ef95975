"""What is shown of a flight of the demo, read from its bag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import make_scenario
from dtsa_bench.recordings.bag.run import RecordedRun, load_run
from dtsa_bench.recordings.tables.ages import follow_run

from .live import Times
from .story import Step, Take

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Flown:
    """A flight of the demo."""

    take: Take
    summary: Mapping[str, Any]  # as in summary.json
    senders: tuple[tuple[int, ...], ...]  # ids of those that sent, a slot
    position: Array  # (M, 3, N) m, frame map, at the start of each slot
    target: Array  # (3, N) m
    moving: NDArray[np.bool_]  # (N,)
    error_m: Array  # (M,) mean distance of what agents think of each other from what is true; NaN: not known
    times: Times | None = None  # of the flight in which one is killed

    @property
    def slot_s(self) -> float:
        """Length of a slot, s."""
        return float(self.take.run.swarm.slot_s)


Flights = Mapping[str, Flown]  # by key of their take


def of_step(step: Step, flights: Flights) -> list[Flown]:
    """The flights of a step, in its order."""
    return [flights[take.key] for take in step.takes]


def compared_s(found: Sequence[Flown]) -> float:
    """How long all of some flights were under way, s: errors after an arrival say little.

    :param found: the flights.
    """
    ends = [flown.summary["completion_time_s"] or flown.summary["flight_time_s"] for flown in found]
    return max(0.5, int(10 * min(ends)) / 10 - 0.1)


def read(take: Take, bag: Path, summary: Mapping[str, Any], position: Array, times: Times | None = None) -> Flown:
    """Reads a flight's bag.

    :param take: which flight it is.
    :param bag: its bag.
    :param summary: its results.
    :param position: (M, 3, N) m, frame map, at the start of each slot.
    :param times: of the flight in which one is killed.
    :raises BagError: if the bag cannot be read.
    """
    run = load_run(bag)
    error = np.zeros(0)
    ages = None if take.live else follow_run(run).ages
    if ages is not None:
        known = np.isfinite(ages.error)
        total = np.where(known, ages.error, 0.0).sum(axis=1)
        error = np.where(known.any(axis=1), total / np.maximum(1, known.sum(axis=1)), np.nan)
    scenario = make_scenario(take.run.swarm)
    return Flown(take, summary, senders_of(run), position, scenario.target, scenario.moving, error, times)


def senders_of(run: RecordedRun) -> tuple[tuple[int, ...], ...]:
    """Ids of those that sent in each slot, from slot 0 to the last that the channel judged.

    :param run: the recorded run.
    """
    count = int(run.slots[-1]) + 1 if len(run.slots) else 0
    senders: list[list[int]] = [[] for _ in range(count)]
    for slot, sender in zip(run.frames.slot.tolist(), run.frames.sender.tolist(), strict=True):
        if 0 <= slot < count:
            senders[slot].append(sender)
    return tuple(tuple(found) for found in senders)
