"""The clock of a dongle, as a computer sees it through USB."""

from __future__ import annotations

_TURN_US = 1 << 32  # after 71.6 minutes a stamp begins anew
_US = 1_000
_SECOND = 1_000_000_000
_LEAK = 10_000  # the map may be late by a 10,000th more with each ns: clocks of crystals differ by less
_LATEST_NS = 60 * _SECOND  # later than this nothing is read: the longest sleep of a process
_EARLIEST_NS = _SECOND  # the map does not move towards earlier arrivals by more than this at once: the first was late
_FIT_NS = 10_000_000  # stamps fit each other to this
_STRANGE = 3  # stamps in a row that fit each other and not the map: the dongle has begun anew
_WINDOW = 64  # packets, of which one at least is read without delay


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
        self._least_ns, self._seen = (
            _LATEST_NS,
            0,
        )  # how late the packets of this window were at least, and their number
        self.strange = 0  # stamps that could not be used

    def arrival_ns(self, stamp_us: int, read_ns: int) -> int:
        """When a packet was whole, CLOCK_MONOTONIC, ns; when it was read (ns), if its stamp tells nothing."""
        if self._ahead_ns is None:
            self._set(read_ns - stamp_us * _US, read_ns)
            return read_ns
        drift = max(read_ns - self._last_ns, 0) // _LEAK
        ahead = self._ahead_ns + drift
        expected_us = (read_ns - ahead) // _US
        turns = (expected_us - stamp_us + _TURN_US // 2) // _TURN_US
        now_ahead = read_ns - (stamp_us + turns * _TURN_US) * _US
        late = now_ahead - ahead
        if not -_EARLIEST_NS - 2 * drift < late < _LATEST_NS:
            self._odd = self._odd + 1 if abs(now_ahead - self._odd_ns) < _FIT_NS else 1
            self._odd_ns = now_ahead
            if self._odd < _STRANGE:
                self.strange += 1
            else:
                self._set(now_ahead, read_ns)
            return read_ns
        self._odd = 0
        self._set(min(ahead, now_ahead) + self._misled(late), read_ns)
        return read_ns - max(late, 0)

    def _misled(self, late_ns: int) -> int:
        """How much too early all packets seem to arrive since a wrong stamp."""
        self._least_ns, self._seen = min(self._least_ns, late_ns), self._seen + 1
        if self._seen < _WINDOW:
            return 0
        least, self._least_ns, self._seen = self._least_ns, _LATEST_NS, 0
        return least if least > _FIT_NS else 0

    def _set(self, ahead_ns: int, now_ns: int) -> None:
        self._ahead_ns, self._last_ns = ahead_ns, now_ns
