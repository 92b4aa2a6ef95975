"""Charts of a sweep: grouped bars, lines, matrices; all with intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, PercentFormatter

from dtsa_bench.drawing.style import (
    CYCLE,
    GRID,
    INK,
    MARKERS,
    ON_DARK,
    ON_LIGHT,
    PAPER,
    QUIET,
    add_legend,
    colours,
    panels,
    style,
)
from dtsa_bench.runs.config import RunLimits

from .flight_figures import estimate, trajectories
from .league import LeagueTable
from .sweep import CRASHED, MEASURES
from .tables import Group, SweepTable, label_of

Spec = Mapping[str, Any]
_GOOD_TO_BAD = LinearSegmentedColormap.from_list("good-bad", ["#e8f4ee", "#f6e3b4", "#dd8a6f", "#a8402b"])
_NEUTRAL = LinearSegmentedColormap.from_list("neutral", ["#eef3f9", "#9dbbdc", "#3d6fa8"])

AXIS_LABELS = {
    "agents": "quadcopters", "moving": "moving quadcopters", "slot_ms": "slot length [ms]", "loss": "loss",
    "scheme": "", "policy": "", "scenario": "", "epsilon": "epsilon",
}  # fmt: skip


def _group(table: SweepTable, labels: Mapping[str, Any]) -> Group | None:
    """All flights with these labels; None if there are none. Levels of axes without a label count together."""
    groups = [group for group in table.select_groups(**labels) if group.rows]
    if len(groups) < 2:
        return groups[0] if groups else None
    return Group(groups[0].cell, [row for group in groups for row in group.rows])


def _points(table: SweepTable, labels: Mapping[str, Any], axis: str, measure: str) -> np.ndarray[Any, Any]:
    """Values and ends of intervals over the levels of an axis, (n, 3); not a number where there is no such group."""
    groups = (_group(table, {axis: level, **labels}) for level in table.levels(axis))
    return np.array([group.point(measure) if group else (math.nan,) * 3 for group in groups])


def _whiskers(points: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Distances from the values to the ends of their intervals, (2, n)."""
    value, low, high = points.T
    return np.nan_to_num(np.maximum(np.stack((value - low, high - value)), 0.0))


def bars(table: SweepTable, spec: Spec, given: Sequence[Axes] | None = None) -> Figure:
    """Grouped bars: a panel a measure, a group for each level of ``x``, a bar for each of ``series``."""
    measures, xs = list(spec["y"]), table.levels(spec["x"])
    series = table.levels(spec["series"]) if "series" in spec else [None]
    shades = colours(xs if series == [None] else series)
    wide = max(3.3, 0.42 * len(xs) * len(series) + 1.2)
    figure, axes = panels(len(measures), width=wide, given=given)
    handles: list[Any] = []
    for axis, measure in zip(axes, measures, strict=True):
        width = 0.8 / len(series)
        for number, name in enumerate(series):
            data = _points(table, {} if name is None else {spec["series"]: name}, spec["x"], measure)
            places = np.arange(len(xs)) + (number - (len(series) - 1) / 2) * width
            drawn = axis.bar(
                places, data[:, 0], width * 0.9, color=shades if name is None else shades[number], linewidth=0
            )
            axis.errorbar(places, data[:, 0], _whiskers(data), fmt="none", ecolor=INK, elinewidth=1, capsize=2)
            if axis is axes[0]:
                handles.append(drawn)
        _dress(axis, table, spec, measure, xs)
    add_legend(axes, handles, series, above=given is None)
    return figure


def _dress(axis: Axes, table: SweepTable, spec: Spec, measure: str, xs: list[Any]) -> None:
    axis.set_title(label_of(measure))
    crowded = any(len(str(x)) > 8 for x in xs)
    axis.set_xticks(
        range(len(xs)), [str(x) for x in xs], rotation=20 if crowded else 0, ha="right" if crowded else "center"
    )
    axis.set_xlabel(AXIS_LABELS.get(spec["x"], spec["x"]))
    axis.grid(axis="x", visible=False)
    axis.tick_params(axis="x", length=0)
    if measure == "min_distance_m":
        for limit in {cell.settings.get("collision_m", RunLimits().collision_m) for cell in table.sweep.cells}:
            axis.axhline(limit, color=QUIET, linewidth=1, linestyle=":")
    if measure in spec.get("log", ()):
        _logarithmic(axis)
    elif measure == "efficiency_mean":
        # Bars of a ratio near 1 differ in the upper part alone; the axis says where it begins.
        low = min((p.get_height() for p in axis.patches if math.isfinite(p.get_height())), default=0.0)
        axis.set_ylim(max(0.0, math.floor(low * 10 - 1) / 10), 1.0)
    if measure == CRASHED:
        axis.yaxis.set_major_formatter(PercentFormatter(1.0))


def lines(table: SweepTable, spec: Spec, given: Sequence[Axes] | None = None) -> Figure:
    """A line for each of ``series`` over the numbers of ``x``; a panel for each of ``facets`` and measure."""
    facets = table.levels(spec["facets"]) if "facets" in spec else [None]
    series = table.levels(spec["series"]) if "series" in spec else [None]
    xs = table.levels(spec["x"])
    shades = colours(series)
    shown = [(facet, measure) for measure in spec["y"] for facet in facets]
    figure, axes = panels(len(shown), width=4.6, height=3.3, columns=2, given=given)
    handles: list[Any] = []
    for axis, (facet, measure) in zip(axes, shown, strict=True):
        for number, name in enumerate(series):
            labels = _labels(spec, facet) | ({} if name is None else {spec["series"]: name})
            data = _points(table, labels, spec["x"], measure)
            finite = np.isfinite(data[:, 0])
            place = np.array(xs, dtype=float)[finite]
            # Lines that lie on each other stay visible: later ones are thinner.
            (line,) = axis.plot(
                place,
                data[finite, 0],
                color=shades[number],
                marker=MARKERS[number % len(MARKERS)],
                linewidth=2.6 - 0.35 * number,
                markersize=5.5 - 0.5 * number,
            )
            axis.fill_between(place, data[finite, 1], data[finite, 2], color=shades[number], alpha=0.13, linewidth=0)
            if axis is axes[0]:
                handles.append(line)
        title = label_of(measure)
        axis.set_title(title if facet is None else f"{title}, {_facet(spec['facets'], facet)}")
        axis.set_xlabel(AXIS_LABELS.get(spec["x"], spec["x"]))
        axis.xaxis.set_major_locator(MaxNLocator(8, integer=all(isinstance(x, int) for x in xs)))
        if measure == CRASHED:
            axis.set_ylim(-0.03, 1.03)
            axis.yaxis.set_major_formatter(PercentFormatter(1.0))
        if measure in spec.get("log", ()):
            _logarithmic(axis)
    add_legend(axes, handles, series, above=given is None)
    return figure


def _logarithmic(axes: Axes, which: str = "y") -> None:
    """A logarithmic axis with plain numbers."""
    axes.set(**{f"{which}scale": "log"})
    axis = axes.yaxis if which == "y" else axes.xaxis
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _facet(axis: str, value: object) -> str:
    return f"{value} ms slots" if axis == "slot_ms" else str(value)


def matrix(table: SweepTable, spec: Spec, given: Sequence[Axes] | None = None) -> Figure:
    """A coloured cell with its number for each of ``rows`` and ``columns``; a panel for each facet and measure."""
    facets = table.levels(spec["facets"]) if "facets" in spec else [None]
    rows, columns = table.levels(spec["rows"]), table.levels(spec["columns"])
    longest = max(len(str(row)) for row in rows)
    wide = max(0.95, 0.095 * max(len(str(column)) for column in columns))
    figure, axes = panels(
        len(spec["y"]) * len(facets),
        width=1.5 + 0.075 * longest + wide * len(columns),
        height=1.05 + 0.36 * len(rows),
        columns=2,
        given=given,
    )
    groups = [
        [
            [_group(table, {spec["rows"]: row, spec["columns"]: column} | _labels(spec, facet)) for column in columns]
            for row in rows
        ]
        for facet in facets
    ]
    for (measure, (number, facet)), axis in zip(product(spec["y"], enumerate(facets)), axes, strict=True):
        values = np.array([
            [[math.nan if group is None else group.point(measure)[0] for group in line] for line in panel]
            for panel in groups
        ])  # fmt: skip
        finite = values[np.isfinite(values)]
        bottom, top = (0.0, 1.0) if measure == CRASHED or not len(finite) else (finite.min(), finite.max())
        for (i, j), value in np.ndenumerate(values[number]):
            if (group := groups[number][i][j]) is not None:
                dark = (value - bottom) / ((top - bottom) or 1.0) > 0.62
                text = _cell_text(group, measure)
                axis.text(j, i, text, ha="center", va="center", fontsize=8.5, color=ON_DARK if dark else ON_LIGHT)
        axis.pcolormesh(
            np.arange(len(columns) + 1) - 0.5,
            np.arange(len(rows) + 1) - 0.5,
            np.ma.masked_invalid(values[number]),
            cmap=_GOOD_TO_BAD if measure == CRASHED else _NEUTRAL,
            vmin=bottom,
            vmax=top or 1.0,
            edgecolors=PAPER,
            linewidth=2,
        )
        title = label_of(measure)
        axis.set_title(title if facet is None else f"{title}: {_facet(spec['facets'], facet)}")
        _dress_matrix(axis, rows, columns, spec)
    return figure


def _labels(spec: Spec, facet: object) -> dict[str, Any]:
    """Labels of the groups in a panel."""
    return {} if facet is None else {spec["facets"]: facet}


def _dress_matrix(axis: Axes, rows: list[Any], columns: list[Any], spec: Spec) -> None:
    axis.invert_yaxis()
    axis.set_xticks(range(len(columns)), [str(column) for column in columns])
    axis.set_yticks(range(len(rows)), [str(row) for row in rows])
    axis.tick_params(length=0)
    axis.grid(visible=False)
    axis.set_facecolor(GRID)
    for side in ("left", "bottom"):
        axis.spines[side].set_visible(False)
    axis.set_xlabel(AXIS_LABELS.get(spec["columns"]) or spec["columns"])
    axis.set_ylabel(AXIS_LABELS.get(spec["rows"]) or spec["rows"])


def _cell_text(group: Group, measure: str) -> str:
    if measure == CRASHED:
        return str(group.crashed)
    value = group.mean(measure).value
    return f"{value:.{MEASURES[measure].digits}f}" if math.isfinite(value) else "–"


_DRAW: dict[str, Callable[..., Figure]] = {
    "bars": bars, "lines": lines, "matrix": matrix, "trajectories": trajectories, "estimate": estimate,
}  # fmt: skip


def draw(table: SweepTable, spec: Spec, given: Sequence[Axes] | None = None) -> Figure:
    """Draw a figure in the house style, as the sweep names it; the first three kinds into axes that are given."""
    with style():
        return _DRAW[spec["kind"]](table, spec, *(() if given is None else (given,)))


def league_scores(table: LeagueTable) -> Figure:
    """Lost flights and age of each entry with 95 % intervals, and its time on the air; the best above."""
    with style():
        names = [entry["name"] for entry in table.entries]
        bounds = [entry["bound"] for entry in table.entries]
        figure, axes = panels(3, width=3.6, height=1.0 + 0.24 * len(names), columns=3)
        shown = (
            ("lost flights", [(s.lost.value, s.lost.low, s.lost.high) for s in table.scores]),
            ("age from waking on [ms]", [s.age_ms for s in table.scores]),
            ("time on the air", [(s.load,) * 3 for s in table.scores]),
        )
        for axis, (title, points) in zip(axes, shown, strict=True):
            for number, (value, low, high) in enumerate(points):
                shade = QUIET if bounds[number] else CYCLE[1]
                axis.plot((low, high), (number, number), color=shade, linewidth=1.6, solid_capstyle="butt")
                axis.plot(value, number, "o", color=shade, markersize=4.5)
            axis.grid(axis="y", visible=False)
            axis.xaxis.set_major_locator(MaxNLocator(5))
            axis.set_title(title)
            axis.set_ylim(len(names) - 0.4, -0.6)
            axis.set_yticks(range(len(names)), names if axis is axes[0] else [""] * len(names))
        axes[0].xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        axes[2].xaxis.set_major_formatter(PercentFormatter(1.0))
        _logarithmic(axes[1], "x")
        for bound, name in zip(bounds, axes[0].get_yticklabels(), strict=True):
            name.set_color(QUIET if bound else INK)
    return figure
