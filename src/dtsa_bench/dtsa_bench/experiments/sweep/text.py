"""A sweep's numbers as text, with their intervals: for a terminal, a report, a notebook and a paper."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence

from dtsa_bench.experiments.batch.table import aligned
from dtsa_bench.experiments.statistics import Mean, Share

from .aggregate import CRASHED, MEASURES, Group, Table, label_of
from .claims import claims_of

SHOWN = (
    "age_mean_slots", "age_mean_ms", "waking_age_mean_slots", "min_distance_m", "efficiency_mean",
    "completion_time_s",
)  # fmt: skip
_HEADS = {
    "min_distance_m": "dist m",
    "efficiency_mean": "effic",
    "completion_time_s": "time s",
    "age_mean_slots": "age slots",
    "age_mean_ms": "age ms",
    "waking_age_mean_slots": "waking age",
}
_GAP = 2  # blanks between two columns


def share_parts(share: Share, dash: str = "–") -> tuple[str, str]:
    """k/n, and its interval in percent; without runs a dash and nothing.

    :param share: the share.
    :param dash: between the ends of the interval.
    """
    return (str(share), f"{100 * share.low:.0f}{dash}{100 * share.high:.0f} %") if share.total else (dash, "")


def mean_parts(mean: Mean, digits: int, dash: str = "–") -> tuple[str, str]:
    """A mean, and its interval; without values a dash and nothing.

    :param mean: the mean.
    :param digits: behind the point.
    :param dash: between the ends of the interval.
    """
    if not mean.count:
        return dash, ""
    return f"{mean.value:.{digits}f}", f"{mean.low:.{digits}f}{dash}{mean.high:.{digits}f}"


def parts(group: Group, measure: str, dash: str = "–") -> tuple[str, str]:
    """Value and interval of `crashed` or of a measure of a group.

    :param group: the group.
    :param measure: its name.
    :param dash: between the ends of the interval.
    """
    if measure == CRASHED:
        return share_parts(group.crashed, dash)
    return mean_parts(group.mean(measure), MEASURES[measure].digits, dash)


def table_text(table: Table, width: int = 0, shown: Sequence[str] = SHOWN, most: int | None = None) -> str:
    """One line a group: crashes and means, each with its 95 % interval. What is too wide goes on below.

    :param table: the sweep's groups.
    :param width: characters in a line; 0: as many as it takes.
    :param shown: measures beside the crashes; those that no group has are left out.
    :param most: groups shown; None: all.
    """
    groups = [group for group in table.groups if group.rows][:most]
    labels = [[axis, *(str(group.labels[axis]) for group in groups)] for axis in table.sweep.axes]
    out = ["out", *(str(sum(group.left_out().values())) for group in groups)]
    blocks = [[*_columns(groups, CRASHED, "crashed"), out]]
    blocks += [
        _columns(groups, name, _HEADS.get(name, name))
        for name in shown
        if any(group.mean(name).count for group in groups)
    ]
    lines: list[str] = []
    while blocks:
        taken = [*labels, *blocks.pop(0)]
        while blocks and (not width or _width([*taken, *blocks[0]]) <= width):
            taken += blocks.pop(0)
        lines += ([""] if lines else []) + [aligned(list(zip(*taken, strict=True)))]
    return "\n".join(lines)


def table_html(table: Table, shown: Sequence[str] = SHOWN, most: int | None = None) -> str:
    """The same as an HTML table, in which a small picture shows each interval on the scale of its column.

    :param table: the sweep's groups.
    :param shown: measures beside the crashes; those that no group has are left out.
    :param most: groups shown; None: all.
    """
    groups = [group for group in table.groups if group.rows]
    measures = [CRASHED, *(name for name in shown if any(group.mean(name).count for group in groups))]
    heads = [*table.sweep.axes, *(label_of(name) for name in measures)]
    scales = {name: _scale(groups, name) for name in measures}
    rows = []
    for group in groups[:most]:
        cells = [html.escape(str(group.labels[axis])) for axis in table.sweep.axes]
        for name in measures:
            value, interval = parts(group, name)
            cells.append(f"{value} <small>{interval}</small>{_interval(group, name, *scales[name])}")
        rows.append(f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>")
    head = "".join(f"<th>{html.escape(name)}</th>" for name in heads)
    left = f"<p>... {len(groups) - most} more settings</p>" if most is not None and len(groups) > most else ""
    return f"<table class=groups><tr>{head}</tr>{''.join(rows)}</table>{left}"


def _ends(group: Group, measure: str) -> tuple[float, float, float]:
    """Value and interval as numbers."""
    if measure == CRASHED:
        return group.crashed.value, group.crashed.low, group.crashed.high
    mean = group.mean(measure)
    return mean.value, mean.low, mean.high


def _scale(groups: Sequence[Group], measure: str) -> tuple[float, float]:
    """What the pictures of a column reach from and to."""
    if measure == CRASHED:
        return 0.0, 1.0
    ends = [end for group in groups if group.mean(measure).count for end in _ends(group, measure)]
    return min(0.0, *ends), max(ends)


def _interval(group: Group, measure: str, low: float, high: float) -> str:
    """A line for the interval, and a dot for the value."""
    value, first, last = _ends(group, measure)
    if not math.isfinite(value) or high <= low:
        return ""
    x, begin, end = (4 + 122 * (at - low) / (high - low) for at in (value, first, last))
    return (
        '<svg class="interval" viewBox="0 0 130 12" role="img" aria-hidden="true">'
        f'<path d="M{begin:.1f} 6H{end:.1f}"/><circle cx="{x:.1f}" cy="6" r="3.2"/></svg>'
    )


def _columns(groups: Sequence[Group], measure: str, head: str) -> list[list[str]]:
    """Values of a measure, and their intervals, as two columns."""
    values = [parts(group, measure, "-") for group in groups]
    return [[head, *(value for value, _ in values)], ["95 %", *(interval for _, interval in values)]]


def _width(columns: Sequence[Sequence[str]]) -> int:
    return sum(max(map(len, column)) + _GAP for column in columns) - _GAP


def claims_text(table: Table) -> str:
    """The claims of the sweep, a line each; empty if it has none.

    :param table: the sweep's groups.
    """
    lines = []
    for claim in claims_of(table):
        if claim.paper:
            lines.append(f"{claim.verdict + ':':15}{claim.paper}")
        lines += [f"{'':17}{text}" for text in (claim.measured, claim.why) if text]
    return "\n".join(lines)
