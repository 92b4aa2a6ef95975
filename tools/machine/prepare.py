"""The set-up: what is missing is made, step by step; what is there stays."""

from __future__ import annotations

import fcntl
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

from machine import layout, processes, wheels, workspace
from machine.layout import SetupError

PATIENCE_S = 1800.0  # for the set-up of another process; a first one takes a few minutes
POLL_S = 0.2


def ready(extras: set[str]) -> bool:
    """Whether nothing is left to do. This is all that a later start costs."""
    return wheels.has_venv() and not wheels.missing_sets(extras) and not workspace.changed_packages()


def prepare(extras: set[str]) -> None:
    """Bring the machine into the state that the commands need.

    :param extras: sets of requirements beyond those of every machine.
    :raises SetupError: when something is missing or a step fails.
    """
    if ready(extras):
        return
    signal.signal(signal.SIGTERM, interrupt)
    with lock():
        if ready(extras):  # somebody else did it while this one waited
            return
        from machine import checks

        # All that can be missing is looked for before the first directory is touched.
        checks.check()
        wheels.check_system_packages(extras)
        if layout.kind() != "none":
            workspace.colcon()
        if not wheels.has_venv():
            wheels.make_venv()
        wheels.note_interruption(extras)
        missing = wheels.missing_sets(extras)
        if missing:
            wheels.install(missing)
        changed = workspace.changed_packages()
        if changed:
            workspace.build(changed)


def interrupt(number: int, frame: object) -> None:
    """A request to end counts as Ctrl-C: the running step is ended with everything that it started."""
    raise KeyboardInterrupt


@contextmanager
def lock() -> Iterator[None]:
    """One set-up at a time in this checkout; what is left running of one that was killed is ended.

    :raises SetupError: if another one holds the lock for longer than `PATIENCE_S`.
    """
    layout.STATE.mkdir(exist_ok=True)
    with (layout.STATE / "lock").open("a+") as file:
        if not try_lock(file):
            wait_for_lock(file)
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        processes.end_orphans()
        yield


def try_lock(file: TextIO) -> bool:
    """Take the lock if it is free."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def wait_for_lock(file: TextIO) -> None:
    """Wait until the set-up of another process has ended.

    :raises SetupError: if that takes too long.
    """
    file.seek(0)
    holder = file.read().strip() or "unknown"
    print(
        f"dtsa: waiting for the set-up of process {holder}, at most {PATIENCE_S:.0f} s ...", file=sys.stderr, flush=True
    )
    deadline = time.monotonic() + PATIENCE_S
    while not try_lock(file):
        if time.monotonic() > deadline:
            raise SetupError(
                f"the set-up of process {holder} has not ended within {PATIENCE_S:.0f} s; wait for it or end it, "
                "then run the same command again"
            )
        time.sleep(POLL_S)
