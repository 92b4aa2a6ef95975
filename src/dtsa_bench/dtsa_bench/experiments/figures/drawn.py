"""The figures that a sweep names, by their kind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from matplotlib.figure import Figure

from dtsa_bench.drawing.style import style
from dtsa_bench.experiments.sweep.aggregate import Table

from . import charts, flights

_DRAW: dict[str, Callable[[Table, Any], Figure]] = {
    "bars": charts.bars, "lines": charts.lines, "matrix": charts.matrix, "trajectories": flights.trajectories,
    "estimate": flights.estimate,
}  # fmt: skip


def draw(table: Table, spec: Mapping[str, Any]) -> Figure:
    """Draws a figure in the house style.

    :param table: the sweep's groups.
    :param spec: the figure as the sweep names it.
    """
    with style():
        return _DRAW[spec["kind"]](table, spec)
