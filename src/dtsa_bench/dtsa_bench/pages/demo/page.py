"""The demo's page: one HTML file with the four steps, that plays the flights and needs no network."""

from __future__ import annotations

import html
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_bench.drawing.palette import AGENT_COLOURS, agent_colour, ink_on
from dtsa_bench.drawing.top_view import half_width, top_view
from dtsa_bench.experiments.batch.table import write_whole
from dtsa_bench.pages.report.data import pack
from dtsa_bench.pages.report.page import asset, filled, whole_page

from .flown import Flights, Flown, compared_s, of_step
from .story import KILLED, Step
from .strips import COUNT, Cell, cells, killed_windows, window
from .table import HEAD, rows
from .text import INTRO, LIVE_NOTE, TITLE, lines, sentence

_SCALE = 2000  # steps a metre of the positions on the page


def write_page(path: Path, steps: Sequence[Step], flights: Flights, commands: Sequence[tuple[str, str]]) -> None:
    """Writes the page.

    :param path: file to write.
    :param steps: the steps of the demo.
    :param flights: its flights.
    :param commands: what to do next: text and command.
    """
    assets = files("dtsa_bench.pages.demo") / "assets"
    played = {key: _played(flown) for key, flown in flights.items() if not flown.take.live}
    parts = {
        "title": html.escape(TITLE),
        "intro": html.escape(INTRO),
        "steps": "\n".join(_step(step, flights) for step in steps),
        "table": _table(steps, flights),
        "commands": "\n".join(
            f"<dt>{html.escape(text)}</dt><dd><code>{html.escape(command)}</code></dd>" for text, command in commands
        ),
    }
    page = whole_page(
        "demo",
        TITLE,
        asset("style.css") + "\n" + (assets / "demo.css").read_text(encoding="utf-8"),
        filled((assets / "demo.html").read_text(encoding="utf-8"), parts),
        {"flights": played, "colours": AGENT_COLOURS, "count": COUNT},
        (assets / "demo.js").read_text(encoding="utf-8"),
    )
    write_whole(path, page)


def _played(flown: Flown) -> dict[str, Any]:
    """What the page's script needs to play a flight."""
    place = np.round(flown.position[:, :2] * _SCALE).clip(-32767, 32767)
    return {
        "senders": [list(found) for found in flown.senders],
        "position": pack(place.astype("<i2")),
        "agents": place.shape[2],
        "moving": [bool(moves) for moves in flown.moving],
        "extent": round(half_width(flown.position) * _SCALE),
        "slot_s": flown.slot_s,
    }


def _step(step: Step, flights: Flights) -> str:
    body = {"a": _paths, "b": _strips, "c": _strips, "d": _killing}[step.letter](step, flights)
    return (
        f'<section class="step" id="{step.letter}"><h2><b>{step.number}</b>{html.escape(step.title)}</h2>'
        f'<p class="said">{html.escape(sentence(step, flights))}</p>\n{body}</section>'
    )


def _top_view(flown: Flown, name: str) -> str:
    """A flight from above; the script moves what has the class `craft`."""
    return top_view(flown.position, flown.moving, name)


def _paths(step: Step, flights: Flights) -> str:
    """Step a: paths, and the error over time."""
    found, said = of_step(step, flights), lines(step, flights)
    views = "".join(
        f"<figure>{_top_view(flown, line.name)}<figcaption><b>{html.escape(line.name)}</b>{html.escape(line.does)}"
        f'<strong class="s{index}">{line.value}</strong></figcaption></figure>'
        for index, (flown, line) in enumerate(zip(found, said, strict=True))
    )
    return f'<div class="paths">{views}<figure class="chart">{_chart(found)}</figure></div>'


def _chart(found: Sequence[Flown]) -> str:
    """Mean error over time, a line a flight."""
    end_s = compared_s(found)
    shown = [flown.error_m[: int(end_s / flown.slot_s)] for flown in found]
    top = 20.0 * np.ceil(max(float(np.nanmax(error_m)) for error_m in shown) * 1000 / 20)
    width, height, left = 360.0, 190.0, 34.0

    def at(time_s: float, error_mm: float) -> str:
        return f"{left + (width - left - 8) * time_s / end_s:.1f},{height - 34 - (height - 60) * error_mm / top:.1f}"

    parts = ['<text class="name" x="0" y="12">how far off the others are thought to be (mm)</text>']
    for value in np.arange(0, top + 1, 20):
        x, y = at(0, value).split(",")
        parts.append(
            f'<path class="grid" d="M{x} {y}H{width - 8}"/>'
            f'<text class="end" x="{left - 6}" y="{float(y) + 4:g}">{value:g}</text>'
        )
    for second in range(int(end_s) + 1):
        x, y = at(second, 0).split(",")
        parts.append(f'<text class="middle" x="{x}" y="{float(y) + 15:g}">{second}</text>')
    parts.append(f'<text class="middle" x="{(left + width) / 2}" y="{height - 4}">time (s)</text>')
    for index, (flown, error_m) in enumerate(zip(found, shown, strict=True)):
        points = " ".join(
            at((slot + 1) * flown.slot_s, 1000 * float(e)) for slot, e in enumerate(error_m) if np.isfinite(e)
        )
        parts.append(f'<polyline class="line s{index}" points="{points}"/>')
    return f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="Error over time">{"".join(parts)}</svg>'


def _cell(shown: Cell) -> str:
    """A slot as an element."""
    if not shown.colours:
        return f'<i class="none" title="slot {shown.slot}: nobody"></i>'
    who = " and ".join(str(agent) for agent in shown.senders)
    title = f'title="slot {shown.slot}: {who}"'
    if len(shown.colours) > 1:
        return f'<i class="both" style="--c:{shown.colours[0]};--d:{shown.colours[1]}" {title}>×</i>'
    if shown.colours[0] not in AGENT_COLOURS:
        return f'<i class="hover" {title}>{shown.label}</i>'
    return f'<i style="--c:{shown.colours[0]};--t:{ink_on(shown.colours[0])}" {title}>{shown.label}</i>'


def _strips(step: Step, flights: Flights) -> str:
    """Steps b and c: for each flight its top view, its slots and its figure."""
    found, said = of_step(step, flights), lines(step, flights)
    first, count = window(found)
    parts = []
    for flown, line in zip(found, said, strict=True):
        strip = "".join(_cell(shown) for shown in cells(flown, first, count))
        parts.append(
            f'<div class="flight" data-flight="{flown.take.key}" data-first="{first}">{_top_view(flown, line.name)}'
            f"<div><h3>{html.escape(line.name)}<small>{html.escape(line.does)}</small></h3>"
            f'<div class="strip">{strip}</div>'
            f'<p class="axis">slots <span class="from">{first}</span> to <span class="to">{first + count - 1}</span>, '
            "10 ms each</p></div>"
            f'<p class="value"><strong>{line.value}</strong><small>{html.escape(line.meaning)}</small></p></div>'
        )
    one, two = agent_colour(1), agent_colour(2)
    legend = [
        f'<i style="--c:linear-gradient(90deg, {one} 50%, {two} 50%)"></i>sent by one that flies',
        '<i class="hover"></i>sent by one that hovers',
    ]
    if step.letter == "c":
        both = f'<i class="both" style="--c:{one};--d:{agent_colour(4)}">×</i>'
        legend.append(f"{both}two or more at once: nobody understands them")
    legend.append('<i class="none"></i>nobody sends')
    keys = "".join(f"<span>{entry}</span>" for entry in legend)
    player = (
        '<p class="play"><button type="button">▶ play</button><input type="range" min="0" value="0" step="1" '
        'aria-label="slot"><output></output></p>'
    )
    return f'{player}{"".join(parts)}<p class="keys">{keys}</p>'


def _killing(step: Step, flights: Flights) -> str:
    """Step d: the turns of all agents around what happens."""
    flown = flights[step.takes[0].key]
    agents = flown.take.run.swarm.agents
    parts = []
    for part in killed_windows(flown):
        body = "".join(
            f'<div class="{"turn dead" if own + 1 == KILLED else "turn"}"><b>{own + 1}</b>'
            f"{''.join(_cell(shown) for shown in part.cells if shown.y == own)}</div>"
            for own in range(agents)
        )
        round_s = agents * flown.slot_s
        mark = "" if part.mark is None else f'<u style="--at:{part.mark / part.rounds:.4f}"></u>'
        parts.append(
            f'<figure><figcaption>{html.escape(part.caption)}</figcaption><div class="turns" style="--n:{part.rounds}">'
            f"{mark}{body}</div><p class=axis>{part.first * round_s:.2f} s to "
            f"{(part.first + part.rounds) * round_s:.2f} s</p></figure>"
        )
    return (
        f'<div class="killing">{"".join(parts)}</div><p class="what">A row holds the turns of one quadcopter, a '
        f"column is a round of {1000 * agents * flown.slot_s:g} ms. {html.escape(LIVE_NOTE)}</p>"
    )


def _table(steps: Sequence[Step], flights: Flights) -> str:
    head = "".join(f"<th>{html.escape(name)}</th>" for name in HEAD)
    body = "".join(
        f"<tr>{''.join(f'<td>{html.escape(value)}</td>' for value in row)}</tr>" for row in rows(steps, flights)
    )
    return f'<div class="scroll"><table><tr>{head}</tr>{body}</table></div>'
