"""The set-up: what is missing is made, step by step; what is there stays."""

from __future__ import annotations

import fcntl
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from machine import layout, wheels, workspace


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

        checks.check()
        if not wheels.has_venv():
            wheels.make_venv()
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
    """One set-up at a time in this checkout."""
    layout.STATE.mkdir(exist_ok=True)
    with (layout.STATE / "lock").open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            print(
                f"dtsa: waiting for the set-up of process {file.read().strip()} ...",
                file=sys.stderr,
                flush=True,
            )
            fcntl.flock(file, fcntl.LOCK_EX)
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield
