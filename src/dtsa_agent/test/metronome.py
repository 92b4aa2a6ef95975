"""What the machine takes from those who fly in real time: that is no fault of whoever has to react in time."""

from __future__ import annotations

import functools
import os
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dtsa_agent.core.errors import DtsaError

STILL_S = 0.25  # a machine that stands still for longer cannot fly in real time,
LOAD = 2.0  # nor one with so many threads a core that want to run,
STOLEN = 0.05  # nor a virtual one that does not get so much of its cores' time
ATTEMPTS = 4
_BEAT_S = 0.01
_LOOK_BEATS = 10  # between looks at how many threads want to run


class Metronome:
    """Wakes a hundred times a second and notes how late it was at worst; a context manager."""

    def __init__(self) -> None:
        self.late_s = 0.0
        self._running: list[int] = []  # threads that wanted to run, look by look
        self._began = time.monotonic()
        self._stolen_s = _stolen_s()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    @property
    def overloaded(self) -> bool:
        """Whether nothing can be said about times."""
        # The mean of the last minute lags behind: a test may be over before it knows.
        running = sum(self._running) / max(1, len(self._running))
        cores = os.cpu_count() or 1
        stolen = (_stolen_s() - self._stolen_s) / max(0.1, time.monotonic() - self._began) / cores
        return self.late_s > STILL_S or max(running, os.getloadavg()[0]) > LOAD * cores or stolen > STOLEN

    def __enter__(self) -> Metronome:
        self._thread.start()
        return self

    def __exit__(self, *unused: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        before = time.monotonic()
        beats = 0
        while not self._stop.wait(_BEAT_S):
            now = time.monotonic()
            self.late_s = max(self.late_s, now - before - _BEAT_S)
            before = now
            beats += 1
            if beats % _LOOK_BEATS == 0:
                self._running.append(int(Path("/proc/loadavg").read_text().split()[3].partition("/")[0]))


def _stolen_s() -> float:
    """Time that a hypervisor has given to others while this machine wanted to run, s, of all cores."""
    fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()
    return int(fields[8]) / os.sysconf("SC_CLK_TCK") if len(fields) > 8 else 0.0


def flown_again_when_overloaded(test: Callable[..., None]) -> Callable[..., None]:
    """A test in real time that fails on an overloaded machine says nothing: it is made again, and skipped if need be.

    :param test: its ``tmp_path``, if it takes one, is a new directory each time.
    """

    @functools.wraps(test)
    def patient(**fixtures: Any) -> None:
        folder = fixtures.get("tmp_path")
        for attempt in range(1, ATTEMPTS + 1):
            if folder is not None:
                fixtures["tmp_path"] = folder / str(attempt)
                fixtures["tmp_path"].mkdir()
            with Metronome() as metronome:
                try:
                    test(**fixtures)
                    return
                except (AssertionError, DtsaError, subprocess.TimeoutExpired) as error:
                    if not metronome.overloaded:
                        raise
                    why = str(error).partition("\n")[0]
        pytest.skip(f"the machine is overloaded, {ATTEMPTS} attempts; the last one: {why}")

    return patient
