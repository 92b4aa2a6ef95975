"""A watch on plug-ins: a call that does not return is ended, with the name of the part and the place in it."""

from __future__ import annotations

import ctypes
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.plugins.entry_points import uses_plugins
from dtsa_agent.core.plugins.guard import RUNNING, Call, Overdue
from dtsa_agent.core.settings.config import SwarmConfig

VARIABLE = "DTSA_PLUGIN_LIMIT_S"
LIMIT_S = 5.0  # of wall time; below the time that a channel in lockstep waits for an answer
_LOOKS = 8  # in the time of one limit
_SIGNAL = signal.SIGURG  # ignored unless somebody handles it; also ends a wait within the interpreter


@contextmanager
def watched(config: SwarmConfig) -> Iterator[None]:
    """Plug-ins that are called within, by this thread, have a limited time for each call.

    Code that never comes back to the interpreter cannot be ended. Without plug-ins this does nothing.

    :param config: names them.
    :raises ConfigError: if the limit in the environment is none.
    :raises PluginError: in the call that lasts too long.
    """
    if not uses_plugins(config):
        yield
        return
    thread, over = threading.get_ident(), threading.Event()
    main = threading.current_thread() is threading.main_thread()
    before = signal.signal(_SIGNAL, _end_call) if main else None
    watch = threading.Thread(target=_look, args=(thread, main, limit_s(), over), name="plugin-watch", daemon=True)
    watch.start()
    try:
        yield
    finally:
        over.set()
        watch.join()
        if main:
            signal.signal(_SIGNAL, before)


def limit_s() -> float:
    """The longest time for one call, s of wall time.

    :raises ConfigError: if what the environment says is no such time.
    """
    text = os.environ.get(VARIABLE, "")
    try:
        limit = float(text) if text else LIMIT_S
    except ValueError:
        limit = math.nan
    if not 0.05 <= limit <= 86_400:
        raise ConfigError(VARIABLE, text, "0.05 to 86400 s in the environment")
    return limit


def _look(thread: int, main: bool, limit: float, over: threading.Event) -> None:
    """Looks at what a thread is calling until that is over."""
    seen: Call | None = None
    since = time.monotonic()
    while not over.wait(limit / _LOOKS):
        now, running = time.monotonic(), RUNNING.get(thread)
        if running is None or running is not seen:
            seen, since = running, now
        elif now - since >= limit:
            # Said again at every further look: a bare ``except`` swallows it once.
            running.fault = f"TimeoutError: no answer within {limit:g} s{_place(thread)}"
            _interrupt(thread, main)


def _place(thread: int) -> str:
    frame = sys._current_frames().get(thread)
    return f" ({frame.f_code.co_filename}:{frame.f_lineno})" if frame else ""


def _interrupt(thread: int, main: bool) -> None:
    if main:
        with suppress(ProcessLookupError):
            signal.pthread_kill(thread, _SIGNAL)
    else:
        ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), ctypes.py_object(Overdue))


def _end_call(number: int, frame: FrameType | None) -> None:
    running = RUNNING.get(threading.get_ident())
    if running is not None and running.fault:  # else it has come back meanwhile
        raise Overdue
