"""Signals that end a process, as a flag: whoever runs ends in good order."""

from __future__ import annotations

import atexit
import faulthandler
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from types import FrameType
from typing import Any, NoReturn


@contextmanager
def in_time(limit_s: float) -> Iterator[None]:
    """What is done within takes no longer; otherwise this process says where its threads stand, and ends with code 1.

    For calls into libraries that may stand still with the interpreter's lock, so that nobody sees a signal either.

    :param limit_s: s; 0: as long as it takes.
    """
    _end_after(limit_s)
    try:
        yield
    finally:
        if limit_s:
            faulthandler.cancel_dump_traceback_later()


def _end_after(limit_s: float) -> None:
    if limit_s and sys.__stderr__ is not None:
        faulthandler.dump_traceback_later(limit_s, exit=True, file=sys.__stderr__)


def leave_at_once(code: int) -> NoReturn:
    """End this process with an exit code; to take the interpreter apart takes seconds on a busy machine."""
    try:
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)


class Stop:
    """Turns SIGINT, SIGTERM and SIGHUP into a flag, so that whoever runs ends in good order.

    Hang-ups that are ignored already, as under ``nohup``, stay so. A context manager that puts the old handlers back.

    :param patience_s: s after the first signal; a process that has not come to the end of the context by then writes
        down where each of its threads stands, and ends with exit code 1. 0: it has as long as it wants.
    """

    def __init__(self, patience_s: float = 0.0) -> None:
        self._patience_s = patience_s
        self.signal = 0  # the first one; 0: none yet
        self.count = 0  # how many have come
        self.interrupts = 0  # how many of them were Ctrl-C
        self._raises = False
        self._old: dict[int, Any] = {}

    def __enter__(self) -> Stop:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                self._old[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *unused: object) -> None:
        if self and self._patience_s:
            faulthandler.cancel_dump_traceback_later()
        for number, handler in self._old.items():
            signal.signal(number, handler)

    def __bool__(self) -> bool:
        return self.signal != 0

    def in_time(self) -> AbstractContextManager[None]:
        """What is done within has as long as the process has after a signal, whether there was one or not."""
        return in_time(self._patience_s)

    @contextmanager
    def interruptible(self) -> Iterator[None]:
        """Let a signal raise an exception within the context: imports and the creation of nodes check no flag.

        :raises KeyboardInterrupt: on a signal, or if there was one before.
        """
        if self:
            raise KeyboardInterrupt
        self._raises = True
        try:
            yield
        finally:
            self._raises = False

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if not self:
            _end_after(self._patience_s)
        self.signal = self.signal or number
        self.count += 1
        self.interrupts += number == signal.SIGINT
        if self._raises:
            self._raises = False
            raise KeyboardInterrupt


class StopToken:
    """True once something has to end: because of a signal, or for a reason that is given or found.

    :param stop: the signal flag.
    :param find_reason: gives the reason, as when a deadline has passed; empty: there is none yet.
    """

    def __init__(self, stop: Stop, find_reason: Callable[[], str] = str) -> None:
        self.stop, self.reason = stop, ""
        self._find_reason = find_reason

    def __bool__(self) -> bool:
        if not self.stop and not self.reason:
            self.reason = self._find_reason()
        return bool(self.stop) or bool(self.reason)
