"""Files for a paper from a sweep: figures, a table in LaTeX, and the numbers. Each says how it was made."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from dtsa_agent.core.errors import ConfigError
from dtsa_bench import __version__
from dtsa_bench.drawing.style import save_described
from dtsa_bench.runs.options import write_whole

from .charts import draw
from .provenance import read_provenance
from .sweep import CRASHED, MEASURES, Sweep, is_number
from .tables import SweepTable, latex_table

FORMATS = ("pdf", "svg", "png")


def check_format(form: str) -> None:
    """Raise ConfigError unless figures can be written in this format."""
    if form not in FORMATS:
        raise ConfigError("paper", form, ", ".join(FORMATS))


def write_paper(table: SweepTable, directory: Path, form: str, code: str, command: str) -> list[str]:
    """Write figures, `table.tex` (booktabs), `table.csv` (a row a group) and `table.json` (how all was made).

    Figures and the LaTeX table hold how they were made in themselves: `code`, a digest, and `command`. A CSV file has
    no place for it that all readers skip. Return the names of the files.

    :raises ConfigError: for another format, or a directory that cannot be made.
    """
    check_format(form)
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError("out", str(directory), f"a directory that can be made ({error.strerror})") from error
    sweep, origin = table.sweep, _origin(table, code, command)
    comments = [f"{name}: {text}" for name, text in origin.items()]
    names = []
    for spec in _figures(sweep):
        path = directory / f"{spec['name']}.{form}"
        title = f"{sweep.title}: {spec['name']}"
        save_described(draw(table, spec), path, title, "; ".join(comments), f"dtsa {__version__}")
        names.append(path.name)
    # Crashes, ages, and what the sweep's figures show; of a sweep without figures, distances.
    shown = [name for spec in sweep.figures for name in spec.get("y", ())] or ["min_distance_m"]
    measures = table.measured([name for name in dict.fromkeys(("age_mean_slots", *shown)) if name in MEASURES])
    write_whole(directory / "table.tex", latex_table(table, [CRASHED, *measures], comments))
    frame = table.groups_frame()
    write_whole(directory / "table.csv", frame[frame["runs"] > 0].to_csv(index=False, na_rep="nan"))
    content = {**origin, "seeds": list(sweep.seeds), "settings": sweep.spec.to_dict()}
    write_whole(directory / "table.json", json.dumps(content, indent=1, default=str) + "\n")
    return [*names, "table.tex", "table.csv", "table.json"]


def _origin(table: SweepTable, code: str, command: str) -> dict[str, str]:
    """How it was made, by name."""
    sweep, provenance = table.sweep, read_provenance()
    changed = ", with changes" if provenance["tree_changed"] else ""
    return {
        "sweep": f"{sweep.name}, {len(table.rows)} flights, {len(sweep.cells)} settings",
        "command": command,
        "seeds": seeds_text(sweep.seeds),
        "written": str(provenance["date"]),
        "commit": f"{provenance['commit']}{changed}",
        "code": f"{code} (digest of the code that flew)",
        "versions": f"dtsa {__version__}, Python {provenance['python']}, NumPy {np.__version__}, "
        f"Matplotlib {matplotlib.__version__}",
    }


def seeds_text(seeds: Sequence[int]) -> str:
    """Return seeds in words: from the first to the last where none is left out."""
    if len(seeds) > 2 and list(seeds) == list(range(seeds[0], seeds[0] + len(seeds))):
        return f"{seeds[0]} to {seeds[-1]}"
    return ", ".join(map(str, seeds))


def _figures(sweep: Sweep) -> Sequence[Mapping[str, Any]]:
    """The sweep's own figures; of one that names none, crashes and ages over its first axis of numbers."""
    if sweep.figures:
        return sweep.figures
    axes, y = list(sweep.axes), [CRASHED, "age_mean_slots"]
    x = next((axis for axis in axes if _numbers([cell.labels[axis] for cell in sweep.cells])), None)
    others = [axis for axis in axes if axis != (axes[0] if x is None else x)]
    roles = dict(zip(("series", "facets"), others, strict=False))
    if x is not None and len(others) <= 2:
        return [{"kind": "lines", "name": "lines", "x": x, "y": y, **roles}]
    return [{"kind": "bars", "name": "bars", "x": axes[0], "y": y, **roles}] if x is None and len(others) <= 1 else []


def _numbers(levels: Sequence[object]) -> bool:
    return len(set(levels)) > 1 and all(map(is_number, levels))
