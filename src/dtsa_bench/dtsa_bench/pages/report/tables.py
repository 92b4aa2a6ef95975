"""Pages of sweeps and leagues: tables and figures in one HTML file that opens without a network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from dtsa_bench.drawing.style import save, themed
from dtsa_bench.experiments.charts import draw, league_scores
from dtsa_bench.experiments.league import HEADS, STAR, LeagueTable
from dtsa_bench.experiments.paper import seeds_text
from dtsa_bench.experiments.statistics import LEVEL, wilson
from dtsa_bench.experiments.sweep import CRASHED
from dtsa_bench.experiments.tables import SweepTable, label_of
from dtsa_bench.pages.html import render_page
from dtsa_bench.runs.options import write_whole


@dataclass(frozen=True, slots=True)
class Part:
    """A part of a page: a figure, a table or a list below a heading."""

    title: str = ""
    text: str = ""
    svg: str = ""
    heads: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    list: Sequence[str] = ()


def write_tables(
    path: Path, kicker: str, title: str, parts: Sequence[Part], lead: str, facts: Sequence[str] = (), command: str = ""
) -> Path:
    """Write a page of parts; `command`: how it was made, shown so that it can be repeated."""
    scripts = ("page.js", "tables.js")
    page = render_page(
        "tables", title, scripts, {}, kicker=kicker, lead=lead, facts=facts, command=command, parts=parts
    )
    write_whole(path, page)
    return path


def _figure(svg: str, caption: str) -> Part:
    """A figure in the colours of the page."""
    return Part(svg=Markup(themed(svg)), text=caption)


def write_report(table: SweepTable, directory: Path, code: str, command: str = "") -> Path:
    """Draw all figures of a sweep into ``figures``, and write ``report.html``.

    :param code: fingerprint of the code that flew.
    :param command: how the sweep was made, shown so that it can be repeated.
    """
    sweep, seeds = table.sweep, table.sweep.seeds
    drawn = [
        _figure(save(draw(table, spec), directory / "figures", spec["name"]), str(spec.get("caption", "")).strip())
        for spec in sweep.figures
    ]
    facts = [
        f"{len(table.rows)} of {len(sweep.cells) * len(seeds)} flights",
        f"{len(sweep.cells)} settings",
        f"{len(seeds)} seeds ({seeds_text(seeds)})",
        f"code {code}",
    ]
    left_out = sorted(table.left_out().items())
    text = f"Left out of distances, efficiencies and times (as in the paper), of {len(table.rows)} flights:"
    none = "No flight was left out: all were completed without a crash."
    notes = [note.format(level=100 * LEVEL, seeds=len(seeds), most=100 * wilson(0, len(seeds)).high) for note in _NOTES]
    sections = [
        *drawn,
        _groups(table),
        Part(text=text if left_out else none, list=[f"{count} {reason}" for reason, count in left_out]),
        Part("How to read this", list=notes),
    ]
    return write_tables(directory / "report.html", "Sweep", sweep.title, sections, sweep.text, facts, command)


def _groups(table: SweepTable) -> Part:
    measures = table.measured()
    ends = [name for name in ("timed_out", "failed") if any(getattr(group, name) for group in table.groups_with_runs)]
    heads = [*table.sweep.axes, "crashed", *(name.replace("_", " ") for name in ends), *map(label_of, measures)]
    rows = []
    for group in table.groups_with_runs:
        mark = Markup('<span class="bad">{}</span>' if group.crashed.count else '<span class="good">{}</span>')
        rows.append([
            *(str(group.labels[axis]) for axis in table.sweep.axes),
            mark.format(_small(group.texts(CRASHED))), *(str(getattr(group, name) or "") for name in ends),
            *(_small(group.texts(name)) for name in measures),
            f"{group.mean('min_distance_m').count}/{len(group.rows)}",
        ])  # fmt: skip
    return Part("All settings", heads=[*heads, "counted"], rows=rows)


def _small(shown: tuple[str, str]) -> str:
    """A value, with its interval in small print."""
    value, interval = shown
    return Markup("{} <small>{}</small>").format(value, interval) if interval else value


def write_league(table: LeagueTable, directory: Path, command: str = "") -> Path:
    """Write ``league.html`` and its figure (PNG and SVG) to a directory that exists; return the page's path."""
    league, flights = table.league, sum(found.lost.total for found in table.scores)
    trial = "" if table.complete else " Not all cells and seeds were flown: this is a trial, not a result."
    lead = f"{len(table.entries)} entries, {flights} flights, {len(table.cells)} cells.{trial}"
    entries = [
        [
            entry["name"],
            ", ".join(f"{key}: {value}" for key, value in entry["scheme"].items()),
            *(str(entry[key]) for key in ("package", "commit", "date")),
        ]
        for entry in table.entries
    ]
    sections = [
        Part("Results", heads=HEADS, rows=table.lines()),
        _figure(save(league_scores(table), directory / "figures", "scores"), _SCORES),
        Part("Cells", heads=("cell", "what it is"), rows=[(name, league.cells[name]["text"]) for name in table.cells]),
        Part("Ages", _CELLS, heads=("scheme", *table.cells), rows=table.cell_lines()),
        Part("Entries", heads=("scheme", "settings", "package", "commit", "flown"), rows=entries),
        Part("How to read this", list=_LEAGUE_NOTES),
    ]
    return write_tables(directory / "league.html", "League", league.title, sections, lead, command=command)


_NOTES = (
    "Small print is a {level:.0f} % interval: Wilson's for crashes, a bootstrap over seeds for means. 0 of {seeds} "
    "still leaves up to {most:.0f} %.",
    "Distances, efficiencies and times are those of completed flights without a crash; “counted” says how many those "
    "are. Ages and errors are those of all flights.",
    "Equal seeds mean equal scenarios: compare schemes seed by seed, with the rows of results.csv.",
    "A scheduler is to blame or to praise only where the estimator is the same, and where the oracle, which knows "
    "everything, does not crash.",
)
_SCORES = "95 % intervals; grey: bounds, which know more than any radio could tell, and have no rank."
_CELLS = "Age in each cell, ms: geometric mean of its flights; in brackets the lost ones, if any."
_LEAGUE_NOTES = (
    "Lost: crashed, not complete in time, or a cell that the scheme cannot fly. In brackets: 95 % intervals (Wilson).",
    "Age: age from waking on, geometric mean over all flights, lost ones included with the cell's age of a lost "
    "flight, ten rounds of TDMA. So schemes that lose their hardest flights gain nothing by it.",
    "Rank: by lost flights times age. Whether the flights are right, “league check” says.",
    "A bound looks into all agents. Nobody can fly it.",
    STAR,
)
