"""The demo's picture and its moving picture; every number in them comes from the flights."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from PIL import Image

from dtsa_bench.drawing.flight_paths import frame_bare, paint
from dtsa_bench.drawing.palette import COLLIDED, SERIES, agent_colour, ink_on
from dtsa_bench.drawing.style import GRID, INK, QUIET, style
from dtsa_bench.runs.program import program

from .flights import AGENTS, KILLED, LIVE_AGENTS, LIVE_SLOT_MS, DemoFlight, FinishedFlight, Flights

HOVER = "#c3ccd6"  # of cells: an agent that hovers has nothing new to say
FIRST, COUNT = 100, 40  # the slots that are shown, well under way
ROUNDS = 16  # columns of each part around a death or a return
FRAME_MS, LAST_FRAME_MS = 90, 3500  # of the animation
WIDTH, LEFT, RIGHT = 8.6, 0.4, 0.4  # inches, of the picture and its margins
TITLE = "One radio channel, twelve quadcopters: who speaks next?"
INTRO = (
    "Quadcopters that fly across each other's way must know where the others are. They tell each other by radio, on "
    "one channel: time is cut into slots of 10 ms, and in each slot one of them can send its position and velocity."
)
LIVE_NOTE = (
    f"Live, in real time: {LIVE_AGENTS} processes, slots of {LIVE_SLOT_MS:g} ms. Its figures describe this machine; "
    "those above are the same everywhere."
)

Cell = tuple[float, float, tuple[int, ...]]  # x, y, ids of the agents that sent


class _Sheet:
    """A figure that is filled in inches, from its top left corner."""

    def __init__(self, height: float, width: float = WIDTH, dpi: float = 220) -> None:
        self.width, self.height = width, height
        self.figure = Figure(figsize=(width, height), dpi=dpi)

    def text(self, x: float, y: float, text: str, size: float, **more: object) -> None:
        """Text whose first line has its top at (x, y)."""
        more = {"va": "top", "linespacing": 1.35, **more}
        self.figure.text(x / self.width, 1 - y / self.height, text, fontsize=size, **more)  # type: ignore[arg-type]

    def axes(self, x: float, y: float, width: float, height: float, bare: bool = True) -> Axes:
        """Axes with their top left corner at (x, y); bare: with nothing but what is drawn."""
        place = x / self.width, 1 - (y + height) / self.height, width / self.width, height / self.height
        axes = self.figure.add_axes(place)
        if bare:
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
        axes.tick_params(labelsize=6.5, length=2, width=0.6, labelcolor=QUIET)
        axes.grid(not bare)
        return axes

    def rule(self, y: float, margin: float = LEFT) -> None:
        """A thin line across the sheet."""
        ends, height = [margin / self.width, 1 - margin / self.width], 1 - y / self.height
        self.figure.add_artist(Line2D(ends, [height, height], color=GRID, linewidth=0.8))


def draw_demo(path: Path, steps: Sequence[Sequence[DemoFlight]], flights: Flights) -> None:
    """Draw the picture as PNG."""
    with style():
        sheet = _Sheet(12.5)
        sheet.text(LEFT, 0.3, TITLE, 15.5, fontweight="bold")
        sheet.text(LEFT, 0.68, textwrap.fill(INTRO, 118), 9, color=QUIET)
        draws: tuple[Callable[[_Sheet, float, Sequence[FinishedFlight]], None], ...] = (
            _draw_paths,
            partial(_draw_strips, head="known state is\nthis old", value="age"),
            partial(_draw_strips, head="position is\nwrong by", value="error"),
            _draw_killing,
        )
        for number, (top, step, draw) in enumerate(zip((1.22, 3.98, 6.88, 9.84), steps, draws, strict=True), 1):
            title, sentence = step_text(number, flights)
            sheet.rule(top)
            sheet.text(LEFT, top + 0.1, f"{number}", 12, fontweight="bold", color=SERIES[0])
            sheet.text(LEFT + 0.22, top + 0.1, title, 11.5, fontweight="bold")
            lines = textwrap.wrap(sentence, 122)
            sheet.text(LEFT + 0.22, top + 0.36, "\n".join(lines), 8.3)
            draw(sheet, top + 0.5 + 0.155 * len(lines), [flights[flight.key] for flight in step])
        note = (
            f"Drawn by “{program()} demo” from the recordings of {len(flights)} flights of ROS 2 nodes, seed "
            f"{steps[0][0].run.swarm.seed}. Seen from above: rings are starts, dots are ends."
        )
        sheet.rule(12.16)
        sheet.text(LEFT, 12.25, note, 7.5, color=QUIET)
        sheet.figure.savefig(path)
    with Image.open(path) as image:  # a third of the size, and no eye sees the difference
        few = image.convert("RGB").quantize(256, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    few.save(path, optimize=True)


def step_text(number: int, flights: Flights) -> tuple[str, str]:
    """Title of a step, and what it shows in a sentence or two."""
    error, age = ({key: getattr(flight, name) for key, flight in flights.items() if not flight.flight.live}
                  for name in ("error", "age"))  # fmt: skip
    if number == 1:
        return (
            "Between two messages, let the others fly on.",
            f"In round robin (TDMA) each is heard every {AGENTS}th slot. Who takes the others to stand where they were "
            f"last heard is wrong by {error['all-tdma-hold']} on average; who lets them fly on as they last said, by "
            f"{error['all-tdma']}, with the same messages.",
        )
    if number == 2:
        return (
            "Let those speak who have something to say.",
            "Round robin gives ten of twelve slots to quadcopters that have nothing new to say: what is known of the "
            f"flying two is {age['two-tdma']} old. DTSA lets every quadcopter compute whose state is most urgent: "
            f"{age['two-dtsa']}. With lease a hovering quadcopter lends its turns to a flying one: {age['two-lease']}.",
        )
    if number == 3:
        at_once = {}
        for key in ("loss-dtsa", "loss-lease"):
            slots = flights[key].summary["slots"]
            count = f"{slots['collision']} of {slots['total']} slots"
            at_once[key] = f"two speak at once in {count}" if slots["collision"] else "no two speak at once"
        return (
            "Lose one message in ten, and DTSA falls apart.",
            "DTSA works as long as all know the same. After the first lost message they do not: all agree in "
            f"{flights['loss-dtsa'].agreement} of the slots, {at_once['loss-dtsa']} or none does, positions are "
            f"wrong by {error['loss-dtsa']}. With lease only whose turn it is gives it away, in its own message: "
            f"{at_once['loss-lease']}, {error['loss-lease']}. Round robin does not mind losses, but is slow: "
            f"{error['loss-tdma']}.",
        )
    live = flights["killed-lease"]
    killed, _, back = killed_slots(live)
    after = "" if back is None else f" {(back - killed) * live.flight.run.swarm.slot_s:.1f} s after it was killed"
    return (
        "One is killed in flight, and comes back.",
        f"The turns of quadcopter {KILLED} stay empty until the others take it for dead; then the next one alive uses "
        f"them. Started again it listens, speaks{after}, and has its turns back.",
    )


def _top_view(axes: Axes, finished: FinishedFlight) -> None:
    paint(axes, finished.position, finished.scenario.moving, scale=0.72)
    frame_bare(axes, finished.position)


def _draw_paths(sheet: _Sheet, top: float, step: Sequence[FinishedFlight]) -> None:
    """Step 1: paths of both flights, and the error over time."""
    axes = sheet.axes(4.6, top + 0.2, 2.95, 1.2, bare=False)
    ends = [finished.summary["completion_time_s"] or finished.summary["flight_time_s"] for finished in step]
    end_s = max(0.5, int(10 * min(ends)) / 10 - 0.1)  # errors after an arrival say little
    for index, (finished, shade) in enumerate(zip(step, SERIES[1::-1], strict=True)):
        x = LEFT + 0.12 + 1.88 * index
        sheet.text(x + 0.78, top, finished.flight.does, 7.2, color=shade, ha="center", fontweight="bold")
        _top_view(sheet.axes(x, top + 0.17, 1.56, 1.56), finished)
        time_s = (np.arange(len(finished.error_m)) + 1) * finished.flight.run.swarm.slot_s
        error_mm = 1000 * finished.error_m[time_s <= end_s]
        axes.plot(time_s[time_s <= end_s], error_mm, color=shade, linewidth=1.4)
        axes.annotate(
            finished.error, (end_s, float(np.nanmean(error_mm[-40:]))), xytext=(5, 0), textcoords="offset points",
            color=shade, fontsize=9, fontweight="bold", va="center", annotation_clip=False,
        )  # fmt: skip
    axes.set(xlim=(0, end_s), ylim=(0, None))
    axes.set_xlabel("time (s)", fontsize=7.5, color=QUIET, labelpad=2)
    axes.set_title("how far off the others are thought to be (mm)", fontsize=7.8, fontweight="normal", pad=5)


def _draw_strips(sheet: _Sheet, top: float, step: Sequence[FinishedFlight], head: str, value: str) -> None:
    """Steps 2 and 3: which agents sent in each slot."""
    _top_view(sheet.axes(LEFT, top + 0.03, 1.42, 1.42), step[-1])
    sheet.text(WIDTH - RIGHT, top - 0.02, head, 7, color=QUIET, ha="right")
    first, width = slots_shown(step), 4.12
    for index, finished in enumerate(step):
        y = top + 0.28 + 0.36 * index
        sheet.text(1.98, y - 0.03, finished.flight.name, 8.6, fontweight="bold")
        sheet.text(1.98, y + 0.125, finished.flight.does, 6.4, color=QUIET)
        sheet.text(WIDTH - RIGHT, y - 0.01, getattr(finished, value), 9.5, fontweight="bold", ha="right")
        axes = sheet.axes(3.32, y, width, width / COUNT * 1.6)
        draw_cells(axes, finished, [(x, 0, finished.senders[first + x]) for x in range(COUNT)], 5.2)
        axes.set(xlim=(0, COUNT), ylim=(0, 1))
    ticks = [slot for slot in range(first, first + COUNT) if slot % 10 == 0]
    axes.set_xticks([slot - first + 0.5 for slot in ticks], [str(slot) for slot in ticks])
    axes.set_xlabel("slot (10 ms each)", fontsize=7, color=QUIET, labelpad=1)
    keys = [(agent_colour(5), "none", "sent by one that flies"), (HOVER, "none", "sent by one that hovers")]
    if any(len(senders) > 1 for finished in step for senders in finished.senders[first : first + COUNT]):
        keys.append((agent_colour(4), COLLIDED, "two or more at once: no receiver understands them"))
    keys.append(("white", HOVER, "no agent sends"))
    handles = [Rectangle((0, 0), 1, 1, facecolor=face, edgecolor=edge, label=text) for face, edge, text in keys]
    sheet.figure.legend(
        handles=handles, loc="upper left", bbox_to_anchor=(1.9 / WIDTH, 1 - (top + 1.5) / sheet.height), ncols=4,
        fontsize=6.6, handlelength=1, handleheight=1, columnspacing=1.6, handletextpad=0.5, labelcolor=QUIET,
    )  # fmt: skip


def slots_shown(step: Sequence[FinishedFlight]) -> int:
    """The first of the slots that are shown of flights side by side."""
    return min(FIRST, *(max(0, len(finished.senders) - COUNT) for finished in step))


def draw_cells(axes: Axes, finished: FinishedFlight, cells: Sequence[Cell], size: float) -> None:
    """Draw slots as cells, 1 wide and 1 high; `size`: of the ids in them, points."""
    for x, y, senders in cells:
        shades = [agent_colour(one) if finished.scenario.moving[one - 1] else HOVER for one in senders] or ["white"]
        for index, shade in enumerate(shades):
            wide = 0.88 / len(shades)
            edge = "none" if senders else HOVER
            axes.add_patch(
                Rectangle((x + 0.06 + index * wide, y + 0.06), wide, 0.88, facecolor=shade, edgecolor=edge, lw=0.5)
            )
        if len(senders) > 1:
            frame = {"fill": False, "edgecolor": COLLIDED, "linewidth": 1.3, "zorder": 4}
            axes.add_patch(Rectangle((x + 0.06, y + 0.06), 0.88, 0.88, **frame))  # type: ignore[arg-type]
            axes.text(x + 0.5, y + 0.5, "×", fontsize=1.9 * size, ha="center", va="center_baseline", color="white",
                      weight="bold", zorder=5, path_effects=[withStroke(linewidth=1.4, foreground=INK)])  # fmt: skip
        elif senders:
            axes.text(x + 0.5, y + 0.5, str(senders[0]), fontsize=size, ha="center", va="center_baseline",
                      color=ink_on(shades[0]))  # fmt: skip


def killed_slots(finished: FinishedFlight) -> tuple[int, int | None, int | None]:
    """Slots: the last own turn before the death, the first one that others use, the first one after the return."""
    turns = range(KILLED - 1, len(finished.senders), finished.flight.run.swarm.agents)
    empty = [slot for slot in turns if not finished.senders[slot]]
    dead = next((slot for slot in empty if {slot + k * turns.step for k in range(1, 5)} <= set(empty)), len(turns))
    used = next((slot for slot in turns if slot > dead and {KILLED, *finished.senders[slot]} != {KILLED}), None)
    back = next((slot for slot in turns if slot > dead and KILLED in finished.senders[slot]), None)
    return dead - turns.step, used, back


def killed_parts(finished: FinishedFlight) -> list[tuple[str, int, int]]:
    """Captions, first rounds and the rounds at which it happens: the death, the new use of its turns, the return."""
    agents = finished.flight.run.swarm.agents
    killed, used, back = killed_slots(finished)
    parts = [(f"{KILLED} is killed", killed // agents + 1)]
    if used is not None:
        parts.append((f"its turns are used again, by {'/'.join(map(str, finished.senders[used]))}", used // agents))
    if back is not None:
        parts.append(("it is back", back // agents))
    last = len(finished.senders) // agents - ROUNDS
    return [(caption, max(0, min(at - ROUNDS // 4, last)), at) for caption, at in parts]


def killed_cells(finished: FinishedFlight, first: int) -> list[Cell]:
    """Some rounds from the first on, a column each; rows are the turns of the agents."""
    agents = finished.flight.run.swarm.agents
    slots = ((column, row, (first + column) * agents + row) for column in range(ROUNDS) for row in range(agents))
    return [(x, y, finished.senders[slot] if slot < len(finished.senders) else ()) for x, y, slot in slots]


def _draw_killing(sheet: _Sheet, top: float, step: Sequence[FinishedFlight]) -> None:
    """Step 4: the turns of all agents around what happens."""
    finished = step[0]
    agents, slot_s = finished.flight.run.swarm.agents, finished.flight.run.swarm.slot_s
    round_s, parts, gap, x = agents * slot_s, killed_parts(finished), 0.22, LEFT + 0.95
    for own in range(1, agents + 1):
        mark = {"color": agent_colour(KILLED), "fontweight": "bold"} if own == KILLED else {"color": QUIET}
        sheet.text(x - 0.08, top + 0.01 + 0.18 * own, f"turns of {own}", 6.6, ha="right", **mark)
    width = (WIDTH - RIGHT - x - gap * 2) / 3
    for place, (caption, first, at) in enumerate(parts):
        axes = sheet.axes(x + place * (width + gap), top + 0.16, width, 0.18 * agents)
        draw_cells(axes, finished, killed_cells(finished, first), 4.6)
        axes.set(xlim=(0, ROUNDS), ylim=(agents, 0))
        axes.axvline(at - first, color=COLLIDED, linewidth=1.3, zorder=6)
        sheet.text(x + place * (width + gap), top, caption, 7.4, fontweight="bold")
        marks = np.arange(np.ceil(first * round_s / 0.2) * 0.2, (first + ROUNDS) * round_s, 0.2)
        axes.set_xticks(marks / round_s - first, [f"{mark:.1f}" for mark in marks])
        if not place:
            text = f"time (s); one column is one round of {1000 * round_s:g} ms"
            axes.set_xlabel(text, fontsize=7, color=QUIET, labelpad=1)
    sheet.text(LEFT + 0.22, top + 1.22, LIVE_NOTE, 7, color=QUIET)


def draw_animation(path: Path, flights: Flights, slots: int = 80) -> None:
    """Draw a moving picture as GIF: four flights, a slot a frame; where agents are, and which one sends."""
    rows = (
        ("two-tdma", "TDMA", "All speak in turn, also the ten that hover and have nothing new to say."),
        ("two-dtsa", "DTSA", "All compute whose state is most urgent: the two that fly speak."),
        ("loss-dtsa", "DTSA, 1 message in 10 lost", "They no longer know the same: two send at once, or none."),
        ("loss-lease", "lease, 1 message in 10 lost", "Who hovers lends its turns, so only one can speak."),
    )
    across, row_height = 40, 1.42
    with style():
        sheet = _Sheet(6.34, 8.8, dpi=100)
        sheet.text(0.14, 0.14, "Twelve quadcopters, one radio channel: who speaks next?", 13, fontweight="bold")
        reading = (
            "A cell is a slot of 10 ms, its number says who sends in it. Grey: that one hovers. White: no agent sends."
        )
        sheet.text(0.14, 0.42, reading, 8.7, color=QUIET)
        drawn = []
        for index, (key, name, text) in enumerate(rows):
            top, finished = 0.66 + row_height * index, flights[key]
            sheet.rule(top, 0.14)
            sheet.text(1.6, top + 0.1, name, 10, fontweight="bold")
            sheet.text(1.6, top + 0.33, text, 8.7, color=QUIET)
            value = f"{finished.age} old" if index < 2 else f"wrong by {finished.error}"
            sheet.text(8.64, top + 0.1, f"positions are {value}", 10, fontweight="bold", ha="right")
            strip = sheet.axes(1.6, top + 0.6, 7.04, 0.52)
            strip.set(xlim=(0, across), ylim=(2, 0))
            drawn.append((finished, sheet.axes(0.1, top + 0.06, 1.3, 1.3), strip))
        canvas, pictures = FigureCanvasAgg(sheet.figure), []
        for frame in range(slots):
            for finished, view, strip in drawn:
                slot = min(FIRST + frame, len(finished.senders) - 1)
                cell = frame % across, frame // across, finished.senders[slot] if slot == FIRST + frame else ()
                draw_cells(strip, finished, [cell], 7)
                view.clear()
                paint(view, finished.position[: slot + 1], finished.scenario.moving, ids=False, scale=0.62)
                senders = [sender - 1 for sender in finished.senders[slot]]
                shade = COLLIDED if len(senders) > 1 else INK
                view.plot(*finished.position[slot][:2, senders], "o", mfc="none", mec=shade, ms=13, mew=1.4)
                frame_bare(view, finished.position)
            canvas.draw()
            pictures.append(np.asarray(canvas.buffer_rgba())[:, :, :3].copy())
    durations = [FRAME_MS] * (slots - 1) + [LAST_FRAME_MS]
    # In the colours of the last: what does not move does not change, and files stay small.
    shades = Image.fromarray(pictures[-1]).quantize(255, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    first, *rest = (Image.fromarray(one).quantize(palette=shades, dither=Image.Dither.NONE) for one in pictures)
    first.save(path, save_all=True, append_images=rest, duration=durations, loop=0, optimize=True)
