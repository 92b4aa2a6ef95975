"""Paths of single flights: true ones from above, and true against estimated."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dtsa_bench.drawing import palette
from dtsa_bench.drawing.flight_paths import paint
from dtsa_bench.drawing.style import CYCLE, INK, add_legend, panels
from dtsa_bench.simulation.simulate import SimulatedFlight, simulate

from .tables import SweepTable

Spec = Mapping[str, Any]
TRUE, ESTIMATED, RECEIVED = palette.SERIES[2], INK, palette.SERIES[4]


def _flights(table: SweepTable, spec: Spec) -> list[tuple[str, SimulatedFlight]]:
    """One flight of the first seed for each level of ``facets``, flown again with a log."""
    facets = table.levels(spec["facets"])
    groups = [table.select_groups(**{spec["facets"]: facet})[0] for facet in facets]
    seed = table.sweep.seeds[0]
    return [
        (str(facet), simulate(group.cell.run(seed), log=True, observer=1))
        for facet, group in zip(facets, groups, strict=True)
    ]


def _movers(flight: SimulatedFlight) -> NDArray[np.int64]:
    return np.flatnonzero(flight.scenario.moving)


def trajectories(table: SweepTable, spec: Spec) -> Figure:
    """Paths of the movers from above (fig:12_exp_traj): a panel a level of ``facets``, one seed in all."""
    flights = _flights(table, spec)
    figure, axes = panels(len(flights), width=3.3, height=3.6)
    for axis, (name, flight) in zip(axes, flights, strict=True):
        assert flight.log is not None
        paint(axis, flight.log.positions(), flight.scenario.moving, ids=False)
        axis.set_aspect("equal", "datalim")
        summary = flight.summary()
        time = summary["completion_time_s"]
        axis.set_title(name)
        axis.set_xlabel(
            f"x [m]\n{summary['min_distance_m']:.2f} m apart at least"
            + (f", {time:.2f} s" if time is not None else f", {summary['end']}")
        )
    axes[0].set_ylabel("y [m]")
    return figure


def estimate(table: SweepTable, spec: Spec) -> Figure:
    """A part of a path: flown, as another agent estimated it, and what that one received (fig:estimated)."""
    flights = _flights(table, spec)
    figure, axes = panels(len(flights) + 1, width=3.6, height=3.3, columns=2)
    handles: list[Any] = []
    first, last = _busiest(flights[0][1])
    errors = axes[-1]
    for number, (axis, (name, flight)) in enumerate(zip(axes[:-1], flights, strict=True)):
        assert flight.log is not None
        seen = int(_movers(flight)[-1])
        steps = flight.run.swarm.steps
        window = slice(min(first, len(flight.log) - 2), last)
        true = flight.log.positions()[window.start * steps : window.stop * steps, :, seen]
        believed = flight.log.estimate[window, :, seen]
        slots = flight.log.heard_slot[window, seen]
        received = flight.log.heard_position[window, :, seen]
        new = np.flatnonzero(np.diff(slots, prepend=slots[0]))
        error = np.linalg.norm(believed - true[steps - 1 :: steps][: len(believed)], axis=1)
        lines = [
            axis.plot(true[:, 0], true[:, 1], color=TRUE, linewidth=3.2, alpha=0.75)[0],
            axis.plot(believed[:, 0], believed[:, 1], color=ESTIMATED, linewidth=1.1)[0],
            axis.plot(
                received[new, 0],
                received[new, 1],
                "o",
                color=RECEIVED,
                markersize=5,
                markeredgecolor=INK,
                markeredgewidth=0.5,
            )[0],
        ]
        handles = handles or lines
        axis.set_title(f"estimator {name}")
        axis.set_xlabel(f"x [m]\nerror {100 * error.mean():.1f} cm on average")
        axis.set_aspect("equal", "datalim")
        axis.set_ylabel("y [m]")
        time_s = (window.start + 1 + np.arange(len(error))) * flight.run.swarm.slot_s
        errors.plot(time_s, 100 * error, color=CYCLE[number % len(CYCLE)], linewidth=1.4, label=name)
    errors.set_title("distance between the two [cm]")
    errors.set_xlabel("time [s]")
    errors.legend()
    add_legend(axes, handles, ["flown", "estimated by another", "received"], above=True)
    return figure


def _busiest(flight: SimulatedFlight, length: int = 160) -> tuple[int, int]:
    """The slots in which the shown mover turns most."""
    assert flight.log is not None
    seen = int(_movers(flight)[-1])
    path = flight.log.positions()[flight.run.swarm.steps - 1 :: flight.run.swarm.steps, :, seen]
    bend = np.linalg.norm(np.diff(path, n=2, axis=0), axis=1)
    length = min(length, len(bend))
    sums = np.convolve(bend, np.ones(length), mode="valid")
    start = int(np.argmax(sums))
    return start, start + length
