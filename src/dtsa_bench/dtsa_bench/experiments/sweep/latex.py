"""A sweep's table for a paper, in LaTeX with booktabs."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence

from .aggregate import Group, Table, label_of
from .text import parts

_SPECIAL = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": "$<$", ">": "$>$",
    "|": "$|$", "–": "--", **{sign: "\\" + sign for sign in "&%$#_{}"},
}  # fmt: skip
_HEAD_WIDTH = 14  # letters


def latex_table(table: Table, measures: Sequence[str], comments: Sequence[str]) -> str:
    """A `tabular` with one row a group: value and 95 % interval of each measure.

    :param table: the sweep's groups.
    :param measures: `crashed`, and names of measures.
    :param comments: lines that say how the table was made.
    """
    axes, groups = table.sweep.axes, [group for group in table.groups if group.rows]
    heads = [escaped(axis) for axis in axes]
    heads += [rf"\multicolumn{{2}}{{c}}{{{_head(label_of(measure))}}}" for measure in measures]
    lines = [*(f"% {line}" for comment in comments for line in comment.splitlines())]
    lines += ["% In brackets: 95 % intervals. Needs \\usepackage{booktabs}."]
    lines += [rf"\begin{{tabular}}{{{'l' * len(axes)}{'r@{~}l' * len(measures)}}}", r"\toprule"]
    lines += [" & ".join(heads) + r" \\", r"\midrule"]
    blocks = len(axes) > 1 and len(table.levels(axes[0])) < len(groups)
    for number, group in enumerate(groups):
        if blocks and number and group.labels[axes[0]] != groups[number - 1].labels[axes[0]]:
            lines.append(r"\addlinespace")
        lines.append(" & ".join(_cells(group, axes, measures)) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def _head(label: str) -> str:
    """A label in lines that are hardly wider than the numbers below it."""
    # An empty group, because a bracket behind a line's end would be taken for its distance.
    lines = r" \\{} ".join(map(escaped, textwrap.wrap(label, _HEAD_WIDTH)))
    return rf"\shortstack{{{lines}}}"


def _cells(group: Group, axes: Sequence[str], measures: Sequence[str]) -> list[str]:
    cells = [escaped(str(group.labels[axis])) for axis in axes]
    for measure in measures:
        value, interval = parts(group, measure)
        cells += [escaped(value), rf"{{\footnotesize({escaped(interval)})}}" if interval else ""]
    return cells


def escaped(text: str) -> str:
    """Text as LaTeX prints it.

    :param text: any.
    """
    return re.sub(r"[\\~^<>|–&%$#_{}]", lambda found: _SPECIAL[found.group()], text)
