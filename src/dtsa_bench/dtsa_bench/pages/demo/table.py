"""The numbers of the demo's flights, side by side."""

from __future__ import annotations

from collections.abc import Sequence

from dtsa_bench.experiments.batch.table import aligned

from .flown import Flights, of_step
from .story import Step
from .text import age, agreement, error, lines

HEAD = ["", "flying", "frames lost", "known state is", "position wrong by", "all agree on the sender", "closest"]


def rows(steps: Sequence[Step], flights: Flights) -> list[list[str]]:
    """A row a flight that is the same on every machine, below `HEAD`.

    :param steps: the steps of the demo.
    :param flights: its flights.
    """
    found = []
    for step in steps:
        for line, flown in zip(lines(step, flights), of_step(step, flights), strict=True):
            if flown.take.live:
                continue
            summary = flown.summary
            found.append([
                f"{step.number} {line.name}", f"{summary['moving']} of {summary['agents']}",
                f"{100 * summary['loss']:.0f} %", f"{age(flown)} old", error(flown), agreement(flown),
                f"{summary['min_distance_m']:.2f} m",
            ])  # fmt: skip
    return found


def for_terminal(steps: Sequence[Step], flights: Flights) -> str:
    """The table for a terminal."""
    return aligned([HEAD, *rows(steps, flights)], rule=True)
