"""How all figures look, and how they are saved."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context

from dtsa_agent.core.errors import ConfigError

from . import palette

INK, QUIET, GRID = "#1d2733", "#5b6774", "#dfe4ea"
PAPER = "#ffffff"
# Text on coloured cells, which keep their colours on a dark page.
ON_LIGHT, ON_DARK = "#1c2632", "#fdfdfd"
_BLUE, _RED, _GREEN, _PINK, _AMBER, _SKY = palette.SERIES
# In the order in which series get them.
CYCLE = (_RED, _BLUE, _GREEN, _AMBER, _PINK, _SKY, "#6b7785")
# Schemes have the same colour in every figure.
COLOURS = {
    "TDMA, hold": _RED, "DTSA, hold": _AMBER, "TDMA, linear": _BLUE, "DTSA, linear": _GREEN,
    "TDMA, intent": _SKY, "age, linear": _PINK, "oracle": "#6b7785", "lease": _AMBER,
    "tdma": _BLUE, "dtsa": _GREEN, "age": _PINK, "aloha": _RED,
}  # fmt: skip
MARKERS = ("o", "s", "D", "^", "v", "P", "X")

_SETTINGS = {
    "font.family": "sans-serif", "font.sans-serif": ["DejaVu Sans"], "font.size": 9, "axes.titlesize": 10,
    "axes.titleweight": "bold", "axes.titlelocation": "left", "axes.titlepad": 9, "axes.labelcolor": INK,
    "axes.edgecolor": QUIET, "axes.linewidth": 0.8, "axes.spines.top": False, "axes.spines.right": False,
    "axes.grid": True, "axes.axisbelow": True, "grid.color": GRID, "grid.linewidth": 0.8, "text.color": INK,
    "xtick.color": QUIET, "ytick.color": QUIET, "xtick.labelcolor": INK, "ytick.labelcolor": INK,
    "xtick.major.size": 3, "ytick.major.size": 3, "legend.frameon": False, "legend.fontsize": 9,
    "figure.facecolor": "white", "savefig.facecolor": "white", "lines.linewidth": 1.8,
    "lines.markersize": 4.5,
    "pdf.fonttype": 42,  # publishers want TrueType
    "svg.fonttype": "none", "svg.hashsalt": "dtsa", "figure.dpi": 100,
}  # fmt: skip


@contextmanager
def style() -> Iterator[None]:
    """Settings that hold while figures are drawn and saved, whatever stands in a user's matplotlibrc."""
    with context(["default", _SETTINGS]):
        yield


def colours(names: Sequence[object]) -> list[str]:
    """Colours of the series of one figure, all different."""
    taken = [COLOURS.get(str(name)) for name in names]
    spare = iter([c for c in CYCLE if c not in taken] + list(CYCLE))
    return [own if own is not None else next(spare) for own in taken]


def panels(
    count: int, width: float = 3.3, height: float = 3.1, columns: int = 3, given: Sequence[Axes] | None = None
) -> tuple[Figure, list[Axes]]:
    """Return a figure with panels side by side, each so many inches large, at most `columns` in a row.

    :param given: the panels of another figure, to draw in instead.
    :raises ConfigError: if they are not as many.
    """
    if given is not None:
        if len(given) != count:
            raise ConfigError("ax", f"{len(given)} axes", f"{count}, one a panel")
        return given[0].get_figure(root=True), list(given)  # type: ignore[return-value]
    across = min(count, columns)
    down = -(-count // across)
    figure = Figure(figsize=(width * across, height * down), layout="constrained")
    grid = figure.subplots(down, across, squeeze=False)
    axes = list(grid.flat)
    for spare in axes[count:]:
        spare.remove()
    return figure, axes[:count]


def add_legend(axes: Sequence[Axes], handles: Sequence[Any], names: Sequence[object], *, above: bool) -> None:
    """Add one legend for all panels: above them, or in the first one, where the figure is another one's."""
    texts = [str(name) for name in names]
    if len(texts) > 1 and above:
        place: dict[str, Any] = {"loc": "outside upper left", "ncols": min(len(texts), 5), "columnspacing": 1.4}
        axes[0].figure.legend(handles, texts, handlelength=1.4, **place)
    elif len(texts) > 1:
        axes[0].legend(handles, texts)


def svg_text(figure: Figure) -> str:
    """The figure as SVG that can stand inside HTML; equal figures give equal text."""
    buffer = io.StringIO()
    with style():
        figure.savefig(buffer, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def save(figure: Figure, directory: Path, name: str) -> str:
    """Save a figure as PNG (200 dpi) and SVG; return the SVG with ids of its own, so that several fit on one page."""
    directory.mkdir(parents=True, exist_ok=True)
    text = svg_text(figure)
    (directory / f"{name}.svg").write_text('<?xml version="1.0" encoding="utf-8"?>\n' + text, encoding="utf-8")
    with style():
        figure.savefig(directory / f"{name}.png", dpi=200)
    return unique_ids(text, name)


def save_described(figure: Figure, path: Path, title: str, description: str, creator: str) -> None:
    """Save a figure as PDF, SVG or PNG with metadata: what it shows, how it was made, by which program."""
    now = datetime.now(timezone.utc).replace(microsecond=0)
    metadata = {
        ".pdf": {"Title": title, "Subject": description, "Creator": creator, "CreationDate": now},
        ".svg": {"Title": title, "Description": description, "Creator": creator, "Date": now},
        ".png": {"Title": title, "Description": description, "Software": creator, "Creation Time": now.isoformat()},
    }
    with style():
        figure.savefig(path, dpi=300, metadata=metadata[path.suffix])


def unique_ids(svg: str, prefix: str) -> str:
    """The SVG with all its ids prefixed, so that several can stand on one page."""
    prefix = re.sub(r"[^A-Za-z0-9_-]", "-", prefix)
    svg = re.sub(r'\bid="', f'id="{prefix}-', svg)
    svg = re.sub(r'href="#', f'href="#{prefix}-', svg)
    return re.sub(r"url\(#", f"url(#{prefix}-", svg)


def themed(svg: str) -> str:
    """The SVG with the page's own colours for paper, ink and grid, so that it can be read in the dark, too."""
    for colour, variable in ((PAPER, "paper"), (INK, "ink"), (QUIET, "quiet"), (GRID, "line")):
        svg = svg.replace(f": {colour}", f": var(--{variable})")
    return svg.replace("'DejaVu Sans'", "'DejaVu Sans', Verdana, sans-serif")
