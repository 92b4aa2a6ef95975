"""How long the machine lets nobody run: what it takes from a reaction's limit is no fault of whoever reacts."""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable
from pathlib import Path

STILL_S = 0.25  # a machine that stands still for longer cannot fly in real time
ATTEMPTS = 4
_BEAT_S = 0.01


class Metronome:
    """Wakes a hundred times a second and notes how late it was at worst; a context manager."""

    def __init__(self) -> None:
        self.late_s = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Metronome:
        self._thread.start()
        return self

    def __exit__(self, *unused: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        before = time.monotonic()
        while not self._stop.wait(_BEAT_S):
            now = time.monotonic()
            self.late_s = max(self.late_s, now - before - _BEAT_S)
            before = now


def flown_again_when_still(test: Callable[[Path], None]) -> Callable[[Path], None]:
    """A test in real time that failed while the machine stood still says nothing: it is made again.

    :param test: takes an empty directory.
    """

    @functools.wraps(test)
    def patient(tmp_path: Path) -> None:
        for attempt in range(1, ATTEMPTS + 1):
            folder = tmp_path / str(attempt)
            folder.mkdir()
            with Metronome() as metronome:
                try:
                    test(folder)
                    return
                except AssertionError:
                    if attempt == ATTEMPTS or metronome.late_s < STILL_S:
                        raise

    return patient
