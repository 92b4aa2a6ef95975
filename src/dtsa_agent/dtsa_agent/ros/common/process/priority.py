"""Process priority: what flies vehicles, or is the air of all others, does not wait for what else there is to do.

A Crazyflie levels out when it has heard nothing for half a second, and its emergency watchdog stops the motors after
one second. On a busy station an ordinary process can be kept waiting for that long. The simulated channel is needed by
all agents in every slot: it goes first, agents give way to it.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dtsa_agent.core.settings.declaration import Settings, setting


@dataclass(frozen=True, slots=True)
class PrioritySettings(Settings):
    """Which processes go first on a computer."""

    priority: int = setting(
        0, "in real time: real-time priority of this process, where allowed; 0: none", minimum=0, maximum=90
    )


def take_priority(level: int, inherited: bool = True) -> str:
    """Let all threads of this process run before everything ordinary (SCHED_RR); return why not, or an empty text.

    ``level``: 1 (low) to 99, 0: ordinary; ``inherited``: what they start does so, too.
    """
    policy = os.SCHED_RR if level else os.SCHED_OTHER
    if level and not inherited:
        policy |= os.SCHED_RESET_ON_FORK
    try:
        _for_all_threads(lambda task: os.sched_setscheduler(task, policy, os.sched_param(level)))
    except OSError as error:
        return f"{error.strerror}; see ulimit -r"
    return ""


def stay_on_one_processor() -> None:
    """Keep all threads of this process, and those that they start, on the last processor that it may use.

    Only one thread of an interpreter runs at a time. Threads that wake on several processors at once wait for each
    other there: a bridge of twelve Crazyflies takes half as much again. Only sensible with real-time priority: others
    leave that processor to it.
    """
    last = max(os.sched_getaffinity(0))
    _for_all_threads(lambda task: os.sched_setaffinity(task, {last}))


def leave_that_processor() -> None:
    """Keeps all threads of this process, and all that they start, off the processor on which a bridge stays."""
    allowed = os.sched_getaffinity(0)
    if len(allowed) > 1:
        _for_all_threads(lambda task: os.sched_setaffinity(task, allowed - {max(allowed)}))


def _for_all_threads(act: Callable[[int], None]) -> None:
    for task in Path("/proc/self/task").iterdir():
        with contextlib.suppress(ProcessLookupError):  # a thread that has ended meanwhile
            act(int(task.name))


def give_way() -> None:
    """This thread alone is ordinary again."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def give_way_by(nice: int) -> str:
    """Let all threads of this process, and those that they start, give way to others; return why not, or nothing.

    ``nice``: 0 (ordinary) to 19 (gives way to all); down to -20 with the right to go first. It counts among the
    processes of one session: Linux shares the processor between sessions before it looks at it.
    """
    try:
        _for_all_threads(lambda task: os.setpriority(os.PRIO_PROCESS, task, nice))
    except OSError as error:
        return f"{error.strerror}; see ulimit -e"
    return ""


def take_place(priority: int, nice: int, inherited: bool = True) -> str:
    """Take real-time priority where this process may have it, else a nice level; return why neither, or nothing."""
    if priority and not take_priority(priority, inherited):
        return ""
    return give_way_by(nice) if nice else ""
