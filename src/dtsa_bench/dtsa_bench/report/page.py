"""Puts a report together: data, script and style in one HTML file that needs nothing else."""

from __future__ import annotations

import html
import json
import os
import re
from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import REASON_TEXTS
from dtsa_bench.bag.errors import BagError
from dtsa_bench.figures import palette
from dtsa_bench.report.data import run_data

MOST = 6  # runs that are readable side by side
_PALETTE = {
    "agents": palette.AGENT_COLOURS,
    "dashes": palette.DASHES,
    "shapes": palette.SHAPES,
    "hovering": palette.HOVERING,
    "series": palette.SERIES,
}
SCRIPTS = ("core.js", "plot.js", "scene.js", "slots.js", "page.js")


def render(runs: Sequence[dict[str, Any]]) -> str:
    """The page.

    :param runs: what `run_data` gave for each run.
    """
    assets = files("dtsa_bench.report") / "assets"
    content = {"runs": list(runs), "palette": _PALETTE, "reasons": dict(REASON_TEXTS)}
    text = json.dumps(content, separators=(",", ":"), allow_nan=False, default=str)
    # A "<" could end the script element; as an escape it means the same in JSON.
    data = text.replace("<", "\\u003c")
    page = (assets / "page.html").read_text(encoding="utf-8")
    parts = {
        "title": html.escape(_title(runs)),
        "style": (assets / "style.css").read_text(encoding="utf-8"),
        "data": data,
        "script": "\n".join((assets / name).read_text(encoding="utf-8") for name in SCRIPTS),
    }
    # In one pass: what is put in may itself look like a place to put something.
    return re.sub(r"\{\{ (\w+) \}\}", lambda match: parts[match[1]], page)


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
    temporary = target.with_name(f".{target.name}.part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(render(runs), encoding="utf-8")
        os.replace(temporary, target)
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
