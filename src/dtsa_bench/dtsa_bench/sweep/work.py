"""What a worker does: flies a few runs and sends back a row of plain values for each. Imports no figures."""

from __future__ import annotations

import hashlib
import os
import signal
import threading
import time
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from .spec import Task, run_config


@cache
def fingerprint() -> str:
    """A digest of the code that flies: rows of different code are never mixed."""
    import dtsa_agent
    import dtsa_channel_sim

    from .. import metrics, run_config, simulate

    digest = hashlib.sha256()
    roots = [Path(str(package.__file__)).parent for package in (dtsa_agent, dtsa_channel_sim)]
    files = [
        *sorted((roots[0] / "core").glob("*.py")),
        *sorted((roots[0] / "core").glob("_kernel*.so")),
        *sorted(roots[1].glob("*.py")),
        *(Path(str(m.__file__)) for m in (metrics, run_config, simulate)),
    ]
    for path in files:
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def fly_chunk(tasks: Sequence[Task]) -> tuple[str, list[dict[str, Any]]]:
    """Flies some runs one after the other.

    :param tasks: the runs.
    :returns: this worker's :func:`fingerprint`, and a row for each run.
    """
    return fingerprint(), [fly_one(task) for task in tasks]


def fly_one(task: Task) -> dict[str, Any]:
    """Flies one run. Whatever goes wrong in it becomes a row with the reason: one bad run never ends a sweep.

    :param task: the run.
    """
    from ..simulate import simulate

    row: dict[str, Any] = {"key": task.key, "cell": task.cell, "seed": task.seed}
    try:
        summary = simulate(run_config(task.settings)).summary()
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        return {**row, "status": "failed", "reason": reason, "summary": None}
    return {**row, "status": summary["end"], "reason": "", "summary": summary}


_WATCH_S = 0.5


def live_with_the_parent(parent: int) -> None:
    """Called first in a worker process of this machine.

    Ctrl-C, which reaches the whole process group, is left to the parent, which ends its workers in order; and a
    worker whose parent has been killed ends itself.

    :param parent: its process id.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
