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
from dtsa_bench.pages.report.json_values import pack
from dtsa_bench.pages.report.page import NOTE, PALETTE, asset, filled, whole_page

from .flown import Flights, Flown, compared_s, of_step
from .story import KILLED, Step
from .strips import COUNT, killed_windows, window
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
    content = {
        "runs": [], "palette": {**PALETTE, "inks": [ink_on(colour) for colour in AGENT_COLOURS]}, "count": COUNT,
        "flights": {key: _played(flown) for key, flown in flights.items()},
        "chart": _chart(steps[0], flights),
    }  # fmt: skip
    parts = {
        "note": NOTE,
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
        content,
        "\n".join((*map(asset, ("core.js", "plot.js")), (assets / "demo.js").read_text(encoding="utf-8"))),
    )
    write_whole(path, page)


def _played(flown: Flown) -> dict[str, Any]:
    """What the page's script needs to show a flight; one in real time is not shown from above."""
    found = {
        "senders": [list(senders) for senders in flown.senders],
        "moving": [bool(moves) for moves in flown.moving],
        "slot_s": flown.slot_s,
    }
    if flown.take.live:
        return found
    place = flown.position[:, :2]
    packed = pack(np.round(place * _SCALE).clip(-32767, 32767).astype("<i2"))
    extent = round(half_width(flown.position) * _SCALE)
    return {**found, "position": packed, "agents": place.shape[2], "extent": extent}


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
    """Step a: paths, and room for the error over time."""
    found, said = of_step(step, flights), lines(step, flights)
    views = "".join(
        f"<figure>{_top_view(flown, line.name)}<figcaption><b>{html.escape(line.name)}</b>{html.escape(line.does)}"
        f'<strong class="s{index}">{line.value}</strong></figcaption></figure>'
        for index, (flown, line) in enumerate(zip(found, said, strict=True))
    )
    return f'<div class="paths">{views}<figure class="chart"></figure></div>'


def _chart(step: Step, flights: Flights) -> dict[str, Any]:
    """Mean error over time, mm, a line a flight."""
    found, said = of_step(step, flights), lines(step, flights)
    end_s = compared_s(found)
    slots = int(end_s / found[0].slot_s)
    series = [
        {
            "name": line.name,
            "values": [round(1000 * float(e), 2) if np.isfinite(e) else None for e in flown.error_m[:slots]],
        }
        for flown, line in zip(found, said, strict=True)
    ]
    return {"end_s": end_s, "time": [round((slot + 1) * found[0].slot_s, 6) for slot in range(slots)], "series": series}


def _strips(step: Step, flights: Flights) -> str:
    """Steps b and c: for each flight its top view, its slots and its figure."""
    found, said = of_step(step, flights), lines(step, flights)
    first, count = window(found)
    parts = []
    for flown, line in zip(found, said, strict=True):
        parts.append(
            f'<div class="flight" data-flight="{flown.take.key}" data-first="{first}">{_top_view(flown, line.name)}'
            f"<div><h3>{html.escape(line.name)}<small>{html.escape(line.does)}</small></h3>"
            '<div class="strip"></div>'
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
            f'<div class="{"turn dead" if own + 1 == KILLED else "turn"}"><b>{own + 1}</b></div>'
            for own in range(agents)
        )
        round_s = agents * flown.slot_s
        mark = "" if part.mark is None else f'<u style="--at:{part.mark / part.rounds:.4f}"></u>'
        parts.append(
            f'<figure><figcaption>{html.escape(part.caption)}</figcaption><div class="turns" style="--n:{part.rounds}" '
            f'data-flight="{flown.take.key}" data-first="{part.first}" data-rounds="{part.rounds}">'
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
