"""Figures of the league: scores with their intervals, and ages by cell."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, PercentFormatter

from dtsa_bench.drawing.style import CYCLE, INK, QUIET, panels, style

from .table import LeagueTable, figure


def scores(table: LeagueTable) -> Figure:
    """Lost flights, age and air time of each entry, with 95 % intervals, and the interval of its rank; the best above.

    :param table: the entries.
    """
    with style():
        names = [entry["name"] for entry in table.entries]
        drawn, axes = panels(4, width=3.0, height=1.0 + 0.24 * len(names), columns=4)
        found = [entry["summary"] for entry in table.entries]
        bounds = [place.rank is None for place in table.places]
        _dots(axes[0], [(s["lost"] / s["flights"], s["lost_low"], s["lost_high"]) for s in found], bounds)
        axes[0].xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        axes[0].set_title("lost flights")
        _dots(axes[1], [(s["age_ms"], s["age_low_ms"], s["age_high_ms"]) for s in found], bounds)
        axes[1].set_xscale("log")
        axes[1].xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes[1].xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes[1].xaxis.set_minor_formatter(NullFormatter())
        axes[1].set_title("age from waking on [ms]")
        _dots(axes[2], [(s["air"], s["air_low"], s["air_high"]) for s in found], bounds)
        axes[2].xaxis.set_major_formatter(PercentFormatter(1.0))
        axes[2].set_title("time on the air")
        ranks = [(place.rank, place.first, place.last) if place.rank else (math.nan,) * 3 for place in table.places]
        _dots(axes[3], ranks, bounds)
        axes[3].xaxis.set_major_locator(MaxNLocator(6, integer=True))
        axes[3].set_title("rank")
        for axis in axes:
            axis.set_ylim(len(names) - 0.4, -0.6)
            axis.set_yticks(range(len(names)), names if axis is axes[0] else [""] * len(names))
        for place, name in zip(table.places, axes[0].get_yticklabels(), strict=True):
            name.set_color(QUIET if place.rank is None else INK)
    return drawn


def _dots(axis: Axes, points: Sequence[tuple[float | None, ...]], bounds: list[bool]) -> None:
    data = np.array(points, dtype=float)
    for number, (value, low, high) in enumerate(data):
        shade = QUIET if bounds[number] else CYCLE[1]
        axis.plot((low, high), (number, number), color=shade, linewidth=1.6, solid_capstyle="butt")
        axis.plot(value, number, "o", color=shade, markersize=4.5)
    axis.grid(axis="y", visible=False)
    axis.xaxis.set_major_locator(MaxNLocator(5))


def cells(table: LeagueTable) -> Figure:
    """Age in each cell over that of the best entry there, coloured; a cell's number is its age in ms.

    :param table: the entries.
    """
    with style():
        names = [entry["name"] for entry in table.entries]
        ages = np.array(
            [[entry["summary"]["cells"][cell]["age_ms"] for cell in table.cells] for entry in table.entries]
        )
        lost = [[entry["summary"]["cells"][cell]["lost"] for cell in table.cells] for entry in table.entries]
        drawn, (axis,) = panels(1, width=1.6 + 0.72 * len(table.cells), height=1.5 + 0.27 * len(names))
        shown = np.log10(ages / ages.min(axis=0))
        axis.pcolormesh(
            shown, cmap="Blues", vmin=0.0, vmax=max(1.0, float(shown.max())), edgecolors="white", linewidth=2
        )
        for (row, column), age in np.ndenumerate(ages):
            text = figure(float(age)) + (f"\n{lost[row][column]} lost" if lost[row][column] else "")
            dark = shown[row, column] > 0.6 * max(1.0, float(shown.max()))
            axis.text(
                column + 0.5, row + 0.5, text, ha="center", va="center", fontsize=6.5, color="white" if dark else INK
            )
        axis.set_xticks(np.arange(len(table.cells)) + 0.5, table.cells, rotation=35, ha="right")
        axis.set_yticks(np.arange(len(names)) + 0.5, [f"{n}" for n in names])
        axis.invert_yaxis()
        axis.grid(visible=False)
        axis.tick_params(length=0)
        axis.set_title("age from waking on [ms]; darker: more than the best in the cell")
    return drawn
