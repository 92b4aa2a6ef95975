"""How one run of a sweep is done. Imports no figures."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from ..batch.task import Row, Task, Work, attempt, code_digest
from .spec import run_config


@cache
def fingerprint() -> str:
    """A digest of the code that flies."""
    from .. import metrics, run_config, simulate

    return code_digest([Path(str(module.__file__)) for module in (metrics, run_config, simulate)])


def fly_one(task: Task) -> Row:
    """Flies one run.

    :param task: the run.
    :returns: its row; what goes wrong becomes the reason in it.
    """
    return attempt(task, _fly)


def _fly(task: Task) -> tuple[str, Row]:
    from ..simulate import simulate

    summary = simulate(run_config(task.settings)).summary()
    return summary["end"], summary


WORK = Work(fly_one, fingerprint)
