"""A flight from above: the paths, as the paper shows them (fig:12_exp_traj)."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dtsa_agent.core import Scenario
from dtsa_agent.core.registry import POLICIES

from . import palette
from .style import INK, QUIET, style, svg_text, themed

Array = NDArray[np.float64]
Track = NDArray[np.float64]  # (T, 3, N) m, frame map; not a number where a position is not known

_SHAPES = {"circle": "o", "diamond": "D", "square": "s", "triangle": "^"}
_LABELLED = 24  # agents that get their ids written
_DPI = 160
_MOST_POINTS, _MOST_OF_ONE, _LEAST_OF_ONE = 8000, 80, 12  # in an SVG: of all paths, of one


def paint(
    axes: Axes, path: Track, moving: NDArray[np.bool_], *, crash: Sequence[int] | None = None, ids: bool = True,
    scale: float = 1.0,
) -> None:  # fmt: skip
    """Paint a flight from above: rings where agents start, discs where they end; agents that hover are grey discs.

    :param crash: ids of two agents that crashed at the end; a ring is drawn around them.
    :param ids: write the ids of the agents beside their starts, if there are few.
    """
    known = np.isfinite(path[:, :2]).all(axis=1)  # (T, N)
    shown = np.flatnonzero(known.any(axis=0)).tolist()
    start, end = np.full((2, 2, path.shape[2]), np.nan)
    for k in shown:
        start[:, k], end[:, k] = path[known[:, k]][[0, -1], :2, k]
    thin = scale * float(np.clip(30.0 / max(path.shape[2], 1), 0.55, 1.9))
    size = 3.2 * scale + 2.2 * thin
    for k in shown:
        shade, turn = palette.agent_colour(k + 1), palette.agent_turn(k + 1)
        shape, name = _SHAPES[palette.SHAPES[turn]], f"craft-{k + 1}"
        if not moving[k]:
            axes.plot(
                *end[:, k], "o", color=palette.HOVERING, ms=size, mec="white", mew=scale, zorder=2, gid=f"hover-{name}"
            )
            continue
        way, dash = path[known[:, k], :2, k].T, palette.DASHES[turn]
        axes.plot(*way, color="white", lw=thin + 1.4 * scale, solid_capstyle="round", zorder=3)
        axes.plot(
            *way, color=shade, lw=thin, solid_capstyle="round", zorder=3, gid=f"way-{k + 1}",
            linestyle=(0, dash) if dash else "-",
        )  # fmt: skip
        axes.plot(*start[:, k], shape, mfc="white", mec=shade, mew=1.3 * scale, ms=size, zorder=4)
        axes.plot(*end[:, k], shape, color=shade, mec=INK, mew=0.5 * scale, ms=size, zorder=5, gid=name)
    if ids and path.shape[2] <= _LABELLED:
        extent = float(np.nanmax(np.abs(start), initial=0.0)) if shown else 1.0
        for k in shown:
            out = 1.0 + 0.1 * extent / scale**2 / max(float(np.hypot(*start[:, k])), 1e-9)
            axes.text(
                *(start[:, k] * out), str(k + 1), ha="center", va="center", fontsize=8 * scale, color=QUIET, zorder=6,
                gid=f"id-{k + 1}",
            )  # fmt: skip
    if crash and {agent - 1 for agent in crash} <= set(shown):
        _mark_crash(axes, np.concatenate((start, end), axis=1)[:, [*shown, *(k + path.shape[2] for k in shown)]],
                    end[:, [crash[0] - 1, crash[1] - 1]].mean(axis=1), crash)  # fmt: skip


def _mark_crash(axes: Axes, dots: Array, where: Array, crash: Sequence[int]) -> None:
    """A ring around the two that crashed, and the word where no dot is, with a line to the ring.

    :param dots: (2, M) m, frame map: all that must stay visible.
    :param where: (2,) m, frame map: between the two.
    """
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
    axes.plot(*where, "o", mfc="none", mec=palette.COLLIDED, mew=1.8, markersize=22, zorder=8, gid="crash")
    axes.annotate(
        f"crash {crash[0]}\u2013{crash[1]}", where, xytext=(float(text[0]), float(text[1])), ha="center", va="center",
        color=palette.COLLIDED, fontsize=9, fontweight="bold", zorder=8,
        arrowprops={"arrowstyle": "-", "color": palette.COLLIDED, "linewidth": 1.2, "shrinkA": 1, "shrinkB": 11},
        bbox={"boxstyle": "round,pad=0.2", "fc": "white", "ec": palette.COLLIDED, "linewidth": 0.8},
    )  # fmt: skip


def frame_bare(axes: Axes, path: Track, fontsize: float = 6.5) -> None:
    """Show all of a flight in a square without axes, with a bar of one metre."""
    extent = 1.2 * max(float(np.nanmax(np.abs(path[:, :2]), initial=0.0)), 0.5)
    axes.set(xlim=(-extent, extent), ylim=(-extent, extent), aspect="equal")
    axes.axis("off")
    axes.plot([extent - 1.0, extent], [-extent * 0.97] * 2, color=QUIET, linewidth=1.0)
    axes.text(extent - 0.5, -extent * 0.93, "1 m", ha="center", va="bottom", fontsize=fontsize, color=QUIET)


def svg_from_above(path: Track, moving: NDArray[np.bool_], name: str, crash: Sequence[int] | None = None) -> str:
    """A flight from above as SVG for a page, whose variables give paper and ink; parts have ids, as ``way-3``.

    :param name: what the picture shows, for readers who hear it.
    """
    points = min(_MOST_OF_ONE, max(_LEAST_OF_ONE, _MOST_POINTS // max(1, path.shape[2])))
    chosen = np.unique(np.linspace(0, len(path) - 1, min(points, len(path))).round().astype(int))
    with style():
        figure = Figure(figsize=(3.6, 3.6))
        axes = figure.add_axes((0, 0, 1, 1))
        paint(axes, path[chosen], moving, crash=crash)
        frame_bare(axes, path)
        figure.patch.set_visible(False)
        for artist in axes.get_children():
            artist.set_clip_on(False)
        svg = themed(svg_text(figure))
    label = html.escape(f"{name}, seen from above")
    head = f'<svg class="view" role="img" aria-label="{label}" viewBox="0 0 259.2 259.2">'
    return head + svg[svg.index(">") + 1 :]


def _subtitle(summary: dict[str, Any]) -> str:
    """The results of a flight in one short line."""
    is_complete = summary["completed"] and summary["end"] != "crashed"
    after = summary["completion_time_s" if is_complete else "flight_time_s"]
    parts = [f"{'complete' if is_complete else summary['end']} after {after:.2f} s"]
    if summary["collided"] and summary["end"] != "crashed":
        parts.append("agents {} and {} crashed".format(*summary["collided_pair"]))
    if summary["min_distance_m"] is not None:
        parts.append(f"closest {summary['min_distance_m']:.3f} m")
    if summary["efficiency_mean"] is not None:
        parts.append(f"efficiency {summary['efficiency_mean']:.3f}")
    return "   ·   ".join(parts)


def draw_flight(file: Path, scenario: Scenario, positions: Track, summary: dict[str, Any]) -> None:
    """Draw one flight into a PNG, with its results."""
    built_in = POLICIES.rows.get(summary["policy"])  # a plug-in need not be installed where its flight is shown
    title = f"{built_in.label if built_in else summary['policy']}, {summary['estimator']}"
    places = np.concatenate((scenario.start[None], positions))
    extent = 1.16 * max(float(np.abs(places[:, :2]).max(initial=0.0)), 0.5)
    with style():
        figure = Figure(figsize=(5.5, 6.0))
        axes = figure.add_axes((0.13, 0.135, 0.84, 0.735))
        paint(axes, places, scenario.moving, crash=summary["collided_pair"] if summary["end"] == "crashed" else None)
        axes.set(aspect="equal", xlim=(-extent, extent), ylim=(-extent, extent), xlabel="x (m)", ylabel="y (m)")
        axes.spines[:].set_visible(False)
        axes.text(0.0, 1.075, title, transform=axes.transAxes, fontsize=12, fontweight="bold")
        axes.text(0.0, 1.025, _subtitle(summary), transform=axes.transAxes, fontsize=8.5, color=QUIET)
        note = (
            f"{summary['agents']} agents, {summary['moving']} moving, {summary['slot_ms']:g} ms slots, "
            f"loss {summary['loss']:g}, avoider {summary['avoider']}, seed {summary['seed']}.\n"
            "Seen from above: rings are starts, dots are ends."
        )
        figure.text(0.13, 0.018, note, fontsize=8, color=QUIET, linespacing=1.5)
        figure.savefig(file, dpi=_DPI)
