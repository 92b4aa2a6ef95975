"""How old the agents' knowledge was in a flight that was merged from their bags, and how wrong their estimates."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Scenario
from dtsa_bench.recordings.bag.run import RecordedRun
from dtsa_bench.recordings.merge.merged_flight import Flown, Moment
from dtsa_bench.recordings.merge.merged_run import MergedRun, read
from dtsa_bench.runs.config import RunConfig

from .followed import Ages, Followed, Observed


def _merged(run: RecordedRun, config: RunConfig) -> MergedRun:
    """The flight that a bag was merged from."""
    assert run.merged is not None
    return read(run.merged, config.swarm, Path(run.name))


def follow_merged(run: RecordedRun, config: RunConfig, scenario: Scenario) -> Followed:
    """A merged flight, by making all decisions again: its ages are those of `merge`."""
    flight = _merged(run, config)
    shape = len(run.slots), run.agents
    ages = Ages(run.slots, np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, np.int64),
                np.zeros(shape[0], np.bool_))  # fmt: skip

    flown = Flown(flight.fly())
    for moment in flown:
        place = moment.slot - flight.common_slot
        if place >= len(run.slots):
            continue  # a bag of which a part is lost
        counted, age, error = _seen(moment)
        counted &= moment.counted
        ages.results[place] = moment.results
        observers = ages.observers[place] = counted.sum(axis=0)
        some = observers > 0
        ages.age[place, some] = np.where(counted, age, 0).sum(axis=0)[some] / observers[some]
        ages.error[place, some] = np.where(counted, error, 0).sum(axis=0)[some] / observers[some]
    return Followed(scenario, ages, flown.results or {}, merged_notes(flight.about, np.flatnonzero(ages.results)))


def _seen(moment: Moment) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.float64]]:
    """What each observer knows of each agent: whether it expects it to move, age (slots), error (m; NaN: not known)."""
    tables = moment.tables
    counted = (tables.in_ap != 0) & (tables.sent_slot >= 0)
    counted[np.arange(len(counted)), tables.observer] = False
    gap = np.sqrt(((tables.estimate_position - moment.position) ** 2).sum(axis=1))
    return counted, moment.slot - tables.sent_slot, gap


def observed_merged(run: RecordedRun, config: RunConfig) -> Iterator[Observed]:
    """What each observer of a merged flight knew, slot by slot; only those of which there is a record."""
    flight = _merged(run, config)
    assert run.told is not None
    for moment in flight.fly():
        place, tables = moment.slot - flight.common_slot, moment.tables
        if place >= len(run.slots):
            continue
        expected, age, error = _seen(moment)
        known = (tables.sent_slot >= 0) & run.told[place][tables.observer][:, None]
        known[np.arange(len(known)), tables.observer] = False
        row, column = np.nonzero(known)
        counted = expected & moment.counted & moment.results
        yield Observed(place, tables.observer[row] + 1, column + 1, age[row, column], error[row, column],
                       counted[row, column])  # fmt: skip


def merged_notes(about: Mapping[str, Any], results: NDArray[np.int64]) -> list[str]:
    """What to know of a merged flight."""
    residual = about["residual_us"]
    notes = [
        f"Merged from {len(about['processes'])} agents' bags. Slot 0 is slot {about['common_slot']} of the agents, the "
        f"first that all counted alike. Half of the frames fit the common time line within {residual['p50']:.0f} us, "
        f"99 % within {residual['p99']:.0f} us. A network does not say why a frame was not received: it counts as lost."
    ]
    for key, text in (
        ("missing", "There is no bag of {}: what they did, and where they were, is not known."),
        ("broken_off", "The bags of {} break off: what they did afterwards is not known."),
        ("not_on_the_time_line", "Left out because frames do not go both ways between them and the others: {}."),
        ("nothing_written", "Nothing was written in {}."),
    ):
        if about.get(key):
            notes.append(text.format(", ".join(f"cf{one}" if isinstance(one, int) else str(one) for one in about[key])))
    if len(results):
        notes.append(
            f"Results are those of slots {results[0]} to {results[-1]}: from when nobody was on probation until "
            "the first agent ended. Completion time counts from there."
        )
    else:
        notes.append("There are no results: at no time had all been heard, with nobody on probation.")
    return notes
