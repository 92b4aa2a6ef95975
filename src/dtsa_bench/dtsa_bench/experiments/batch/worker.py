"""What a worker process does: a few runs one after the other. Imports no figures."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Sequence

from .task import Row, Task, Work

_WATCH_S = 0.5


def run_chunk(work: Work, tasks: Sequence[Task]) -> tuple[str, list[Row]]:
    """Does some runs one after the other.

    :param work: how a run is done.
    :param tasks: the runs.
    :returns: digest of this worker's code, and a row for each run.
    """
    return work.code(), [work.run(task) for task in tasks]


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
