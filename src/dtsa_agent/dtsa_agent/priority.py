"""Priority of processes and threads: what flies vehicles, or is the air of all others, goes before everything ordinary.

A Crazyflie levels out when it has heard nothing for half a second, and its emergency watchdog stops the motors after
one second. On a busy station an ordinary process can be kept waiting for that long. The simulated channel is needed by
all agents in every slot: it goes first, agents give way to it. A function that returns a text says why it failed; an
empty text: it did not.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from dtsa_agent.core.settings.declaration import Settings, setting

_PR_SET_TIMERSLACK, _SLACK_NS = 29, 1_000


@dataclass(frozen=True, slots=True)
class PrioritySettings(Settings):
    """Which processes go first on a computer."""

    priority: int = setting(
        0, "in real time: real-time priority of this process, where allowed; 0: none", minimum=0, maximum=90
    )


def _for_all_threads(act: Callable[[int], None]) -> None:
    for task in Path("/proc/self/task").iterdir():
        with suppress(ProcessLookupError):  # a thread that has ended meanwhile
            act(int(task.name))


def set_realtime(level: int, inherited: bool = True) -> str:
    """Run all threads of this process before everything ordinary (SCHED_RR), and what they start if ``inherited``.

    ``level``: 1 (low) to 99, 0: ordinary.
    """
    policy = os.SCHED_RR if level else os.SCHED_OTHER
    if level and not inherited:
        policy |= os.SCHED_RESET_ON_FORK
    try:
        _for_all_threads(lambda task: os.sched_setscheduler(task, policy, os.sched_param(level)))
    except OSError as error:
        return f"{error.strerror}; see ulimit -r"
    return ""


@contextmanager
def realtime_thread(level: int) -> Iterator[str]:
    """Run this thread, not what it starts, before everything ordinary within the context; yields why not.

    ``level``: 1 (low) to 99; 0: as it is.
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


def set_nice(nice: int) -> str:
    """Let all threads of this process, and those that they start, give way to others of the same session.

    ``nice``: 0 (ordinary) to 19 (gives way to all); down to -20 with the right to go first.
    """
    try:
        _for_all_threads(lambda task: os.setpriority(os.PRIO_PROCESS, task, nice))
    except OSError as error:
        return f"{error.strerror}; see ulimit -e"
    return ""


def set_realtime_or_nice(priority: int, nice: int, inherited: bool = True) -> str:
    """Set real-time priority where this process may have it, else a nice level."""
    if priority and not set_realtime(priority, inherited):
        return ""
    return set_nice(nice) if nice else ""


def set_ordinary_thread() -> None:
    """Take real-time priority from this thread alone."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def use_last_processor() -> None:
    """Keep all threads of this process, and those that they start, on the last processor that it may use.

    Only one thread of an interpreter runs at a time. Threads that wake on several processors at once wait for each
    other there: a bridge of twelve Crazyflies takes half as much again. Only sensible with real-time priority.
    """
    last = max(os.sched_getaffinity(0))
    _for_all_threads(lambda task: os.sched_setaffinity(task, {last}))


def avoid_last_processor() -> None:
    """Keep all threads of this process, and what they start, off the processor that a bridge uses."""
    allowed = os.sched_getaffinity(0)
    if len(allowed) > 1:
        _for_all_threads(lambda task: os.sched_setaffinity(task, allowed - {max(allowed)}))


def wake_precisely() -> None:
    """Ask Linux not to delay this thread's timers by its usual 50 us."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, _SLACK_NS, 0, 0, 0)
