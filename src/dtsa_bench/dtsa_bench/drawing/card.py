"""Cards, by which objects describe themselves: lines for a terminal, and the same with a picture for a notebook."""

from __future__ import annotations

import html
from collections.abc import Sequence
from functools import cache
from importlib.resources import files

Rows = Sequence[tuple[str, str]]  # names and what is said


def as_text(title: str, rows: Rows, block: str = "") -> str:
    """A title, then a line a row; `block`: lines between them, such as a table."""
    width = max((len(name) for name, _ in rows), default=0)
    lines = [title, *block.splitlines(), *(f"{name:{width}}  {text}" for name, text in rows)]
    return "\n  ".join(lines)


def as_html(
    title: str, rows: Rows, *, picture: str = "", table: str = "", folded: Sequence[tuple[str, Rows]] = ()
) -> str:
    """The same for a notebook, light or dark. Nothing is loaded from elsewhere.

    Where a notebook is not trusted, its front end leaves the style out, and the plain text is shown.

    :param picture: SVG, see :func:`~dtsa_bench.drawing.flight_paths.svg_from_above`.
    :param table: HTML between the title and the rows.
    :param folded: headings, each with rows that are shown when it is clicked.
    """
    more = "".join(
        f"<details><summary>{html.escape(heading)}</summary>{_rows(inside)}</details>" for heading, inside in folded
    )
    return (
        f"<div><style>{_style()}</style><pre class=dtsa-text>{html.escape(as_text(title, rows))}</pre>"
        f'<div class=dtsa-card style="display:none"><div class=said><p class=title>{html.escape(title)}</p>{table}'
        f"{_rows(rows)}{more}</div>{picture}</div></div>"
    )


def _rows(rows: Rows) -> str:
    said = "".join(f"<tr><th>{html.escape(name)}</th><td>{html.escape(text)}</td></tr>" for name, text in rows)
    return f"<table class=rows>{said}</table>"


@cache
def _style() -> str:
    return (files("dtsa_bench.drawing") / "assets" / "card.css").read_text(encoding="utf-8")
