"""Priority of processes and threads: bridge, agents and simulated channel run before ordinary processes.

A Crazyflie levels out half a second after the last packet, and its emergency watchdog stops motors after one second.
On a busy computer an ordinary process may have to wait for that long. All agents need the simulated channel in every
slot: it runs before the agents. Functions that return a text return why they failed, and an empty text on success.
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
    """Priority of a node's process."""

    priority: int = setting(
        0, "in real time: real-time priority of this process, where allowed; 0: none", minimum=0, maximum=90
    )


def _for_all_threads(apply: Callable[[int], None]) -> None:
    for task in Path("/proc/self/task").iterdir():
        with suppress(ProcessLookupError):  # a thread that has ended meanwhile
            apply(int(task.name))


def set_realtime(level: int, inherited: bool = True) -> str:
    """Run all threads of this process at real-time priority (SCHED_RR).

    :param level: 1 (low) to 99; 0: ordinary.
    :param inherited: whether processes and threads that they start have the same priority.
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
    """Run this thread, but not its children, at real-time priority (SCHED_RR) within the context; yield why it failed.

    :param level: 1 (low) to 99; 0: unchanged.
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
    """Set the nice level of all threads of this process, and of those that they start.

    :param nice: 0 (ordinary) to 19 (last); below 0, down to -20, only with the privilege to raise priority.
    """
    try:
        _for_all_threads(lambda task: os.setpriority(os.PRIO_PROCESS, task, nice))
    except OSError as error:
        return f"{error.strerror}; see ulimit -e"
    return ""


def set_realtime_or_nice(priority: int, nice: int, inherited: bool = True) -> str:
    """Set real-time priority if this process is allowed to, else a nice level."""
    if priority and not set_realtime(priority, inherited):
        return ""
    return set_nice(nice) if nice else ""


def set_ordinary_thread() -> None:
    """Return this thread to ordinary priority; the others keep theirs."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def use_last_processor() -> None:
    """Keep all threads of this process, and those that they start, on the last processor that it may use.

    Only one thread of a Python interpreter runs at a time, and threads on several processors wait for each other: a
    bridge of twelve Crazyflies would need half as much time again. Only sensible with real-time priority.
    """
    last = max(os.sched_getaffinity(0))
    _for_all_threads(lambda task: os.sched_setaffinity(task, {last}))


def avoid_last_processor() -> None:
    """Keep all threads of this process, and those that they start, off the processor that a bridge uses."""
    allowed = os.sched_getaffinity(0)
    if len(allowed) > 1:
        _for_all_threads(lambda task: os.sched_setaffinity(task, allowed - {max(allowed)}))


def wake_precisely() -> None:
    """Ask Linux not to delay this thread's timers by its usual 50 us."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, _SLACK_NS, 0, 0, 0)
