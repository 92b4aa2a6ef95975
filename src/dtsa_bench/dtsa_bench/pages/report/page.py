"""Puts a report together: data, scripts and style in one HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import REASON_TEXTS
from dtsa_bench.log.bag.errors import BagError
from dtsa_bench.pages.html import PALETTE, SCRIPTS, render_page, write_page

from .data import run_data

MOST = 8  # runs side by side


def render(runs: Sequence[dict[str, Any]]) -> str:
    """The page of what `run_data` gave for each run."""
    title = " · ".join(run["name"] for run in runs) + " – DTSA report"
    data = {"runs": list(runs), "palette": PALETTE, "reasons": dict(REASON_TEXTS)}
    return render_page("report", title, (*SCRIPTS, "report.js"), data)


def write_report(bags: Sequence[str | Path], out: str | Path, progress: Callable[[str], None] | None = None) -> Path:
    """Write the report of one bag, or of several side by side.

    :param bags: one to eight bags.
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
    _number_equal_names(runs)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_page(target, render(runs))
    except OSError as error:
        raise BagError(f"cannot write {target}: {error.strerror or error}") from error
    return target


def _number_equal_names(runs: list[dict[str, Any]]) -> None:
    names = [run["name"] for run in runs]
    for index, run in enumerate(runs):
        if names.count(run["name"]) > 1:
            run["name"] = f"{names[index]} ({names[: index + 1].count(names[index])})"
