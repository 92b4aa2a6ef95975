"""The demo's picture: four rows, a sentence each."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from matplotlib.patheffects import withStroke
from PIL import Image

from dtsa_bench.drawing.palette import COLLIDED, SERIES, agent_colour, ink_on
from dtsa_bench.runs.program import program

from .flown import Flights, Flown, compared_s, of_step
from .story import KILLED, Step
from .strips import HOVER, Cell, cells, killed_windows, window
from .text import INTRO, LIVE_NOTE, TITLE, lines, sentence

INK, MUTED, RULE, BAD = "#16202c", "#5a6778", "#dfe4ea", COLLIDED
AFTER, BEFORE = SERIES[:2]  # two lines of one chart
WIDTH, DPI = 8.6, 220  # inches
_LEFT, _RIGHT = 0.42, 0.36  # margins, inches
_LABEL_X, _STRIP_X, _STRIP_W = 1.98, 3.32, 4.12  # of all strips, inches
_HEIGHTS = (1.95, 1.93, 1.98, 1.5)  # inches, of each step without its text
_FONT = {"font.family": "sans-serif", "font.sans-serif": ["DejaVu Sans"], "font.size": 8.5, "text.color": INK}


class _Sheet:
    """A figure that is filled from the top, in inches.

    :param height: of the whole, inches.
    """

    def __init__(self, height: float) -> None:
        self.height = height
        self.figure = Figure(figsize=(WIDTH, height))
        self.y = 0.0  # inches from the top

    def text(self, x: float, y: float, text: str, size: float, **more: object) -> None:
        """Text whose first line has its top at (x, y), inches from the top left corner."""
        more = {"va": "top", "linespacing": 1.35, **more}
        self.figure.text(x / WIDTH, 1 - y / self.height, text, fontsize=size, **more)  # type: ignore[arg-type]

    def axes(self, x: float, y: float, width: float, height: float) -> Axes:
        """Axes with their top left corner at (x, y), inches."""
        return self.figure.add_axes((x / WIDTH, 1 - (y + height) / self.height, width / WIDTH, height / self.height))

    def rule(self, y: float) -> None:
        """A thin line across the sheet."""
        line = mpl.lines.Line2D(
            [_LEFT / WIDTH, 1 - _RIGHT / WIDTH], [1 - y / self.height] * 2, color=RULE, linewidth=0.8
        )
        self.figure.add_artist(line)


def draw_demo(path: Path, steps: Sequence[Step], flights: Flights) -> None:
    """Draws the picture as PNG.

    :param path: file to write.
    :param steps: the steps of the demo.
    :param flights: its flights.
    """
    with mpl.rc_context(_FONT):
        said = [textwrap.wrap(sentence(step, flights), 122) for step in steps]
        heights = [rows + 0.5 + 0.155 * len(text) for rows, text in zip(_HEIGHTS, said, strict=True)]
        sheet = _Sheet(1.22 + sum(heights) + 0.36)
        sheet.text(_LEFT, 0.3, TITLE, 15.5, fontweight="bold")
        sheet.text(_LEFT, 0.68, textwrap.fill(INTRO, 118), 9, color=MUTED)
        sheet.y = 1.22
        for step, text, draw, height in zip(steps, said, _DRAW, heights, strict=True):
            sheet.rule(sheet.y)
            _heading(sheet, step, text)
            draw(sheet, sheet.y + height - _HEIGHTS[step.number - 1], step, flights)
            sheet.y += height
        swarm = steps[0].takes[0].run.swarm
        note = (
            f"Drawn by “{program()} demo” from the recordings of {sum(len(step.takes) for step in steps)} flights of "
            f"ROS 2 nodes, seed {swarm.seed}. Seen from above: rings are starts, dots are ends."
        )
        sheet.rule(sheet.height - 0.34)
        sheet.text(_LEFT, sheet.height - 0.25, note, 7.5, color=MUTED)
        FigureCanvasAgg(sheet.figure)
        drawn = io.BytesIO()
        sheet.figure.savefig(drawn, dpi=DPI, facecolor="white")
    with Image.open(drawn) as image:  # a third of the size, and no eye sees the difference
        few = image.convert("RGB").quantize(256, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
        few.save(path, optimize=True, dpi=(DPI, DPI))


def _heading(sheet: _Sheet, step: Step, text: Sequence[str]) -> None:
    sheet.text(_LEFT, sheet.y + 0.1, f"{step.number}", 12, fontweight="bold", color=AFTER)
    sheet.text(_LEFT + 0.22, sheet.y + 0.1, step.title, 11.5, fontweight="bold")
    sheet.text(_LEFT + 0.22, sheet.y + 0.36, "\n".join(text), 8.3, color=INK)


def _bare(axes: Axes) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_visible(False)


def top_view(axes: Axes, flown: Flown, until: int | None = None) -> None:
    """The flight from above.

    :param axes: where to.
    :param flown: the flight.
    :param until: slots of it that are shown; None: all.
    """
    place = flown.position[:until]
    for k in range(place.shape[2]):
        colour = agent_colour(k + 1)
        start, path = place[0, :2, k], place[:, :2, k]
        if not flown.moving[k]:
            axes.add_patch(Circle(start, 0.13, facecolor=HOVER, edgecolor="white", linewidth=0.6, zorder=2))
            continue
        axes.plot(path[:, 0], path[:, 1], color="white", linewidth=2.2, zorder=3)
        axes.plot(path[:, 0], path[:, 1], color=colour, linewidth=1.15, zorder=3, solid_capstyle="round")
        axes.add_patch(Circle(start, 0.13, facecolor="white", edgecolor=colour, linewidth=1.1, zorder=4))
        axes.add_patch(Circle(path[-1], 0.13, facecolor=colour, edgecolor="white", linewidth=0.6, zorder=5))
    extent = 1.13 * float(np.abs(flown.position[:, :2]).max())
    axes.set_xlim(-extent, extent)
    axes.set_ylim(-extent, extent)
    axes.set_aspect("equal")
    _bare(axes)
    axes.plot([extent - 1.0, extent], [-extent * 0.97] * 2, color=MUTED, linewidth=1.0)
    axes.text(extent - 0.5, -extent * 0.93, "1 m", ha="center", va="bottom", fontsize=6.5, color=MUTED)


def _paths(sheet: _Sheet, top: float, step: Step, flights: Flights) -> None:
    """Step a: paths of both flights, and the error over time."""
    shades = (BEFORE, AFTER)
    found = of_step(step, flights)
    said = lines(step, flights)
    for index, (flown, line, shade) in enumerate(zip(found, said, shades, strict=True)):
        x = _LEFT + 0.12 + 1.88 * index
        sheet.text(x + 0.78, top, line.does, 7.2, color=shade, ha="center", fontweight="bold")
        top_view(sheet.axes(x, top + 0.17, 1.56, 1.56), flown)
    axes = sheet.axes(4.6, top + 0.2, 2.95, 1.2)
    end_s = compared_s(found)
    for flown, line, shade in zip(found, said, shades, strict=True):
        time_s = (np.arange(len(flown.error_m)) + 1) * flown.slot_s
        shown = time_s <= end_s
        axes.plot(time_s[shown], 1000 * flown.error_m[shown], color=shade, linewidth=1.4)
        axes.annotate(
            f"{line.value}", (end_s, float(np.nanmean(1000 * flown.error_m[shown][-40:]))), xytext=(5, 0),
            textcoords="offset points", color=shade, fontsize=9, fontweight="bold", va="center", annotation_clip=False,
        )  # fmt: skip
    axes.set_xlim(0, end_s)
    axes.set_ylim(0, None)
    axes.set_xlabel("time (s)", fontsize=7.5, color=MUTED, labelpad=2)
    axes.set_title("how far off the others are thought to be (mm)", fontsize=7.8, color=INK, loc="left", pad=5)
    _plain(axes)


def _plain(axes: Axes) -> None:
    axes.tick_params(labelsize=7, colors=MUTED, length=2.5, width=0.6)
    axes.grid(color=RULE, linewidth=0.6)
    axes.set_axisbelow(True)
    for name, side in axes.spines.items():
        side.set_visible(name in ("left", "bottom"))
        side.set_color(RULE)


def paint_cells(axes: Axes, shown: Sequence[Cell], width: int, size: float) -> None:
    """Slots as cells.

    :param axes: where to; a slot is 1 wide and 1 high.
    :param shown: the cells.
    :param width: of the axes, cells.
    :param size: of the ids, points; 0: none.
    """
    faces = PatchCollection(
        [
            Rectangle((cell.x + 0.06 + index * 0.88 / len(cell.colours), cell.y + 0.06), 0.88 / len(cell.colours), 0.88)
            for cell in shown
            for index in range(len(cell.colours))
        ],
        facecolor=[colour for cell in shown for colour in cell.colours],
        edgecolor="none",
    )
    axes.add_collection(faces)
    for cell in shown:
        if not cell.colours:
            axes.add_patch(
                Rectangle((cell.x + 0.1, cell.y + 0.1), 0.8, 0.8, fill=False, edgecolor="#c3ccd6", linewidth=0.5)
            )
        elif len(cell.colours) > 1:
            axes.add_patch(
                Rectangle(
                    (cell.x + 0.06, cell.y + 0.06), 0.88, 0.88, fill=False, edgecolor=BAD, linewidth=1.3, zorder=4
                )
            )
            axes.text(cell.x + 0.5, cell.y + 0.53, "×", fontsize=size * 1.9, ha="center", va="center", color="white",
                      weight="bold", zorder=5, path_effects=[withStroke(linewidth=1.4, foreground=INK)])  # fmt: skip
        elif size:
            axes.text(cell.x + 0.5, cell.y + 0.54, cell.label, fontsize=size, ha="center", va="center",
                      color=ink_on(cell.colours[0]))  # fmt: skip
    axes.set_xlim(0, width)
    _bare(axes)


def _strips(sheet: _Sheet, top: float, step: Step, flights: Flights) -> None:
    """Steps b and c: who sent in each slot."""
    found = of_step(step, flights)
    said = lines(step, flights)
    top_view(sheet.axes(_LEFT + 0.0, top + 0.03, 1.42, 1.42), found[-1])
    sheet.text(
        WIDTH - _RIGHT,
        top - 0.02,
        "known state is" if step.letter == "b" else "position is",
        7,
        color=MUTED,
        ha="right",
    )
    sheet.text(WIDTH - _RIGHT, top + 0.1, "this old" if step.letter == "b" else "wrong by", 7, color=MUTED, ha="right")
    first, count = window(found)
    pitch = 0.36
    for index, (flown, line) in enumerate(zip(found, said, strict=True)):
        y = top + 0.28 + pitch * index
        sheet.text(_LABEL_X, y - 0.03, line.name, 8.6, fontweight="bold")
        axes = sheet.axes(_STRIP_X, y, _STRIP_W, _STRIP_W / count * 1.6)
        paint_cells(axes, cells(flown, first, count), count, 5.2)
        axes.set_ylim(0, 1)
        sheet.text(WIDTH - _RIGHT, y - 0.01, line.value, 9.5, fontweight="bold", ha="right")
        sheet.text(_LABEL_X, y + 0.125, line.does, 6.4, color=MUTED)
        if index == len(found) - 1:
            axes.tick_params(labelsize=6.5, colors=MUTED, length=2, width=0.6)
            places = [slot for slot in range(first, first + count) if slot % 10 == 0]
            axes.set_xticks([slot - first + 0.5 for slot in places], [str(slot) for slot in places])
            axes.set_xlabel("slot (10 ms each)", fontsize=7, color=MUTED, labelpad=1)
    _legend(sheet, top + 0.28 + pitch * len(found) + 0.2, step)


def _legend(sheet: _Sheet, y: float, step: Step) -> None:
    entries = [("colour", "sent by one that flies"), (HOVER, "sent by one that hovers")]
    if step.letter == "c":
        entries += [(BAD, "two or more at once: nobody understands them"), ("none", "nobody sends")]
    else:
        entries += [("none", "nobody sends")]
    width = WIDTH - _RIGHT - _LABEL_X
    axes = sheet.axes(_LABEL_X, y, width, 0.13)
    axes.set_xlim(0, width)
    axes.set_ylim(0, 0.13)
    x = 0.0
    for shade, text in entries:
        if shade == "colour":
            for index, part in enumerate((agent_colour(1), agent_colour(2))):
                axes.add_patch(Rectangle((x + 0.055 * index, 0.01), 0.055, 0.1, facecolor=part))
        elif shade == BAD:
            axes.add_patch(Rectangle((x, 0.01), 0.11, 0.1, facecolor=agent_colour(4), edgecolor=BAD, linewidth=1.2))
            axes.text(x + 0.055, 0.062, "×", color="white", fontsize=7, fontweight="bold", ha="center", va="center")
        else:
            axes.add_patch(
                Rectangle(
                    (x, 0.01),
                    0.1,
                    0.1,
                    facecolor="white" if shade == "none" else shade,
                    edgecolor="#c3ccd6",
                    linewidth=0.5,
                )
            )
        axes.text(x + 0.16, 0.06, text, fontsize=6.6, color=MUTED, va="center")
        x += 0.34 + 0.0465 * len(text)
    _bare(axes)


def _killing(sheet: _Sheet, top: float, step: Step, flights: Flights) -> None:
    """Step d: the turns of all agents, a row a turn, around what happens."""
    flown = flights[step.takes[0].key]
    agents = flown.take.run.swarm.agents
    parts = killed_windows(flown)
    rounds = sum(part.rounds for part in parts)
    gap, x = 0.22, _LEFT + 0.95
    width = (WIDTH - _RIGHT - x - gap * (len(parts) - 1)) / rounds
    for own in range(agents):
        sheet.text(x - 0.08, top + 0.19 + 0.18 * own, f"turns of {own + 1}", 6.6, ha="right",
                   color=agent_colour(KILLED) if own + 1 == KILLED else MUTED,
                   fontweight="bold" if own + 1 == KILLED else "normal")  # fmt: skip
    for part in parts:
        axes = sheet.axes(x, top + 0.16, width * part.rounds, 0.18 * agents)
        paint_cells(axes, part.cells, part.rounds, 4.6)
        axes.set_ylim(agents, 0)
        sheet.text(x, top - 0.0, part.caption, 7.4, fontweight="bold")
        if part.mark is not None:
            axes.axvline(part.mark, color=BAD, linewidth=1.3, zorder=6)
        seconds = agents * flown.slot_s
        low, high = part.first * seconds, (part.first + part.rounds) * seconds
        marks = np.arange(np.ceil(low / 0.2) * 0.2, high, 0.2)
        axes.set_xticks((marks - low) / seconds, [f"{mark:.1f}" for mark in marks])
        axes.tick_params(labelsize=6.5, colors=MUTED, length=2, width=0.6)
        if part is parts[0]:
            axes.set_xlabel(
                f"time (s); one column is one round of {1000 * seconds:g} ms", fontsize=7, color=MUTED, labelpad=1
            )
        x += width * part.rounds + gap
    sheet.text(_LEFT + 0.22, top + 1.22, LIVE_NOTE, 7, color=MUTED)


_DRAW = (_paths, _strips, _strips, _killing)
