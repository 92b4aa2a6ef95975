"""The cost of a slot against the number of agents."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from dtsa_bench.drawing.style import MARKERS, QUIET, colours, legend_above, panels

Row = dict[str, Any]


def cost_figure(rows: Sequence[Row], avoided: Sequence[Row] = ()) -> Figure:
    """Time of a whole slot over the number of agents, both logarithmic.

    :param rows: ``agents``, ``policy`` and ``core_us`` of each point.
    :param avoided: rows with pyrvo's times (``pyrvo_ten_us``), drawn for comparison.
    """
    figure, (axis,) = panels(1, width=5.6, height=3.9)
    names: list[str] = list(dict.fromkeys(row["policy"] for row in rows))
    handles: list[Any] = []
    for index, (name, shade) in enumerate(zip(names, colours(names), strict=True)):
        points = sorted((row["agents"], row["core_us"]) for row in rows if row["policy"] == name)
        handles += axis.plot(*zip(*points, strict=True), color=shade, marker=MARKERS[index])
    others = [(row["agents"], row["pyrvo_ten_us"]) for row in avoided if "pyrvo_ten_us" in row]
    if others:
        handles += axis.plot(*zip(*others, strict=True), color=QUIET, linestyle="--", marker="x")
        names.append("pyrvo, avoidance alone")
    axis.set_xscale("log")
    axis.set_yscale("log")
    sizes = sorted({row["agents"] for row in rows})
    axis.set_xticks(sizes, [str(size) for size in sizes])
    axis.minorticks_off()
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_title("one slot of the whole swarm [µs]")
    axis.set_xlabel("quadcopters, all moving")
    legend_above(figure, handles, names)
    return figure
