"""Puts a report together: data, script and style in one HTML file that needs nothing else."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Callable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import REASON_TEXTS
from dtsa_bench.drawing import palette
from dtsa_bench.experiments.batch.table import write_whole
from dtsa_bench.recordings.bag.errors import BagError

from .data import run_data

MOST = 6  # runs that are readable side by side
PALETTE = {
    "agents": palette.AGENT_COLOURS,
    "dashes": palette.DASHES,
    "shapes": palette.SHAPES,
    "hovering": palette.HOVERING,
    "series": palette.SERIES,
}
SCRIPTS = ("core.js", "plot.js", "scene.js", "slots.js", "player.js", "page.js")


NOTE = '<noscript><p class="note">This page draws itself with JavaScript; please allow it for this file.</p></noscript>'
_BODY = f'{NOTE}\n<div id="report"></div>'


def filled(text: str, parts: Mapping[str, str]) -> str:
    """A text with all its places filled.

    :param text: a place is the name of a part in double braces.
    :param parts: what is put in, as it is.
    """
    # In one pass: what is put in may itself look like a place to put something.
    return re.sub(r"\{\{ (\w+) \}\}", lambda match: parts[match[1]], text)


def whole_page(kind: str, title: str, style: str, body: str, data: Any, script: str) -> str:
    """An HTML page that needs nothing else.

    :param kind: class of its body.
    :param title: plain text.
    :param style: CSS.
    :param body: HTML.
    :param data: what the script finds as JSON in the element `data`.
    :param script: JavaScript.
    """
    text = json.dumps(data, separators=(",", ":"), allow_nan=False, default=str)
    # A "<" could end the script element; as an escape it means the same in JSON.
    parts = {"kind": kind, "title": html.escape(title), "data": text.replace("<", "\\u003c")}
    return filled(asset("page.html"), {**parts, "style": style, "body": body, "script": script})


def asset(name: str) -> str:
    """A file of the report's page.

    :param name: its name.
    """
    return (files("dtsa_bench.pages.report") / "assets" / name).read_text(encoding="utf-8")


def render(runs: Sequence[dict[str, Any]]) -> str:
    """The page.

    :param runs: what `run_data` gave for each run.
    """
    content = {"runs": list(runs), "palette": PALETTE, "reasons": dict(REASON_TEXTS)}
    return whole_page("report", _title(runs), asset("style.css"), _BODY, content, "\n".join(map(asset, SCRIPTS)))


def write_report(bags: Sequence[str | Path], out: str | Path, progress: Callable[[str], None] | None = None) -> Path:
    """Write the report of one bag, or of several side by side.

    :param bags: one to six bags.
    :param out: the HTML file; an older one is replaced.
    :param progress: called with each bag before it is read.
    :raises ConfigError: for unusable bags, too many of them, or an unusable output path.
    :raises BagError: if the file cannot be written.
    """
    if not 1 <= len(bags) <= MOST:
        raise ConfigError("bags", len(bags), f"1 to {MOST} side by side")
    target = Path(out)
    if target.is_dir():
        raise ConfigError("out", str(out), "the name of a file; this is a directory")
    runs = []
    for bag in bags:
        if progress:
            progress(str(bag))
        runs.append(run_data(bag))
    _tell_apart(runs)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_whole(target, render(runs))
    except OSError as error:
        raise BagError(f"cannot write {target}: {error.strerror or error}") from error
    return target


def _title(runs: Sequence[dict[str, Any]]) -> str:
    return " · ".join(run["name"] for run in runs) + " – DTSA report"


def _tell_apart(runs: list[dict[str, Any]]) -> None:
    """Give runs of the same name different ones."""
    names = [run["name"] for run in runs]
    for index, run in enumerate(runs):
        if names.count(run["name"]) > 1:
            run["name"] = f"{names[index]} ({names[: index + 1].count(names[index])})"
