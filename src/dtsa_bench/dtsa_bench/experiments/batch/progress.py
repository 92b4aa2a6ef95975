"""A batch from the command line: resumed where it stopped, with its progress on stderr, and safe to interrupt."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .journal import Journal
from .pool import run_all
from .task import Plan, Row, Work


def run_batch(
    plan: Plan, work: Work, directory: Path, *, jobs: int | None = None, cluster: str | None = None
) -> dict[str, Row]:
    """Does what a directory's journal does not have yet.

    :param plan: all runs.
    :param work: how a run is done.
    :param directory: where the journal is; made if it does not exist.
    :param jobs: number of processes on this machine; None: one a core.
    :param cluster: address of a Dask scheduler instead.
    :returns: all rows by key.
    :raises KeyboardInterrupt: on Ctrl-C and SIGTERM; what was finished is kept.
    :raises ConfigError: if the directory or the cluster cannot be used.
    :raises DtsaError: see :func:`~dtsa_bench.experiments.batch.pool.run_all`.
    """
    journal = Journal(directory, plan, work.code())
    with ending_on_signals(journal), Progress(journal) as progress:
        return run_all(plan, work, journal, jobs=jobs, cluster=cluster, progress=progress.advance)


@contextmanager
def ending_on_signals(journal: Journal) -> Iterator[None]:
    """Closes a journal at the end; on Ctrl-C and SIGTERM it says what is saved.

    :param journal: of the batch that runs.
    :raises KeyboardInterrupt: on both signals.
    """
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        yield
    except KeyboardInterrupt:
        saved = f"{len(journal.rows())} runs are saved in {journal.directory}"
        print(f"dtsa: interrupted; {saved}, the same command goes on from there", file=sys.stderr)
        raise
    finally:
        journal.close()
        signal.signal(signal.SIGTERM, before)


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


class Progress:
    """Says on stderr how far a batch is: a bar on a terminal, a line now and then elsewhere."""

    def __init__(self, journal: Journal) -> None:
        done = journal.rows()
        tasks = list(journal.plan.tasks())
        self._name = journal.plan.name
        self._total = len(tasks)
        self._done = sum(task.key in done for task in tasks)
        self._cost_left = sum(task.cost for task in tasks if task.key not in done)
        self._cost_done = 0.0
        self._begun = self._said = time.monotonic()
        if journal.put_aside:
            print(
                f"{self._name}: {journal.put_aside} runs of other code are put aside and done again",
                file=sys.stderr,
            )
        if self._done:
            print(f"{self._name}: {self._done} of {self._total} runs are there already", file=sys.stderr)
        self._bar = _bar(self._name, self._total, self._done) if sys.stderr.isatty() else None

    def __enter__(self) -> Progress:
        if self._bar is not None:
            self._bar[0].start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar[0].stop()

    def left_s(self) -> float:
        """Estimated time left, s, from the cost of the runs done and to do."""
        if not self._cost_done:
            return float("nan")
        return (time.monotonic() - self._begun) / self._cost_done * max(0.0, self._cost_left - self._cost_done)

    def advance(self, runs: int, cost: float) -> None:
        """Takes note of finished runs."""
        self._done += runs
        self._cost_done += cost
        left = self.left_s()
        if self._bar is not None:
            bar, task = self._bar
            bar.update(task, completed=self._done, left=f"{left:.0f} s left")
        elif time.monotonic() - self._said > 10.0:
            self._said = time.monotonic()
            print(f"{self._name}: {self._done} of {self._total} runs, about {left:.0f} s left", file=sys.stderr)


def _bar(name: str, total: int, done: int) -> Any:
    """The bar and its task; rich is imported on terminals alone."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
    from rich.progress import Progress as Bar

    bar = Bar(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[left]}"),
        console=Console(stderr=True),
        transient=True,
    )
    return bar, bar.add_task(name, total=total, completed=done, left="")
