"""Does the runs of a plan: in this process, on all cores, or on a Dask cluster. Finished rows are kept at once."""

from __future__ import annotations

import contextlib
import os
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from dtsa_agent.core.errors import DtsaError

from .cluster import run_on_cluster
from .journal import Journal
from .task import Plan, Row, Task, Work
from .worker import live_with_the_parent, run_chunk

Chunk = list[Task]
Progress = Callable[[int, float], None]  # runs and cost done since the last call
CHUNK_COST = 250_000.0  # about a quarter of a second of one core
RESTARTS = 3  # how often dead worker processes are replaced before a batch gives up


def run_all(
    plan: Plan,
    work: Work,
    journal: Journal | None = None,
    *,
    jobs: int | None = 1,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> dict[str, Row]:
    """Does the runs that the journal does not have yet.

    :param plan: all runs.
    :param work: how a run is done.
    :param journal: of the plan; gets every row as soon as it is there. None: rows are kept in memory alone.
    :param jobs: number of processes on this machine; None: one a core.
    :param cluster: address of a Dask scheduler (``tcp://HOST:PORT``) instead.
    :param progress: called after every chunk.
    :returns: all rows by key.
    :raises ConfigError: if the cluster cannot be used.
    :raises DtsaError: if worker processes keep dying, or the code changes meanwhile.
    """
    rows = {} if journal is None else journal.rows()
    known = work.code() if journal is None else journal.code
    tasks = [task for task in plan.tasks() if task.key not in rows]
    # All settings with few seeds before few settings with all seeds; the longest runs of a seed first.
    tasks.sort(key=lambda task: (task.seed, -task.cost))
    costs = {task.key: task.cost for task in tasks}
    workers = len(os.sched_getaffinity(0)) if jobs is None else jobs
    with contextlib.closing(_results(tasks, work, workers, cluster)) as results:
        for code, chunk in results:
            if code != known:
                where = "on the cluster" if cluster else "on this machine while the batch ran"
                raise DtsaError(
                    f"the code is another one {where} ({code}, not {known}): nothing is mixed; finished runs are saved"
                )
            if journal is not None:
                journal.append(chunk)
            rows.update((row["key"], row) for row in chunk)
            if progress is not None:
                progress(len(chunk), sum(costs[row["key"]] for row in chunk))
    return rows


def chunks_of(tasks: Sequence[Task], workers: int, largest: float | None = None) -> list[Chunk]:
    """Runs bundled so that handing them over costs little and all workers stay busy to the end.

    :param tasks: the runs.
    :param workers: number of workers.
    :param largest: largest cost of a bundle, in us of a core; None: CHUNK_COST.
    """
    fair = sum(task.cost for task in tasks) / (4.0 * max(1, workers))
    limit = min(CHUNK_COST if largest is None else largest, fair)
    chunks: list[Chunk] = []
    filled = 0.0
    for task in tasks:
        if not chunks or filled + task.cost > limit:
            chunks.append([])
            filled = 0.0
        chunks[-1].append(task)
        filled += task.cost
    return chunks


Results = Iterator[tuple[str, list[Row]]]


def _results(tasks: list[Task], work: Work, jobs: int, cluster: str | None) -> Any:
    if cluster is not None:
        return run_on_cluster(tasks, work, cluster, chunks_of)
    return _on_cores(tasks, work, jobs) if jobs > 1 and len(tasks) > 1 else _here(tasks, work)


def _here(tasks: list[Task], work: Work) -> Results:
    for chunk in chunks_of(tasks, 1):
        yield run_chunk(work, chunk)


def _on_cores(tasks: list[Task], work: Work, jobs: int) -> Results:
    """In worker processes; a worker that dies costs its chunk, which is done again."""
    from joblib import Parallel, delayed
    from joblib.externals.loky.process_executor import BrokenProcessPool

    left = {task.key: task for task in tasks}
    largest: float | None = None
    with _worker_processes():
        for _ in range(RESTARTS + 1):
            chunks = chunks_of(list(left.values()), jobs, largest)
            parallel = Parallel(
                n_jobs=jobs,
                backend="loky",
                return_as="generator_unordered",
                batch_size=1,
                pre_dispatch="3 * n_jobs",
                initializer=live_with_the_parent,
                initargs=(os.getpid(),),
            )
            with contextlib.closing(parallel(delayed(run_chunk)(work, chunk) for chunk in chunks)) as results:
                try:
                    for result in results:
                        for row in result[1]:
                            left.pop(row["key"])
                        yield result
                except BrokenProcessPool:
                    # One run at a time, so that it costs others nothing if one of them kills its worker.
                    largest = 1.0
                    continue
            return
        raise DtsaError(
            f"worker processes died {RESTARTS + 1} times; {len(left)} runs are missing, all others are "
            "saved (out of memory? try fewer --jobs); the same command goes on from there"
        )


@contextlib.contextmanager
def _worker_processes() -> Iterator[None]:
    """Ends joblib's workers at the end, and keeps it quiet when an interrupted batch gives up what is under way.

    It would warn of the runs given up, and its own thread may stumble over work that has been withdrawn.
    """
    from joblib.externals.loky import get_reusable_executor

    before = threading.excepthook

    def hook(args: threading.ExceptHookArgs) -> None:
        if args.thread is None or not args.thread.name.startswith("ExecutorManagerThread"):
            before(args)

    threading.excepthook = hook
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            yield
        finally:
            get_reusable_executor().shutdown(wait=True)
            threading.excepthook = before
