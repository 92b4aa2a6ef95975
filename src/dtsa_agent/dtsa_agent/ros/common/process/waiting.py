"""Waiting for other processes: for how long, and lines on a node's logger that say so ever more seldom."""

from __future__ import annotations

import time
from typing import Any

_FIRST_S, _LONGEST_S = 2.0, 60.0  # from one line to the next
_LONGEST_LOOK_S = 0.25


class Patience:
    """For how long this process has looked for something in vain.

    Time in which it did not run (Ctrl-Z, a debugger, a frozen container) does not count: what the others have sent
    meanwhile has not reached it yet.
    """

    def __init__(self) -> None:
        self._looked_s = time.monotonic()
        self._spent_s = 0.0

    def look(self) -> float:
        """Return the s of wall time spent so far; called several times a second."""
        now = time.monotonic()
        self._spent_s += min(now - self._looked_s, _LONGEST_LOOK_S)
        self._looked_s = now
        return self._spent_s


class Waiting:
    """Logs what is waited for, at once and then with a growing period; anew when it is something else."""

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self._text = ""
        self._since_s = self._next_s = self._period_s = 0.0  # time.monotonic()

    def tell(self, text: str) -> None:
        """Log it if it is time to."""
        now = time.monotonic()
        if text != self._text:
            self._text, self._since_s, self._next_s, self._period_s = text, now, now + _FIRST_S, _FIRST_S
            self._logger.info(text)
        elif now >= self._next_s:
            self._period_s = min(2 * self._period_s, _LONGEST_S)
            self._next_s = now + self._period_s
            self._logger.warning(f"{text}, for {now - self._since_s:.0f} s now")
