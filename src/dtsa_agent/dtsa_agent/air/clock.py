"""The clock of one agent: the computer's CLOCK_MONOTONIC, bent in trials."""

from __future__ import annotations

import time

_PPB = 1_000_000_000


class OwnClock:
    """What an agent's clock shows.

    :param offset_ns: ns, by how much it is ahead of CLOCK_MONOTONIC when it is made.
    :param drift_ppb: ppb (parts per billion) by which it runs fast.
    """

    __slots__ = ("_began", "_drift", "_offset")

    def __init__(self, offset_ns: int = 0, drift_ppb: int = 0) -> None:
        self._began, self._offset, self._drift = time.monotonic_ns(), offset_ns, drift_ppb

    def local_ns(self, monotonic_ns: int) -> int:
        """What it shows at a time, ns.

        :param monotonic_ns: ns, CLOCK_MONOTONIC.
        """
        return monotonic_ns + self._offset + (monotonic_ns - self._began) * self._drift // _PPB

    def monotonic_ns(self, local_ns: int) -> int:
        """When it shows a time, ns, CLOCK_MONOTONIC, to 2 ns.

        :param local_ns: ns, what it shows.
        """
        elapsed = local_ns - self._offset - self._began
        return self._began + elapsed - elapsed * self._drift // (_PPB + self._drift)
