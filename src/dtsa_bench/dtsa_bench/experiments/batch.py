"""Many independent runs, on all cores or a Dask cluster, resumed from a journal of JSON lines."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError, DtsaError

from .provenance import code_digest

Row = dict[str, Any]
Chunk = tuple[str, list[Row]]  # digest of the code that ran, and a row a run
Chunks = Generator[Chunk, None, None]
Advance = Callable[[int, float], None]  # runs and cost done since the last call
FAILED = "failed"  # status of a run that ended with an error
CHUNK_COST = 250_000.0  # about a quarter of a second of one core
PATIENCE_S = 20.0  # for a Dask scheduler to answer, and for a first worker
_RESTARTS = 3  # how often dead worker processes are replaced before a batch gives up
_REPORT_S = 10.0  # between two lines of progress where no bar is shown


@dataclass(frozen=True, slots=True)
class Task:
    """One run, small enough to be sent anywhere."""

    key: str  # of the run's settings: equal settings, equal key
    cell: int  # index of its combination of settings
    seed: int
    settings: dict[str, Any]
    cost: float  # a rough guess of the work in it, about 1 us of a core


@dataclass(frozen=True, slots=True)
class Batch:
    """Runs that belong together, and how one of them is done."""

    name: str  # a directory of results belongs to one batch
    tasks: Sequence[Task]
    run: Callable[[Task], tuple[str, Row]]  # a module's function: returns how the run ended, and plain results
    plug_ins: frozenset[tuple[str, str]] = frozenset()  # kind and name of those that fly


def key_of(settings: Mapping[str, Any]) -> str:
    """Return a short digest of settings."""
    text = json.dumps(settings, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def attempt(task: Task, run: Callable[[Task], tuple[str, Row]]) -> Row:
    """Do one run. Any error becomes the reason in its row: one bad run never ends a batch."""
    row: Row = {"key": task.key, "seed": task.seed}
    try:
        status, summary = run(task)
    except Exception as error:
        return {**row, "status": FAILED, "reason": _text_of(error), "summary": None}
    return {**row, "status": status, "reason": "", "summary": summary}


def _text_of(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


class Journal:
    """Rows of one batch in ``runs.jsonl`` of a directory: a line a run, written when the run is finished.

    :raises ConfigError: if the directory cannot be used, or belongs to another batch.
    """

    def __init__(self, directory: Path, batch: Batch) -> None:
        code, wanted, line = code_digest(batch.plug_ins), {task.key for task in batch.tasks}, "\n"
        self.path, self._origin = directory / "runs.jsonl", {"batch": batch.name, "code": code}
        self.rows: dict[str, Row] = {}  # finished runs by key; those that failed are left out, and are tried again
        self.other_code = 0  # rows that other code made
        try:
            directory.mkdir(parents=True, exist_ok=True)
            self._file = self.path.open("a+", encoding="utf-8", errors="replace")
        except OSError as error:
            allowed = f"a directory that can be written to ({error.strerror})"
            raise ConfigError("out", str(directory), allowed) from error
        self._file.seek(0)
        for line in self._file:
            try:
                row = json.loads(line)
                batch_name, row_code, key, failed = row["batch"], row["code"], row["key"], row["status"] == FAILED
            except (ValueError, KeyError, TypeError):  # half a line
                continue
            if batch_name != batch.name:
                self.close()
                raise ConfigError("out", str(directory), f"another directory: this one holds {batch_name}")
            self.other_code += row_code != code
            if row_code == code and key in wanted and not failed:
                self.rows[key] = row
        if not line.endswith("\n"):
            self._file.write("\n")

    def append(self, rows: Iterable[Row]) -> None:
        """Write rows; they are in the file's hands when this returns.

        :raises DtsaError: if they cannot be written; those before stay.
        """
        try:
            for row in rows:
                self._file.write(json.dumps({**self._origin, **row}, separators=(",", ":")) + "\n")
                self.rows[row["key"]] = row
            self._file.flush()
        except OSError as error:
            with contextlib.suppress(OSError):  # what is left of the rows in its buffer cannot be written either
                self.close()
            raise DtsaError(f"{self.path} cannot be written ({error.strerror})") from error

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def run_in(directory: Path, batch: Batch, *, jobs: int | None = None, cluster: str | None = None) -> dict[str, Row]:
    """Do what a directory's journal does not have yet, with progress on stderr; return all rows by key.

    :raises KeyboardInterrupt: on Ctrl-C and SIGTERM; finished runs are kept.
    :raises ConfigError: if the directory or the cluster cannot be used.
    :raises DtsaError: see :func:`run_all`.
    """
    journal = Journal(directory, batch)
    if journal.other_code:
        print(f"{batch.name}: {journal.other_code} runs of other code are left aside", file=sys.stderr)
    if journal.rows:
        print(f"{batch.name}: {len(journal.rows)} of {len(batch.tasks)} runs are there already", file=sys.stderr)
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with _progress(batch, journal.rows) as advance:
            return run_all(batch, journal, jobs=jobs, cluster=cluster, advance=advance)
    except KeyboardInterrupt:
        saved = f"{len(journal.rows)} runs are saved in {directory}"
        print(f"dtsa: interrupted; {saved}, the same command goes on from there", file=sys.stderr)
        raise
    finally:
        journal.close()
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def _progress(batch: Batch, done: Mapping[str, Row]) -> Iterator[Advance]:
    """Show how far a batch is: a bar on a terminal, a line now and then elsewhere."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console, reported, count = Console(stderr=True), time.monotonic(), len(done)

    def advance(runs: int, cost: float) -> None:
        nonlocal reported, count
        count += runs
        bar.update(shown, advance=cost, description=f"{batch.name}: {count} of {len(batch.tasks)} runs")
        if not console.is_terminal and time.monotonic() - reported > _REPORT_S:
            reported = time.monotonic()
            print(f"{bar.tasks[0].description}, about {bar.tasks[0].time_remaining or 0:.0f} s left", file=sys.stderr)

    columns = TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        shown = bar.add_task(batch.name, total=sum(task.cost for task in batch.tasks if task.key not in done))
        yield advance


def run_all(
    batch: Batch,
    journal: Journal | None = None,
    *,
    jobs: int | None = 1,
    cluster: str | None = None,
    advance: Advance | None = None,
) -> dict[str, Row]:
    """Do the runs that the journal does not have yet; return all rows by key.

    They are flown in `jobs` processes here (None: one a core), or on the Dask `cluster` at ``tcp://HOST:PORT``;
    `advance` is called after every chunk.

    :raises ConfigError: if the cluster cannot be used.
    :raises DtsaError: if worker processes keep dying, or run other code.
    """
    rows, known = {} if journal is None else dict(journal.rows), code_digest(batch.plug_ins)
    # All settings with few seeds before few settings with all seeds; the longest runs of a seed first.
    tasks = sorted((t for t in batch.tasks if t.key not in rows), key=lambda task: (task.seed, -task.cost))
    costs = {task.key: task.cost for task in tasks}
    batch = Batch(batch.name, (), batch.run, batch.plug_ins)  # tasks go with the chunks
    jobs = jobs or len(os.sched_getaffinity(0))
    if cluster is not None:
        results = _on_cluster(batch, tasks, cluster)
    else:
        here = (_run_chunk(batch, chunk) for chunk in chunks_of(tasks, 1))
        results = _on_cores(batch, tasks, jobs) if jobs > 1 and len(tasks) > 1 else here
    with contextlib.closing(results):
        for code, chunk in results:
            if code != known:
                raise DtsaError(f"a worker runs other code ({code}, not {known}): its rows are not used")
            if journal is not None:
                journal.append(chunk)
            rows.update((row["key"], row) for row in chunk)
            if advance is not None:
                advance(len(chunk), sum(costs[row["key"]] for row in chunk))
    return rows


def chunks_of(tasks: Sequence[Task], workers: int) -> list[list[Task]]:
    """Bundle runs so that handing them over costs little and all workers stay busy to the end."""
    limit = min(CHUNK_COST, sum(task.cost for task in tasks) / (4.0 * max(1, workers)))
    chunks: list[list[Task]] = []
    filled = 0.0
    for task in tasks:
        if not chunks or filled + task.cost > limit:
            chunks.append([])
            filled = 0.0
        chunks[-1].append(task)
        filled += task.cost
    return chunks


def _run_chunk(batch: Batch, tasks: Sequence[Task]) -> Chunk:
    return code_digest(batch.plug_ins), [attempt(task, batch.run) for task in tasks]


def _on_cores(batch: Batch, tasks: list[Task], jobs: int) -> Chunks:
    """Yield results of worker processes; one that dies costs its chunk, which is done again, a run at a time."""
    waiting, deaths = deque(chunks_of(tasks, jobs)), 0
    idle: list[Connection] = []
    busy: dict[Any, list[Task]] = {}
    with contextlib.ExitStack() as workers:
        while waiting or busy:
            while waiting and (idle or len(busy) < jobs):
                connection = idle.pop() if idle else workers.enter_context(_worker(batch))
                busy[connection] = waiting.popleft()
                with contextlib.suppress(OSError):  # it has died: reading from it will tell
                    connection.send(busy[connection])
            for connection in wait(list(busy)):
                chunk = busy.pop(connection)
                try:
                    result = connection.recv()
                except (EOFError, OSError):
                    waiting.extend([task] for task in chunk)
                    deaths += 1
                    if deaths > _RESTARTS:
                        message = (
                            "worker processes died; runs that came back are saved (out of memory? try fewer --jobs)"
                        )
                        raise DtsaError(f"{deaths} {message}; the same command goes on from there") from None
                    continue
                idle.append(connection)
                yield result


@contextlib.contextmanager
def _worker(batch: Batch) -> Iterator[Connection]:
    """A worker process, in a session of its own, which Ctrl-C does not reach; it ends when this one has gone."""
    own_end, worker_end = Pipe()
    code = "import json, sys; sys.path[:] = json.loads(sys.argv[2]); import dtsa_bench.experiments.batch as batch; "
    words = [
        sys.executable,
        "-c",
        f"{code}batch.serve(int(sys.argv[1]))",
        str(worker_end.fileno()),
        json.dumps(sys.path),
    ]
    with own_end, worker_end:
        process = subprocess.Popen(
            words, pass_fds=[worker_end.fileno()], stdin=subprocess.DEVNULL, start_new_session=True
        )
        worker_end.close()
        try:
            with contextlib.suppress(OSError):
                own_end.send(batch)
            yield own_end
        finally:
            process.kill()
            process.wait()


def serve(descriptor: int) -> None:
    """Do what comes over a connection until it closes: all that a worker process does."""
    with Connection(descriptor) as connection, contextlib.suppress(EOFError, OSError):
        batch = connection.recv()
        while True:
            connection.send(_run_chunk(batch, connection.recv()))


def _on_cluster(batch: Batch, tasks: list[Task], address: str) -> Chunks:
    """Yield results of a Dask cluster, which repeats elsewhere what a dead worker had."""
    try:
        from distributed import Client, as_completed
    except ImportError as error:
        raise ConfigError("cluster", address, "only with Dask: pip install distributed") from error
    with contextlib.ExitStack() as stack:
        try:
            client = stack.enter_context(Client(address, timeout=PATIENCE_S, set_as_default=False))
            client.wait_for_workers(1, timeout=PATIENCE_S)
        except (OSError, ValueError, TimeoutError) as error:
            allowed = f"tcp://HOST:PORT of a Dask scheduler with workers ({_text_of(error)})"
            raise ConfigError("cluster", address, allowed) from error
        chunks = chunks_of(tasks, sum(client.nthreads().values()))
        futures = client.map(partial(_run_chunk, batch), chunks, pure=False, retries=_RESTARTS)
        stack.callback(client.cancel, futures, force=True)
        for future in as_completed(futures, loop=client.loop):
            if fault := future.exception():
                message = f"the cluster gave up on some runs ({_text_of(fault)}); those that came back are saved"
                raise DtsaError(f"{message}; the same command goes on from there") from fault
            yield future.result()
            future.release()
