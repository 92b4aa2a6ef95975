"""The picture of a flight: the paths from above, as the paper shows them (fig:12_exp_traj)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dtsa_agent.core import Scenario
from dtsa_agent.core.registry import POLICIES

from . import palette

Array = NDArray[np.float64]

INK, MUTED, RULE = "#1f2933", "#66727f", "#dfe4ea"
_CRASH = palette.COLLIDED
_SHAPES = {"circle": "o", "diamond": "D", "square": "s", "triangle": "^"}
_LABELLED = 24  # agents that get their ids written
_DPI = 160
_FONT = {"font.family": "DejaVu Sans", "font.size": 9}


def paint(axes: Axes, scenario: Scenario, positions: Array, crash: Sequence[int] | None = None) -> None:
    """Paints one flight from above.

    :param axes: where to.
    :param scenario: starts, targets and movers.
    :param positions: (T, 3, N) m, frame map.
    :param crash: ids of two agents that collided at the end, if they did.
    """
    count = positions.shape[2]
    thin = float(np.clip(30.0 / max(count, 1), 0.55, 1.9))
    extent = float(np.abs(scenario.start[:2]).max()) if count else 1.0
    for k in np.flatnonzero(~scenario.moving):
        axes.plot(
            *positions[-1, :2, k],
            "o",
            color=palette.HOVERING,
            markersize=5 + 2 * thin,
            markeredgecolor="white",
            zorder=2,
        )
    movers = np.flatnonzero(scenario.moving)
    for k in movers:
        path, shade, dash = positions[:, :2, k], palette.agent_colour(k + 1), palette.DASHES[palette.agent_turn(k + 1)]
        axes.plot(path[:, 0], path[:, 1], color="white", linewidth=thin + 1.4, solid_capstyle="round", zorder=3)
        axes.plot(
            path[:, 0], path[:, 1], color=shade, linewidth=thin, solid_capstyle="round", zorder=3,
            linestyle=(0, dash) if dash else "-",
        )  # fmt: skip
    size = 3.2 + 2.2 * thin
    for k in movers:
        shade, shape = palette.agent_colour(k + 1), _SHAPES[palette.SHAPES[palette.agent_turn(k + 1)]]
        axes.plot(*scenario.start[:2, k], shape, mfc="white", mec=shade, mew=1.3, markersize=size, zorder=4)
        axes.plot(*positions[-1, :2, k], shape, color=shade, mec=INK, mew=0.5, markersize=size, zorder=5)
    if count <= _LABELLED:
        _write_ids(axes, scenario, extent)
    if crash:
        _mark_crash(axes, np.concatenate((scenario.start[:2], positions[-1, :2]), axis=1), positions[-1, :2], crash)


def _mark_crash(axes: Axes, dots: Array, ends: Array, crash: Sequence[int]) -> None:
    """A ring around the two that crashed, and the word where no dot is, with a line to the ring.

    :param dots: (2, M) m, frame map: all that must stay visible.
    :param ends: (2, N) m, frame map: where the agents are at the end.
    :param crash: ids of the two.
    """
    where = ends[:, [crash[0] - 1, crash[1] - 1]].mean(axis=1)
    reach = max(float(np.abs(dots).max()), 0.5)
    turns = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    circle = np.array([np.cos(turns), np.sin(turns)])
    places = where[:, None] + np.concatenate([share * reach * circle for share in (0.3, 0.45, 0.6)], axis=1)
    inside = np.abs(places).max(axis=0) < 0.95 * reach
    apart = places[:, :, None] - dots[:, None, :]
    apart[0] /= 2.0  # a word is wider than high
    gaps = np.sqrt((apart**2).sum(axis=0)).min(axis=1)
    text = places[:, int(np.argmax(np.where(inside, gaps, -1.0)))]
    axes.plot(*where, "o", mfc="none", mec="white", mew=4.0, markersize=22, zorder=7)
    axes.plot(*where, "o", mfc="none", mec=_CRASH, mew=1.8, markersize=22, zorder=8)
    axes.annotate(
        f"crash {crash[0]}\u2013{crash[1]}",
        where,
        xytext=(float(text[0]), float(text[1])),
        ha="center",
        va="center",
        color=_CRASH,
        fontsize=9,
        fontweight="bold",
        zorder=8,
        arrowprops={"arrowstyle": "-", "color": _CRASH, "linewidth": 1.2, "shrinkA": 1, "shrinkB": 11},
        bbox={"boxstyle": "round,pad=0.2", "fc": "white", "ec": _CRASH, "linewidth": 0.8},
    )


def _write_ids(axes: Axes, scenario: Scenario, extent: float) -> None:
    """Each agent's id, outside of its place at the start."""
    for k in range(scenario.start.shape[1]):
        x, y = scenario.start[:2, k]
        length = max(float(np.hypot(x, y)), 1e-9)
        out = 1.0 + 0.085 * extent / length
        axes.text(x * out, y * out, str(k + 1), ha="center", va="center", fontsize=8, color=MUTED, zorder=6)


def style(axes: Axes, title: str, subtitle: str, extent: float) -> None:
    """Frame, scale and headings of one top view.

    :param extent: m, half width of what is shown.
    """
    axes.set_aspect("equal")
    axes.set_xlim(-extent, extent)
    axes.set_ylim(-extent, extent)
    axes.set_xlabel("x (m)", color=MUTED)
    axes.set_ylabel("y (m)", color=MUTED)
    axes.tick_params(colors=MUTED, length=3, labelsize=8)
    axes.grid(color=RULE, linewidth=0.6)
    axes.set_axisbelow(True)
    for side in axes.spines.values():
        side.set_visible(False)
    axes.text(0.0, 1.075, title, transform=axes.transAxes, fontsize=12, fontweight="bold", color=INK)
    axes.text(0.0, 1.025, subtitle, transform=axes.transAxes, fontsize=8.5, color=MUTED)


def subtitle(summary: dict[str, Any]) -> str:
    """The results of a flight in one short line."""
    parts = []
    if summary["collided"]:
        parts.append("crashed after {:.2f} s".format(summary["flight_time_s"]))
    elif summary["completed"]:
        parts.append("complete after {:.2f} s".format(summary["completion_time_s"]))
    else:
        parts.append("{} after {:.2f} s".format(summary["end"], summary["flight_time_s"]))
    if summary["min_distance_m"] is not None:
        parts.append("closest {:.3f} m".format(summary["min_distance_m"]))
    if summary["efficiency_mean"] is not None:
        parts.append("efficiency {:.3f}".format(summary["efficiency_mean"]))
    return "   ·   ".join(parts)


def heading(summary: dict[str, Any]) -> str:
    """What flew, e.g. ``DTSA, linear``."""
    built_in = POLICIES.rows.get(summary["policy"])  # a plug-in need not be installed where its flight is shown
    return f"{built_in.label if built_in else summary['policy']}, {summary['estimator']}"


def view_extent(scenario: Scenario, positions: Array) -> float:
    """Half width, m, of a square that shows all starts, ends and paths.

    :param positions: (T, 3, N) m, frame map.
    """
    reach = [float(np.abs(places).max()) for places in (scenario.start[:2], positions[:, :2]) if places.size]
    return 1.16 * max(*reach, 0.5)


def draw_flight(path: Path, scenario: Scenario, positions: Array, summary: dict[str, Any]) -> None:
    """Draws one flight into a PNG.

    :param path: file to write.
    :param scenario: starts, targets and movers.
    :param positions: (T, 3, N) m, frame map.
    :param summary: its results.
    """
    import matplotlib

    with matplotlib.rc_context(_FONT):
        figure = Figure(figsize=(5.5, 6.0))
        axes = figure.add_axes((0.13, 0.135, 0.84, 0.735))
        paint(axes, scenario, positions, summary["collided_pair"] if summary["end"] == "crashed" else None)
        style(axes, heading(summary), subtitle(summary), view_extent(scenario, positions))
        note = (
            f"{summary['agents']} agents, {summary['moving']} moving, {summary['slot_ms']:g} ms slots, "
            f"loss {summary['loss']:g}, avoider {summary['avoider']}, seed {summary['seed']}.\n"
            "Seen from above: rings are starts, dots are ends."
        )
        figure.text(0.13, 0.018, note, fontsize=8, color=MUTED, linespacing=1.5)
        FigureCanvasAgg(figure)
        figure.savefig(path, dpi=_DPI, facecolor="white")
