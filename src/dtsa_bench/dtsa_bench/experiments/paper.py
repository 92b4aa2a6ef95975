"""What a paper takes from a sweep: figures, a table in LaTeX, and the numbers. Each says how it was made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from dtsa_agent.core.errors import ConfigError
from dtsa_bench import __version__
from dtsa_bench.drawing.style import save_described
from dtsa_bench.experiments.batch.made_with import made_with
from dtsa_bench.experiments.batch.table import write_results, write_whole
from dtsa_bench.experiments.figures.drawn import draw
from dtsa_bench.experiments.sweep.aggregate import CRASHED, MEASURES, Table
from dtsa_bench.experiments.sweep.latex import latex_table
from dtsa_bench.experiments.sweep.spec import Sweep

FORMATS = ("pdf", "svg", "png")


def check_format(form: str) -> None:
    """Raises ConfigError unless figures can be written in this format.

    :param form: one of `FORMATS`.
    :raises ConfigError: for another one.
    """
    if form not in FORMATS:
        raise ConfigError("paper", form, ", ".join(FORMATS))


def write_paper(table: Table, directory: Path, form: str, code: str, command: str) -> list[str]:
    """Writes figures, `table.tex` (booktabs), `table.csv` (a row a group) and `table.json` (how all was made).

    Figures and the LaTeX table hold how they were made in themselves; a CSV file has no place for it that all readers
    skip.

    :param table: the sweep's groups.
    :param directory: where; made if needed.
    :param form: of the figures, one of `FORMATS`.
    :param code: digest of the code that flew.
    :param command: how the sweep was started.
    :returns: names of the files.
    :raises ConfigError: for another format, or a directory that cannot be made.
    """
    check_format(form)
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError("out", str(directory), f"a directory that can be made ({error.strerror})") from error
    sweep, origin = table.sweep, _origin(table, code, command)
    said = [f"{name}: {text}" for name, text in origin.items()]
    names = []
    for spec in _figures(sweep):
        path = directory / f"{spec['name']}.{form}"
        title = f"{sweep.title}: {spec['name']}"
        save_described(draw(table, spec), path, title, "; ".join(said), f"dtsa {__version__}")
        names.append(path.name)
    known = {name for name in MEASURES if any(group.mean(name).count for group in table.groups)} | {CRASHED}
    measures = [name for name in _measures(sweep) if name in known]
    write_whole(directory / "table.tex", latex_table(table, measures, said))
    rows = [group.flat() for group in table.groups if group.rows]
    content = {**origin, "seeds": list(sweep.seeds), "settings": sweep.source}
    write_results(directory, "table", list(dict.fromkeys(name for row in rows for name in row)), rows, content)
    return [*names, "table.tex", "table.csv", "table.json"]


def _origin(table: Table, code: str, command: str) -> dict[str, str]:
    """How it was made, by name."""
    sweep, made = table.sweep, made_with()
    changed = ", with changes" if made["tree_changed"] else ""
    return {
        "sweep": f"{sweep.name}, {table.runs} flights, {len(sweep.cells)} settings",
        "command": command,
        "seeds": seeds_text(sweep.seeds),
        "written": str(made["date"]),
        "commit": f"{made['commit']}{changed}",
        "code": f"{code} (digest of the code that flew)",
        "versions": f"dtsa {__version__}, Python {made['python']}, NumPy {np.__version__}, "
        f"Matplotlib {matplotlib.__version__}",
    }


def seeds_text(seeds: Sequence[int]) -> str:
    """Seeds in words: from the first to the last where none is left out.

    :param seeds: the seeds.
    """
    if len(seeds) > 2 and list(seeds) == list(range(seeds[0], seeds[0] + len(seeds))):
        return f"{seeds[0]} to {seeds[-1]}"
    return ", ".join(map(str, seeds))


def _figures(sweep: Sweep) -> Sequence[Mapping[str, Any]]:
    """The sweep's own figures; of one that names none, crashes and ages over its first axis of numbers."""
    if sweep.figures:
        return sweep.figures
    axes, y = list(sweep.axes), [CRASHED, "age_mean_slots"]
    x = next((axis for axis in axes if _numbers([cell.labels[axis] for cell in sweep.cells])), None)
    rest = [axis for axis in axes if axis != (axes[0] if x is None else x)]
    roles = dict(zip(("series", "facets"), rest, strict=False))
    if x is not None and len(rest) <= 2:
        return [{"kind": "lines", "name": "lines", "x": x, "y": y, **roles}]
    return [{"kind": "bars", "name": "bars", "x": axes[0], "y": y, **roles}] if x is None and len(rest) <= 1 else []


def _numbers(levels: Sequence[object]) -> bool:
    return len(set(levels)) > 1 and all(isinstance(n, (int, float)) and not isinstance(n, bool) for n in levels)


def _measures(sweep: Sweep) -> list[str]:
    """Crashes, ages, and what the sweep's figures show; of a sweep without figures, distances."""
    shown = [name for spec in sweep.figures for name in spec.get("y", ())] or ["min_distance_m"]
    return list(dict.fromkeys((CRASHED, "age_mean_slots", *shown)))
