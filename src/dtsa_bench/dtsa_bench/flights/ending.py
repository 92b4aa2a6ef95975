"""Why a flight ends before its time."""

from __future__ import annotations

from collections.abc import Callable

_LEAST_S, _FACTOR = 120.0, 10.0


def wall_limit_s(given: float | None, timeout_s: float) -> float:
    """How long a flight may take by the clock on the wall, s.

    :param given: s that the user allows; None: ten times the limit in simulated time, two minutes at least.
    :param timeout_s: the limit in simulated time, s.
    """
    return max(_LEAST_S, _FACTOR * timeout_s) if given is None else given


class EarlyEnd:
    """True once a flight has to end: a signal, a vehicle in trouble, or no more time.

    :param stop: the signal flag.
    :param wall_s: s of wall time that the flight may take.
    :param elapsed_s: says how many s it has taken so far.
    """

    def __init__(self, stop: object, wall_s: float, elapsed_s: Callable[[], float]) -> None:
        self.stop, self.reason = stop, ""
        self._wall_s, self._elapsed_s = wall_s, elapsed_s

    def __bool__(self) -> bool:
        if not self.reason and not self.stop and self._elapsed_s() > self._wall_s:
            self.reason = f"the flight took longer than {self._wall_s:g} s by the clock on the wall (--wall-timeout-s)"
        return bool(self.stop) or bool(self.reason)
