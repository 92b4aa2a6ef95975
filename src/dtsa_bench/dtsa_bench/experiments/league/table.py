"""The table of entries: for a page, in Markdown, as CSV and LaTeX."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.experiments.statistics import wilson
from dtsa_bench.experiments.sweep.latex import escaped
from dtsa_bench.experiments.sweep.text import share_parts

from .cells import League
from .entry import FIELDS
from .scores import Standing, standings

Entries = Sequence[Mapping[str, Any]]
HEADS = ("rank", "scheme", "lost", "crashed", "out of time", "age, ms", "on the air", "worst cell")
_SUMMARY = (
    "flights", "lost", "lost_low", "lost_high", "crashed", "timed_out", "failed", "age_ms", "age_low_ms", "age_high_ms",
    "air", "air_low", "air_high", "worst_cell",
)  # fmt: skip


class LeagueTable:
    """Entries beside each other.

    :param there: the league.
    :param entries: with the same flights; their order does not matter.
    :raises ConfigError: if they cannot be compared.
    """

    def __init__(self, there: League, entries: Entries) -> None:
        _check_alike(entries)
        self.league = there
        self.places: list[Standing] = standings(there, entries)
        by_name = {entry["name"]: entry for entry in entries}
        self.entries = [by_name[place.name] for place in self.places]  # the best first

    @property
    def cells(self) -> list[str]:
        """Names of the cells that were flown, in the league's order."""
        return [cell.name for cell in self.league.cells if cell.name in self.entries[0]["flights"]]

    @property
    def complete(self) -> bool:
        """Whether all entries have flown all."""
        return all(entry["complete"] for entry in self.entries)

    def lines(self, dash: str = "–") -> list[list[str]]:
        """A line an entry, in the columns of :data:`HEADS`, the best first.

        :param dash: between the ends of intervals.
        """
        return [self._line(place, entry, dash) for place, entry in zip(self.places, self.entries, strict=True)]

    def _line(self, place: Standing, entry: Mapping[str, Any], dash: str) -> list[str]:
        summary = entry["summary"]
        total, percent = share_parts(wilson(summary["lost"], summary["flights"]), dash)
        cell = summary["cells"][summary["worst_cell"]]
        return [
            rank_text(place, dash),
            entry["name"],
            f"{total} ({percent})",
            str(summary["crashed"]),
            f"{summary['timed_out']}" + (f" + {summary['failed']} not flown" if summary["failed"] else ""),
            f"{figure(summary['age_ms'])} ({figure(summary['age_low_ms'])}{dash}{figure(summary['age_high_ms'])})",
            percent_text(summary["air"]),
            f"{summary['worst_cell']}: {cell['lost']}/{cell['flights']}, {figure(cell['age_ms'])} ms",
        ]

    def cell_lines(self) -> list[list[str]]:
        """A line an entry: of each cell age in ms, and in brackets lost flights, if any."""
        lines = []
        for entry in self.entries:
            found = [entry["summary"]["cells"][cell] for cell in self.cells]
            lost = [f" ({cell['lost']}/{cell['flights']})" if cell["lost"] else "" for cell in found]
            ages = [figure(cell["age_ms"]) for cell in found]
            lines.append([entry["name"], *(age + text for age, text in zip(ages, lost, strict=True))])
        return lines

    def csv(self) -> str:
        """All scores, a row an entry and cell; the cell ``all`` is the whole."""
        cell_names = [name for name in _SUMMARY if name not in ("air_low", "air_high", "worst_cell")]
        out = io.StringIO()
        writer = csv.DictWriter(out, ("rank", "rank_first", "rank_last", "name", "kind", "cell", *_SUMMARY))
        writer.writeheader()
        for place, entry in zip(self.places, self.entries, strict=True):
            common = {"name": entry["name"], "kind": entry["kind"]}
            ranks = {"rank": place.rank, "rank_first": place.first, "rank_last": place.last}
            summary = entry["summary"]
            writer.writerow({**ranks, **common, "cell": "all", **{name: summary[name] for name in _SUMMARY}})
            for cell in self.cells:
                row = summary["cells"][cell]
                writer.writerow({**common, "cell": cell, **{name: row[name] for name in cell_names}})
        return out.getvalue().replace("\r\n", "\n")

    def latex(self, comments: Sequence[str]) -> str:
        """A ``tabular`` with booktabs, a row an entry.

        :param comments: lines that say how it was made.
        """
        lines = [f"% {line}" for line in comments]
        lines += [
            "% In brackets: 95 % intervals. Needs \\usepackage{booktabs}.",
            rf"\begin{{tabular}}{{{'l' * 2}{'r' * 5}l}}",
        ]
        lines += [r"\toprule", " & ".join(map(escaped, HEADS)) + r" \\", r"\midrule"]
        lines += [" & ".join(map(escaped, line)) + r" \\" for line in self.lines()]
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def rank_text(place: Standing, dash: str = "–") -> str:
    """The rank of an entry with its interval.

    :param place: of the entry.
    :param dash: between the ends of the interval.
    """
    if place.rank is None:
        return "bound"
    return f"{place.rank}" + (f" ({place.first}{dash}{place.last})" if place.first != place.last else "")


def percent_text(share: float | None) -> str:
    """A share in percent; a dash: there is none.

    :param share: 0 to 1.
    """
    return "–" if share is None else f"{100 * share:.2f} %"


def figure(value: float) -> str:
    """A number with three digits.

    :param value: the number.
    """
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def _check_alike(entries: Entries) -> None:
    """Whether entries have the same flights, and names of their own.

    :raises ConfigError: if not.
    """
    names = [entry["name"] for entry in entries]
    double = next((name for name in names if names.count(name) > 1), None)
    if double is not None:
        raise ConfigError("ENTRY", double, "every name once; `league enter --name` gives another one")
    place = FIELDS.index("seed")
    flown = [{cell: [line[place] for line in lines] for cell, lines in entry["flights"].items()} for entry in entries]
    for name, seeds in zip(names, flown, strict=True):
        if seeds != flown[0]:
            raise ConfigError("ENTRY", name, f"entries with the same cells and seeds as {names[0]}")
    if not any(flown[0].values()):
        raise ConfigError("ENTRY", names[0], "entries with flights")
