"""The clock of a dongle, as a computer sees it through USB."""

from __future__ import annotations

_TURN_US = 1 << 32  # after 71.6 minutes a stamp begins anew
_US = 1_000
_SECOND = 1_000_000_000
_LEAK = 10_000  # the map may be late by a 10,000th more with each ns: clocks of crystals differ by less
_LATEST_NS = 60 * _SECOND  # later than this nothing is read: the longest sleep of a process
_JUMP_NS = 10_000_000  # the map does not move towards earlier arrivals by more than this at once
_STRANGE = 3  # stamps in a row that fit each other and not the map: the dongle has begun anew


class DongleClock:
    """Turns stamps of a dongle, 32 bits of microseconds, into CLOCK_MONOTONIC.

    USB is never early. So the shortest time between a stamp and its arrival tells how far the clocks are apart, and how
    much later another packet arrived does not matter. That shortest time itself counts as part of a packet's flight.
    """

    def __init__(self) -> None:
        self._ahead_ns: int | None = None  # the computer's clock, of the dongle's; None: nothing is known
        self._last_ns = 0  # when that was said
        self._odd_ns = 0  # how far it is ahead by the last stamp that did not fit
        self._odd = 0  # how many of these came in a row
        self.strange = 0  # stamps that could not be used

    def arrival_ns(self, stamp_us: int, read_ns: int) -> int:
        """When a packet was whole, CLOCK_MONOTONIC; when it was read, if its stamp tells nothing.

        :param stamp_us: of the dongle.
        :param read_ns: ns, when the packet was read, CLOCK_MONOTONIC.
        """
        if self._ahead_ns is None:
            self._set(read_ns - stamp_us * _US, read_ns)
            return read_ns
        ahead = self._ahead_ns + max(read_ns - self._last_ns, 0) // _LEAK
        expected_us = (read_ns - ahead) // _US
        turns = (expected_us - stamp_us + _TURN_US // 2) // _TURN_US
        now_ahead = read_ns - (stamp_us + turns * _TURN_US) * _US
        late = now_ahead - ahead
        if not -_JUMP_NS < late < _LATEST_NS:
            self._odd = self._odd + 1 if abs(now_ahead - self._odd_ns) < _JUMP_NS else 1
            self._odd_ns = now_ahead
            if self._odd < _STRANGE:
                self.strange += 1
                return read_ns
            self._set(now_ahead, read_ns)
            return read_ns
        self._odd = 0
        self._set(min(ahead, now_ahead), read_ns)
        return read_ns - max(late, 0)

    def _set(self, ahead_ns: int, now_ns: int) -> None:
        self._ahead_ns, self._last_ns = ahead_ns, now_ns
