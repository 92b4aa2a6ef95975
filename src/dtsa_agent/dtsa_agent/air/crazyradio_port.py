"""A Crazyradio 2.0 as the port of an agent: broadcasts between Crazyflies, with the dongle's times of arrival."""

from __future__ import annotations

import time
from pathlib import Path

from dtsa_agent.priority import realtime_thread

from .crazyradio_dongle import PacketReader, SnifferDongle, broadcast, datagram_in
from .device_port import DevicePort
from .settings import CrazyradioSettings

_US, _SECOND = 1_000, 1_000_000_000
_COUNTS_NS = _SECOND  # from one question for the dongle's counts to the next
_PRIORITY = 20
_TURN_US = 1 << 32  # after 71.6 minutes a stamp starts at 0 again
_LEAK = 10_000  # the map may be late by a 10,000th more with each ns: clocks of crystals differ by less
_LATEST_NS = 60 * _SECOND  # later than this nothing is read: the longest sleep of a process
_EARLIEST_NS = _SECOND  # the map does not move towards earlier arrivals by more than this at once: the first was late
_FIT_NS = 10_000_000  # stamps fit each other to this
_ODD = 3  # stamps in a row that fit each other and not the map: the dongle was restarted
_WINDOW = 64  # packets, of which one at least is read without delay


class DongleClock:
    """Turns stamps of a dongle, 32 bits of microseconds, into CLOCK_MONOTONIC.

    USB is never early. So the shortest time between a stamp and its arrival tells how far the clocks are apart, and how
    much later another packet arrived does not matter. That shortest time itself counts as part of a packet's flight.
    """

    def __init__(self) -> None:
        self._ahead_ns: int | None = None  # the computer's clock, of the dongle's; None: nothing is known
        self._last_ns = 0  # when that was known
        self._odd_ns = 0  # how far it is ahead by the last stamp that did not fit
        self._odd = 0  # how many of these came in a row
        self._least_ns, self._count = _LATEST_NS, 0  # smallest delay of the packets in this window, and their number
        self.unusable = 0  # stamps

    def arrival_ns(self, stamp_us: int, read_ns: int) -> int:
        """When a packet was whole, CLOCK_MONOTONIC, ns; when it was read (ns), if its stamp tells nothing."""
        if self._ahead_ns is None:
            self._ahead_ns, self._last_ns = read_ns - stamp_us * _US, read_ns
            return read_ns
        drift = max(read_ns - self._last_ns, 0) // _LEAK
        ahead = self._ahead_ns + drift
        turns = ((read_ns - ahead) // _US - stamp_us + _TURN_US // 2) // _TURN_US
        now_ahead = read_ns - (stamp_us + turns * _TURN_US) * _US
        late = now_ahead - ahead
        if not -_EARLIEST_NS - 2 * drift < late < _LATEST_NS:
            self._odd = self._odd + 1 if abs(now_ahead - self._odd_ns) < _FIT_NS else 1
            self._odd_ns = now_ahead
            if self._odd < _ODD:
                self.unusable += 1
            else:
                self._ahead_ns, self._last_ns = now_ahead, read_ns
            return read_ns
        self._odd = 0
        self._ahead_ns, self._last_ns = min(ahead, now_ahead) + self._bias_ns(late), read_ns
        return read_ns - max(late, 0)

    def _bias_ns(self, late_ns: int) -> int:
        """How much too early all packets seem to arrive since a wrong stamp."""
        self._least_ns, self._count = min(self._least_ns, late_ns), self._count + 1
        if self._count < _WINDOW:
            return 0
        least, self._least_ns, self._count = self._least_ns, _LATEST_NS, 0
        return least if least > _FIT_NS else 0


class CrazyradioPort(DevicePort[SnifferDongle]):
    """A Crazyradio; see :class:`~dtsa_agent.air.device_port.DevicePort`.

    :raises ConfigError: if it cannot be used.
    """

    def __init__(self, settings: CrazyradioSettings) -> None:
        self._settings = settings
        self._others = self._dropped = self._dropped_before = self._garbled = self._unusable = 0
        super().__init__(f"dongle {settings.uri}", "dongle", settings.properties)

    def counts(self) -> dict[str, int]:
        """Return what the dongle has lost, what else was on the air, and how often it was unplugged."""
        return {
            "dropped_by_dongle": self._dropped_before + self._dropped,
            "dropped_by_computer": self.overflowed,
            "other_packets": self._others,
            "garbled_transfers": self._garbled,
            "strange_stamps": self._unusable,
            "times_unplugged": self.unplugged,
        }

    def _run(self) -> None:
        with realtime_thread(_PRIORITY):  # as agents do: what they wait for comes by this thread
            super()._run()

    def _open(self) -> SnifferDongle:
        if not self._settings.simulated_radio:
            return SnifferDongle(self._settings)
        from .crazyradio_simulated import simulated_dongles

        return SnifferDongle(self._settings, simulated_dongles(Path(self._settings.simulated_radio)))

    def _write(self, device: SnifferDongle, data: bytes) -> None:
        device.write(broadcast(data, self._settings.p2p_port))

    def _read(self, device: SnifferDongle) -> None:
        reader, clock = PacketReader(), DongleClock()
        garbled, unusable, counts_due_ns = self._garbled, self._unusable, 0
        while not self._stopped.is_set():
            data = device.read()
            now = time.monotonic_ns()
            for packet in reader.feed(data):
                arrival_ns = clock.arrival_ns(packet.stamp_us, now)
                datagram = datagram_in(packet.payload, self._settings.p2p_port)
                if datagram is None:
                    self._others += 1
                else:
                    self._queue(datagram, arrival_ns, False)
            if now >= counts_due_ns:
                counts_due_ns = now + _COUNTS_NS
                self._dropped = device.dropped()
                self._garbled, self._unusable = garbled + reader.garbled, unusable + clock.unusable

    def _lost(self) -> None:
        self._dropped_before, self._dropped = self._dropped_before + self._dropped, 0
