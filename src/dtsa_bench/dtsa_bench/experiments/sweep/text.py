"""A sweep's table for the terminal."""

from __future__ import annotations

from dtsa_bench.experiments.batch.table import aligned

from .aggregate import MEASURES, Group, Table
from .claims import claims_of

SHOWN = ("min_distance_m", "efficiency_mean", "completion_time_s", "age_mean_slots", "waking_age_mean_slots")
_HEADS = {
    "min_distance_m": "dist m",
    "efficiency_mean": "effic",
    "completion_time_s": "time s",
    "age_mean_slots": "age",
    "waking_age_mean_slots": "waking age",
}


def table_text(table: Table) -> str:
    """One line a cell: crashes with their interval, and means.

    :param table: the sweep's groups.
    """
    head = [*table.sweep.axes, "crashed", "95 %", "out", *(_HEADS[name] for name in SHOWN)]
    lines = [head, *(_line(table, group) for group in table.groups if group.rows)]
    return aligned(lines)


def _line(table: Table, group: Group) -> list[str]:
    share = group.crashed
    means = []
    for name in SHOWN:
        mean = group.mean(name)
        means.append(f"{mean.value:.{MEASURES[name].digits}f}" if mean.count else "-")
    labels = [str(group.labels[axis]) for axis in table.sweep.axes]
    return [
        *labels,
        str(share),
        f"{100 * share.low:.0f}-{100 * share.high:.0f}",
        str(sum(group.left_out().values())),
        *means,
    ]


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
