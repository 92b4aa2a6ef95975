"""Figures. Each function returns a `matplotlib.figure.Figure`; nothing is shown or saved.

Flights of a sweep that differ in an axis without a place in the figure count together.

In a notebook a cell that ends with a figure shows it. `ax` draws into axes of a figure of your own: one axes, or as
many as the figure has panels.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.drawing.flight_paths import paint
from dtsa_bench.drawing.style import QUIET, colours, panels, style
from dtsa_bench.experiments import charts
from dtsa_bench.experiments.sweep import check_figure
from dtsa_bench.log.flight_log import FlightLog

from ._sweep import SweepResult


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _show_in_notebooks() -> None:
    """Notebooks show figures that pyplot has made; ours are made without it, so IPython has to be told."""
    ipython: Any = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    if shell is not None:
        formatter = shell.display_formatter.formatters["image/png"]
        if Figure not in formatter.type_printers:  # another one did, perhaps with settings
            formatter.for_type(Figure, _png)


_show_in_notebooks()

Panels = Axes | Sequence[Axes] | None


def _listed(ax: Panels) -> list[Axes] | None:
    """Return the axes that a caller gave, in a row; None: the figure gets new ones."""
    return None if ax is None else list(np.ravel(np.array(ax, dtype=object)))


def plot_trajectories(*flights: FlightLog, titles: Sequence[str] | None = None, ax: Panels = None) -> Figure:
    """Paths of the movers from above: a panel a flight, rings where they start and discs where they end.

    :param flights: simulated or recorded flights.
    :param titles: one a flight; None: policy and estimator.
    :param ax: axes to draw in; None: a new figure.

    >>> flights = [dtsa.simulate(agents=4, policy=policy) for policy in ("tdma", "lease")]
    >>> figure = plot_trajectories(*flights)  # figure.savefig("paths.png")
    >>> plot_distances(*flights, ax=figure.axes[0]) is figure  # into axes of a figure that is there
    True

    :raises ConfigError: without a flight, or for a number of titles that does not fit.
    """
    names = _titles(flights, titles)
    with style():
        figure, axes = panels(len(flights), width=3.3, height=3.6, given=_listed(ax))
        for axis, flight, name in zip(axes, flights, names, strict=True):
            paint(axis, flight.path, flight.moving, ids=False)
            axis.set_aspect("equal", "datalim")
            axis.set_title(name)
            axis.set_xlabel("x [m]")
        axes[0].set_ylabel("y [m]")
    return figure


def plot_distances(*flights: FlightLog, titles: Sequence[str] | None = None, ax: Panels = None) -> Figure:
    """Smallest distance between any two agents over time, m over s; the dotted line is where two have crashed.

    :param flights: simulated or recorded flights, a line each.
    :param titles: one a flight; None: policy and estimator.
    :param ax: axes to draw in; None: a new figure.
    :raises ConfigError: without a flight, or for a number of titles that does not fit.
    """
    title = "smallest distance [m]"
    return _plot_over_time(
        flights, titles, ax, title, lambda flight: flight.distances.set_index("time_s")["distance_m"], crash=True
    )


def plot_ages(*flights: FlightLog, titles: Sequence[str] | None = None, ax: Panels = None) -> Figure:
    """Mean age of what the agents know of each other over time, slots over s.

    :param flights: simulated or recorded flights, a line each.
    :param titles: one a flight; None: policy and estimator.
    :param ax: axes to draw in; None: a new figure.
    :raises ConfigError: without a flight, for a number of titles that does not fit, or if pandas is missing.
    """
    return _plot_over_time(
        flights, titles, ax, "mean age [slots]", lambda flight: flight.ages.groupby("time_s")["age_slots"].mean()
    )


def _plot_over_time(
    flights: Sequence[FlightLog], titles: Sequence[str] | None, ax: Panels, title: str,
    series: Callable[[FlightLog], Any], crash: bool = False,
) -> Figure:  # fmt: skip
    """A line a flight: its series by time, s; with `crash` a dotted one where two have crashed."""
    names = _titles(flights, titles)
    with style():
        figure, (axis,) = panels(1, width=5.6, height=3.6, given=_listed(ax))
        for flight, name, shade in zip(flights, names, colours(list(range(len(flights)))), strict=True):
            values = series(flight)
            axis.plot(values.index, values.to_numpy(), color=shade, label=name)
        if crash:  # before the limits of the axis are fixed, so that it is always within them
            axis.axhline(flights[0].config.limits.collision_m, color=QUIET, linewidth=1, linestyle=":")
        axis.set(title=title, xlabel="time [s]", ylim=(0, None))
        if len(flights) > 1:
            axis.legend()
    return figure


def plot_bars(
    result: SweepResult, *, x: str, y: str | Sequence[str], series: str | None = None, ax: Panels = None
) -> Figure:
    """Grouped bars of a sweep with 95 % intervals: a panel a measure.

    :param result: the sweep.
    :param x: axis whose levels are the groups.
    :param y: measures: `crashed` or a measure of `SweepResult.table`.
    :param series: axis whose levels are the bars of a group.
    :param ax: axes to draw in; None: a new figure.
    :raises ConfigError: for an axis or a measure that does not exist.
    """
    return _chart(result, "bars", y, ax, x=x, series=series)


def plot_lines(
    result: SweepResult, *, x: str, y: str | Sequence[str], series: str | None = None, facets: str | None = None,
    ax: Panels = None,
) -> Figure:  # fmt: skip
    """Lines over the numbers of an axis of a sweep, with 95 % intervals.

    :param result: the sweep.
    :param x: axis whose levels are numbers.
    :param y: measures: `crashed` or a measure of `SweepResult.table`.
    :param series: axis whose levels are the lines.
    :param facets: axis whose levels have a panel each.
    :param ax: axes to draw in; None: a new figure.
    :raises ConfigError: for an axis or a measure that does not exist.
    """
    return _chart(result, "lines", y, ax, x=x, series=series, facets=facets)


def plot_matrix(result: SweepResult, *, rows: str, columns: str, y: str | Sequence[str], ax: Panels = None) -> Figure:
    """A coloured table of a sweep: a panel a measure.

    :param result: the sweep.
    :param rows: axis whose levels are the rows.
    :param columns: axis whose levels are the columns.
    :param y: measures: `crashed` or a measure of `SweepResult.table`.
    :param ax: axes to draw in; None: a new figure.
    :raises ConfigError: for an axis or a measure that does not exist.
    """
    return _chart(result, "matrix", y, ax, rows=rows, columns=columns)


def _chart(result: SweepResult, kind: str, y: str | Sequence[str], ax: Panels, **roles: str | None) -> Figure:
    spec: dict[str, Any] = {role: axis for role, axis in roles.items() if axis is not None}
    spec |= {"kind": kind, "y": [y] if isinstance(y, str) else list(y)}
    check_figure(spec, result._table.sweep.spec.axes)
    return charts.draw(result._table, spec, _listed(ax))


def _titles(flights: Sequence[FlightLog], titles: Sequence[str] | None) -> list[str]:
    if not flights:
        raise ConfigError("flights", 0, "at least one")
    if titles is not None:
        if len(titles) != len(flights):
            raise ConfigError("titles", list(titles), f"{len(flights)}, one a flight")
        return list(titles)
    return [f"{flight.config.swarm.policy}, {flight.config.swarm.estimator}" for flight in flights]
