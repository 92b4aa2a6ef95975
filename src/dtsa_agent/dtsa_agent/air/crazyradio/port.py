"""A Crazyradio as the port of an agent, and what listens by one."""

from __future__ import annotations

import time

from dtsa_agent.air.device_port import DevicePort
from dtsa_agent.air.process import going_first

from .dongle import Dongle
from .packets import Packet, PacketReader, broadcast, datagram_in
from .settings import CrazyradioSettings
from .stamps import DongleClock

_SECOND = 1_000_000_000
_PRIORITY = 20


class CrazyradioPort(DevicePort[Dongle]):
    """See the module, and :class:`~dtsa_agent.air.device_port.DevicePort`.

    :raises ConfigError: if it cannot be used.
    """

    def __init__(self, settings: CrazyradioSettings) -> None:
        super().__init__(f"dongle {settings.uri}", "dongle", settings.properties, Dongle(settings))
        self._settings = settings
        self._others = self._dropped = self._dropped_before = self._garbled = self._strange = 0
        self.begin()

    def counts(self) -> dict[str, int]:
        """What the dongle has lost, what else was on the air, and how often it was unplugged."""
        return {
            "dropped_by_dongle": self._dropped_before + self._dropped,
            "dropped_by_computer": self.overflowed,
            "other_packets": self._others,
            "garbled_transfers": self._garbled,
            "strange_stamps": self._strange,
            "times_unplugged": self._unplugged,
        }

    # -- the thread that reads --------------------------------------------------------------------------------------
    def _run(self) -> None:
        with going_first(_PRIORITY):  # as agents do: what they wait for comes by this thread
            super()._run()

    def _open(self) -> Dongle:
        return Dongle(self._settings)

    def _write(self, device: Dongle, data: bytes) -> None:
        device.write(broadcast(data, self._settings.p2p_port))

    def _read(self, device: Dongle) -> None:
        reader, clock = PacketReader(), DongleClock()
        garbled, strange = self._garbled, self._strange
        look = 0
        while not self._stopped.is_set():
            data = device.read()
            now = time.monotonic_ns()
            for packet in reader.feed(data):
                self._take(packet, clock.arrival_ns(packet.stamp_us, now))
            if now >= look:
                look = now + _SECOND
                self._dropped = device.dropped()
                self._garbled, self._strange = garbled + reader.garbled, strange + clock.strange

    def _take(self, packet: Packet, arrival_ns: int) -> None:
        datagram = datagram_in(packet.payload, self._settings.p2p_port)
        if datagram is None:
            self._others += 1
        else:
            self._put(datagram, arrival_ns, False)

    def _lost(self) -> None:
        self._dropped_before, self._dropped = self._dropped_before + self._dropped, 0
