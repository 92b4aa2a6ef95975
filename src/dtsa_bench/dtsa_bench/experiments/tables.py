"""Rows of runs summed up, one group a combination of the axes, and written as text, HTML, LaTeX, CSV and JSON."""

from __future__ import annotations

import html
import json
import math
import re
import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dtsa_bench.runs.options import write_whole

from .batch import FAILED, Row
from .statistics import Mean, Share, bootstrap_mean, wilson
from .sweep import COMMON, CRASHED, MEASURES, VALUES, Cell, Measure, Sweep

if TYPE_CHECKING:
    import pandas as pd


SHOWN = (
    "age_mean_slots", "age_mean_ms", "waking_age_mean_slots", "min_distance_m", "efficiency_mean", "completion_time_s",
)  # fmt: skip
_GAP = 2  # blanks between two columns
_HEAD_WIDTH = 14  # letters in a column's head in LaTeX
_LATEX = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": "$<$", ">": "$>$",
    "|": "$|$", "–": "--", **{sign: "\\" + sign for sign in "&%$#_{}"},
}  # fmt: skip


def label_of(measure: str) -> str:
    """Return a measure with its unit."""
    if measure == CRASHED:
        return "flights that crashed"
    spec = MEASURES[measure]
    return f"{spec.label} [{spec.unit}]" if spec.unit else spec.label


class Group:
    """All runs of one cell."""

    def __init__(self, cell: Cell, rows: Sequence[Row]) -> None:
        self.cell, self.labels, self.rows = cell, cell.labels, list(rows)
        flown = [row for row in rows if row["status"] != FAILED]
        self.flown_count, self.failed = len(flown), len(rows) - len(flown)
        self.timed_out = sum(row["status"] == "timed out" for row in flown)
        self.crashed: Share = wilson(sum(bool(row["collided"]) for row in flown), len(flown))
        #: Runs that do not count for means of complete flights, by reason.
        self.left_out: Counter[str] = Counter(reason for row in rows if (reason := _why_left_out(row)))
        self._means: dict[str, Mean] = {}

    def mean(self, measure: str) -> Mean:
        """Mean of a measure over the runs that count, with a bootstrap interval."""
        if measure not in self._means:
            spec = MEASURES[measure]
            self._means[measure] = bootstrap_mean(_value(row, spec) for row in self.rows)
        return self._means[measure]

    def point(self, measure: str) -> tuple[float, float, float]:
        """Value and ends of the interval of :data:`CRASHED` or a measure; not a number if no run counts."""
        if measure == CRASHED and not self.crashed.total:
            return math.nan, math.nan, math.nan
        statistic = self.crashed if measure == CRASHED else self.mean(measure)
        return statistic.value, statistic.low, statistic.high

    def texts(self, measure: str, dash: str = "–") -> tuple[str, str]:
        """Value and interval as text; a dash and nothing if no run counts, no interval if one does."""
        if measure == CRASHED:
            return share_texts(self.crashed, dash)
        mean, digits = self.mean(measure), MEASURES[measure].digits
        value, *ends = (f"{number:.{digits}f}" for number in (mean.value, mean.low, mean.high))
        return value if mean.count else dash, dash.join(ends) if mean.count > 1 else ""

    def flat(self) -> Row:
        """One row of plain values: labels, how the flights ended, and means with their intervals."""
        row: Row = {**self.labels, "runs": len(self.rows), "failed": self.failed, "timed_out": self.timed_out}
        row |= {"crashed": self.crashed.value, "crashed_low": self.crashed.low, "crashed_high": self.crashed.high}
        for name in MEASURES:
            mean = self.mean(name)
            row |= {name: mean.value, f"{name}_low": mean.low, f"{name}_high": mean.high, f"{name}_count": mean.count}
        return row

    def plain(self) -> Row:
        """The same, nested, for results.json; measures that no run has are left out."""
        crashed, means = self.crashed, {name: self.mean(name) for name in MEASURES}
        return {
            **self.labels,
            "runs": len(self.rows),
            "timed_out": self.timed_out,
            "left_out": self.left_out,
            "crashed": {"count": crashed.count, "of": crashed.total, "low": crashed.low, "high": crashed.high},
            **{
                name: {"mean": mean.value, "runs": mean.count}
                | ({"low": mean.low, "high": mean.high} if mean.count > 1 else {})
                for name, mean in means.items()
                if mean.count
            },
        }


def _why_left_out(row: Row) -> str:
    if row["status"] == FAILED:
        return f"failed ({row['reason']})"
    if row["collided"]:
        return "crashed"
    return "" if row["status"] == "completed" else str(row["status"])


def _value(row: Row, spec: Measure) -> float:
    if row["status"] == FAILED or (spec.complete_only and _why_left_out(row)):
        return math.nan
    if spec.name == "wasted_share":
        return float((row["slots_total"] - row["slots_success"]) / row["slots_total"])
    value = row.get(spec.name)
    return math.nan if value is None else float(value)


def share_texts(share: Share, dash: str = "–") -> tuple[str, str]:
    """k/n, and its interval in percent; a dash and nothing without runs."""
    return (str(share), f"{100 * share.low:.0f}{dash}{100 * share.high:.0f} %") if share.total else (dash, "")


class SweepTable:
    """All rows and groups of a sweep, in its order; runs without a finished row are left out."""

    def __init__(self, sweep: Sweep, finished: Mapping[str, Row]) -> None:
        self.sweep = sweep
        self.rows: list[Row] = []  # labels, seed, status, reason, collided and VALUES
        cells: list[list[Row]] = [[] for _ in sweep.cells]
        for task in sweep.tasks:
            if task.key in finished:
                row = finished[task.key]
                common = {"seed": task.seed, "status": row["status"], "reason": row.get("reason", "")}
                self.rows.append({**sweep.cells[task.cell].labels, **common, **_values(row["summary"] or {})})
                cells[task.cell].append(self.rows[-1])
        self.groups = [Group(cell, rows) for cell, rows in zip(sweep.cells, cells, strict=True)]

    @property
    def groups_with_runs(self) -> list[Group]:
        """Groups that have rows."""
        return [group for group in self.groups if group.rows]

    def levels(self, axis: str) -> list[Any]:
        """The values of an axis, in the sweep's order."""
        return list(dict.fromkeys(group.labels[axis] for group in self.groups))

    def select_groups(self, **labels: Any) -> list[Group]:
        """Return the groups with these labels."""
        return [g for g in self.groups if all(g.labels.get(axis) == value for axis, value in labels.items())]

    def measured(self, measures: Sequence[str] = tuple(MEASURES)) -> list[str]:
        """Those of some measures that any group has."""
        return [name for name in measures if any(group.mean(name).count for group in self.groups)]

    def left_out(self) -> Counter[str]:
        """Runs left out of the means of complete flights, by reason."""
        return sum((group.left_out for group in self.groups), Counter())

    def runs_frame(self, dtype: type | None = None) -> pd.DataFrame:
        """A row a flight: axes, :data:`COMMON` and :data:`VALUES`."""
        import pandas as pd

        return pd.DataFrame(self.rows, columns=[*self.sweep.axes, *COMMON, *VALUES], dtype=dtype)

    def groups_frame(self) -> pd.DataFrame:
        """A row a group, see :meth:`Group.flat`."""
        import pandas as pd

        return pd.DataFrame([group.flat() for group in self.groups])


def _values(summary: Row) -> Row:
    slots = {f"slots_{name}": count for name, count in summary.get("slots", {}).items()}
    return {name: slots.get(name, summary.get(name)) for name in ("collided", *VALUES)}


def write_results(directory: Path, table: SweepTable, code: str) -> None:
    """Write ``results.csv`` and ``results.json``, each in one go."""
    sweep = table.sweep
    head = {"name": sweep.name, "title": sweep.title, "code": code, "sweep": sweep.spec.to_dict()}
    content = {**head, "groups": [group.plain() for group in table.groups], "runs": table.rows}
    write_whole(directory / "results.json", json.dumps(content, indent=1, default=str) + "\n")
    write_whole(directory / "results.csv", table.runs_frame(object).to_csv(index=False))


def aligned(lines: Sequence[Sequence[str]], rule: bool = False) -> str:
    """Return lines of cells in columns, the head first, for a terminal; `rule` draws a line below the head."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    padded = ["  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in lines]
    if rule:
        padded.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(padded)


def markdown(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Return lines of cells as a table in Markdown."""
    top = ["|" + "|".join(f" {name} " if name else " " for name in head) + "|", "|---" * len(head) + "|"]
    return "\n".join([*top, *("| " + " | ".join(line) + " |" for line in lines)])


def table_text(table: SweepTable, width: int = 0, shown: Sequence[str] = SHOWN, most: int | None = None) -> str:
    """Return one line a group: crashes and means with their 95 % intervals. A table that is too wide goes on below.

    `width` is in characters, 0: as many as it takes; at most `most` groups are shown.
    """
    groups = table.groups_with_runs[:most]
    labels = [[axis, *(str(group.labels[axis]) for group in groups)] for axis in table.sweep.axes]
    out = ["out", *(str(group.left_out.total()) for group in groups)]
    blocks = []
    for name in (CRASHED, *table.measured(shown)):
        values, intervals = zip(*(group.texts(name, "-") for group in groups), strict=True) if groups else ((), ())
        head = name if name == CRASHED else MEASURES[name].head or name
        blocks.append([[head, *values], ["95 %", *intervals], *([out] if name == CRASHED else [])])
    parts: list[list[list[str]]] = []
    for block in blocks:
        if parts and (not width or sum(max(map(len, c)) + _GAP for c in [*parts[-1], *block]) - _GAP <= width):
            parts[-1] += block
        else:
            parts.append([*labels, *block])
    heads = [f"{MEASURES[name].head}: {label_of(name)}" for name in table.measured(shown) if MEASURES[name].head]
    legend = "; ".join(["out: flights that did not end as they should, left out of distances and times", *heads])
    if width:
        legend = textwrap.fill(legend, width, break_long_words=False, break_on_hyphens=False)
    return "\n\n".join([*(aligned(list(zip(*part, strict=True))) for part in parts), legend])


def table_html(table: SweepTable, shown: Sequence[str] = SHOWN, most: int | None = None) -> str:
    """Return the same as an HTML table, in which a small picture shows each interval on the scale of its column."""
    import pandas as pd

    groups, columns = table.groups_with_runs, {}
    for axis in table.sweep.axes:
        columns[html.escape(axis)] = [html.escape(str(group.labels[axis])) for group in groups]
    for name in (CRASHED, *table.measured(shown)):
        points = [group.point(name) for group in groups]
        ends = [end for point in points for end in point if math.isfinite(end)]
        low, high = (0.0, 1.0) if name == CRASHED else (min(0.0, *ends), max(ends))
        texts = (f"{value} <small>{interval}</small>" for value, interval in (group.texts(name) for group in groups))
        pictures = (_interval(point, low, high) for point in points)
        columns[html.escape(label_of(name))] = [text + picture for text, picture in zip(texts, pictures, strict=True)]
    with pd.option_context("display.max_colwidth", None):
        text = str(pd.DataFrame(columns)[:most].to_html(index=False, escape=False, border=0, classes="groups"))
    return text + (f"<p>... {len(groups) - most} more settings</p>" if most is not None and len(groups) > most else "")


def _interval(point: tuple[float, float, float], low: float, high: float) -> str:
    """A line for the interval, and a dot for the value."""
    if not all(map(math.isfinite, point)) or high <= low:
        return ""
    x, begin, end = (4 + 122 * (at - low) / (high - low) for at in point)
    return (
        '<svg class="interval" viewBox="0 0 130 12" role="img" aria-hidden="true">'
        f'<path d="M{begin:.1f} 6H{end:.1f}"/><circle cx="{x:.1f}" cy="6" r="3.2"/></svg>'
    )


def latex_table(table: SweepTable, measures: Sequence[str], comments: Sequence[str]) -> str:
    """Return a `tabular` with booktabs, a row a group: value and 95 % interval of each measure, or of :data:`CRASHED`.

    `comments` are lines that say how the table was made.
    """
    import pandas as pd

    axes, groups = table.sweep.axes, table.groups_with_runs
    columns = {latex_text(axis): [latex_text(str(group.labels[axis])) for group in groups] for axis in axes}
    for name in measures:
        lines = r" \\{} ".join(map(latex_text, textwrap.wrap(label_of(name), _HEAD_WIDTH)))
        columns[rf"\shortstack{{{lines}}}"] = [_latex_cell(*group.texts(name)) for group in groups]
    form = "l" * len(axes) + "r" * len(measures)
    rows = pd.DataFrame(columns).to_latex(index=False, escape=False, column_format=form).splitlines()
    if len(axes) > 1 and len(table.levels(axes[0])) < len(groups):  # the levels of the first axis apart
        first = rows.index(r"\midrule") + 1
        for number in range(len(groups) - 1, 0, -1):
            if groups[number].labels[axes[0]] != groups[number - 1].labels[axes[0]]:
                rows.insert(first + number, r"\addlinespace")
    notes = [f"% {line}" for comment in comments for line in comment.splitlines()]
    return "\n".join([*notes, r"% In brackets: 95 % intervals. Needs \usepackage{booktabs}.", *rows, ""])


def _latex_cell(value: str, interval: str) -> str:
    return latex_text(value) + (rf" {{\footnotesize({latex_text(interval)})}}" if interval else "")


def latex_text(text: str) -> str:
    """Return a text as LaTeX prints it."""
    return re.sub(r"[\\~^<>|–&%$#_{}]", lambda match: _LATEX[match.group()], text)
