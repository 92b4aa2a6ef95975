"""The page of a league: one HTML file with table and figures inside, that opens without a network."""

from __future__ import annotations

import html
from pathlib import Path

from dtsa_bench.drawing.style import save, themed
from dtsa_bench.experiments.batch.table import write_whole
from dtsa_bench.experiments.league import figures
from dtsa_bench.experiments.league.table import HEADS, LeagueTable

_ASSETS = Path(__file__).resolve().parent / "assets"


def write_league(table: LeagueTable, directory: Path, command: str = "") -> list[Path]:
    """Writes ``league.html``, ``league.csv``, ``league.tex`` and the figures (PNG and SVG).

    :param table: the entries.
    :param directory: where; it exists.
    :param command: how the table was made, shown so that it can be repeated.
    :returns: the files.
    """
    there, first = table.league, table.entries[0]
    said = f"{there.title}: {len(table.entries)} entries, {first['seeds']} seeds, cells {there.digest}"
    write_whole(directory / "league.csv", table.csv())
    write_whole(directory / "league.tex", table.latex([said, *([command] if command else [])]))
    parts = [
        f"<h1>{html.escape(there.title)}</h1>",
        f"<p class=lead>{html.escape(_lead(table))}</p>",
        f"<pre class=command>{html.escape(command)}</pre>" if command else "",
        _rows(HEADS, table.lines()),
        _figure(save(figures.scores(table), directory / "figures", "scores"), _SCORES),
        "<h2>Cells</h2>",
        _rows(("cell", "what it is"), [[cell.name, cell.text] for cell in there.cells if cell.name in table.cells]),
        _figure(save(figures.cells(table), directory / "figures", "cells"), _CELLS),
        "<h2>Entries</h2>",
        _rows(("scheme", "settings", "package", "licence", "author", "code", "digest"), _entries(table)),
        f"<h2>How to read this</h2>{_NOTES}",
    ]
    css = (_ASSETS / "sweep.css").read_text(encoding="utf-8")
    page = (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(there.title)}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta name="color-scheme" content="light dark"><style>\n{css}</style></head>\n'
        f"<body><main>\n{chr(10).join(part for part in parts if part)}\n</main></body></html>\n"
    )
    write_whole(directory / "league.html", page)
    pictures = [f"figures/{name}.{form}" for name in ("scores", "cells") for form in ("png", "svg")]
    return [directory / name for name in ("league.html", "league.csv", "league.tex", *pictures)]


def _lead(table: LeagueTable) -> str:
    flights = sum(entry["summary"]["flights"] for entry in table.entries)
    seeds = table.entries[0]["seeds"]
    part = "" if table.complete else " Not all cells and seeds were flown: this is a trial, not a result."
    return f"{len(table.entries)} entries, {flights} flights with {seeds} seeds, {len(table.cells)} cells.{part}"


def _rows(heads: tuple[str, ...], lines: list[list[str]]) -> str:
    head = "".join(f"<th>{html.escape(name)}</th>" for name in heads)
    rows = "".join(
        f"<tr>{''.join(f'<td class=label>{html.escape(cell)}</td>' for cell in line)}</tr>" for line in lines
    )
    content = f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody>"
    return f"<div class=wide tabindex=0><table class=groups>{content}</table></div>"


def _entries(table: LeagueTable) -> list[list[str]]:
    lines = []
    for entry in table.entries:
        package = entry["package"]
        settings = ", ".join(f"{key}: {value}" for key, value in entry["scheme"].items())
        named = " ".join(str(part) for part in (package.get("distribution"), package.get("version")) if part)
        said = [package.get(key) or "not given" for key in ("license", "author")]
        lines.append(
            [entry["name"], settings, named or "not given", *said, entry["made_with"]["code"], entry["digest"][:16]]
        )
    return lines


def _figure(svg: str, text: str) -> str:
    return (
        f"<figure><div class=wide tabindex=0>{themed(svg)}</div><figcaption>{html.escape(text)}</figcaption></figure>"
    )


_SCORES = "95 % intervals; grey: bounds, which know more than any radio could tell, and have no rank."
_CELLS = "Geometric mean of a cell's flights; a lost flight counts with ten rounds of TDMA."
_NOTES = """<ul>
<li>Lost: crashed, not complete in time, or a cell that the scheme cannot fly. In brackets: 95 % intervals
(Wilson).</li>
<li>Age: age from waking on, geometric mean over all flights, lost ones included with the cell's age of a lost flight.
So schemes that lose their hardest flights gain nothing by it.</li>
<li>Rank: an entry is ahead of another if it lost fewer flights of the same seeds; where that is not decided, if it has
less age on them. All tests are corrected together (Holm, 5 %). The order is by how many entries are ahead, then by lost
flights and age. In brackets: the ranks that the tests leave open.</li>
<li>Sums were made again from the flights of the entries. Whether the flights are right, <code>league check</code>
says.</li>
<li>A bound looks into all agents. Nobody can fly it.</li></ul>"""
