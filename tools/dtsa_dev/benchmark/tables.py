"""Rows of a benchmark as text, and what machine they are from."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dtsa_bench.experiments.batch.table import aligned

Row = dict[str, Any]


def machine() -> Row:
    """The machine, and how busy it was."""
    import numpy as np

    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = (line.partition(":") for line in cpuinfo.read_text(encoding="utf-8").splitlines())
        name = next((value.strip() for key, _, value in lines if key.strip() == "model name"), name)
    return {
        "processor": name,
        "cores": len(os.sched_getaffinity(0)),
        "load": os.getloadavg()[0],
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def table_text(rows: Sequence[Row]) -> str:
    """Rows under common heads; a row lacks what does not apply to it."""
    heads = list(dict.fromkeys(key for row in rows for key in row))
    lines = [[head.replace("_", " ") for head in heads]]
    lines += [[_text(row.get(head)) for head in heads] for row in rows]
    return aligned(lines)


def _text(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"
    return str(value)
