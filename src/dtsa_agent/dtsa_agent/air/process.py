"""How exactly and how soon a waiting thread is woken, and what it leaves to others meanwhile."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_PR_SET_TIMERSLACK = 29
_SLACK_NS = 1_000


def wake_precisely() -> None:
    """Asks Linux not to delay this thread's timers by its usual 50 us; where that is not possible nothing changes."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, _SLACK_NS, 0, 0, 0)


@contextmanager
def going_first(level: int) -> Iterator[str]:
    """Lets this thread run before everything ordinary (SCHED_RR) until the end of the context; not what it starts.

    Yields why not, or an empty text.

    :param level: 1 (low) to 99; 0: as it is.
    """
    before, problem = (os.sched_getscheduler(0), os.sched_getparam(0)), ""
    if level:
        try:
            os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(level))
        except OSError as error:
            problem = f"{error.strerror}; see ulimit -r"
    try:
        yield problem
    finally:
        if level and not problem:
            with suppress(OSError):
                os.sched_setscheduler(0, *before)
