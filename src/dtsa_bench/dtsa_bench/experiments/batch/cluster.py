"""Runs on a Dask cluster.

A worker that dies costs no result: the scheduler hands its chunk to another one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from dtsa_agent.core.errors import ConfigError, DtsaError

from .task import Row, Task, Work
from .worker import run_chunk

PATIENCE_S = 20.0  # for the scheduler to answer, and for a first worker
RETRIES = 3


def run_on_cluster(
    tasks: list[Task], work: Work, address: str, chunks_of: Callable[[list[Task], int], list[list[Task]]]
) -> Iterator[tuple[str, list[Row]]]:
    """Rows of all runs, as they come.

    :param tasks: the runs.
    :param work: how a run is done.
    :param address: of the scheduler, ``tcp://HOST:PORT``.
    :param chunks_of: bundles runs for a number of workers.
    :raises ConfigError: if there is no scheduler, no worker, or workers run other code.
    """
    try:
        from distributed import Client, as_completed
    except ImportError as error:
        needed = "only with the package distributed: pip install distributed"
        raise ConfigError("cluster", address, needed) from error
    try:
        client = Client(address, timeout=PATIENCE_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        allowed = f"tcp://HOST:PORT of a running Dask scheduler ({reason})"
        raise ConfigError("cluster", address, allowed) from error
    with client:
        _check_workers(client, work, address)
        workers = sum(client.nthreads().values())
        chunks = chunks_of(tasks, workers)
        futures = [client.submit(run_chunk, work, chunk, pure=False, retries=RETRIES) for chunk in chunks]
        try:
            for future in as_completed(futures, loop=client.loop):
                try:
                    result: tuple[str, list[Row]] = future.result()
                except ConfigError:
                    raise
                except Exception as error:
                    reason = " ".join(str(error).split()) or type(error).__name__
                    raise DtsaError(
                        f"the cluster gave up on some runs ({reason}); those that came back are saved; "
                        "the same command goes on from there"
                    ) from error
                future.release()
                yield result
        finally:
            client.cancel(futures, force=True)


def _check_workers(client: Any, work: Work, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=PATIENCE_S)
    except TimeoutError as error:
        raise ConfigError(
            "cluster", address, f"a scheduler with workers (none came within {PATIENCE_S:g} s)"
        ) from error
    try:
        codes = set(client.run(work.code).values())
    except Exception as error:
        reason = " ".join(str(error).split())
        raise ConfigError("cluster", address, f"workers that can import dtsa_bench ({reason})") from error
    here = work.code()
    if codes != {here}:
        others = ", ".join(sorted(codes - {here}))
        raise ConfigError("cluster", address, f"workers that run the same code as here ({here}, not {others})")
