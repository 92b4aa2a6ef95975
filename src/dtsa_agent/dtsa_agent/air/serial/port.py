"""A modem on a serial line as the port of an agent, and what listens by one."""

from __future__ import annotations

import time
from collections import deque

from dtsa_agent.air.device_port import DevicePort

from .device import Device
from .frames import LineReader, to_line
from .settings import SerialSettings

_PATIENCE_S = 0.1  # an end is noticed after this time at the latest
_SAID = 8  # own datagrams that are remembered: a modem that echoes gives them back at once
_MUCH_GARBLED = 2_000  # bytes, without one datagram among them
_MAVLINK = (0xFD, 0xFE)  # first bytes of its messages
_LATENCY_MS = 2  # an adapter may keep bytes for so long


class SerialPort(DevicePort[Device]):
    """See the module, and :class:`~dtsa_agent.air.device_port.DevicePort`.

    :raises ConfigError: if it cannot be used.
    """

    def __init__(self, settings: SerialSettings) -> None:
        device = Device(settings.device, settings.baud)
        super().__init__(f"device {settings.device}", "device", settings.properties, device)
        self._settings, self._byte_ns = settings, settings.line_byte_ns
        self._reader = LineReader()
        self._said: deque[bytes] = deque(maxlen=_SAID)
        self._echoes = self._datagrams = 0
        self._clean = (0, 0)  # datagrams, and garbled bytes when the last of them came
        self._mavlink = 0  # pieces that may be its messages
        self._told: set[str] = set()
        self.begin()

    def counts(self) -> dict[str, int]:
        """What came that was no datagram, what the modem gave back, and how often the device was unplugged."""
        return {
            "garbled_pieces": self._reader.garbled,
            "garbled_bytes": self._reader.garbled_bytes,
            "echoes": self._echoes,
            "dropped_by_computer": self.overflowed,
            "times_unplugged": self._unplugged,
        }

    # -- the thread that reads --------------------------------------------------------------------------------------
    def _open(self) -> Device:
        return Device(self._settings.device, self._settings.baud)

    def _write(self, device: Device, data: bytes) -> None:
        self._said.append(data)  # before: an echo may be quicker than this thread
        device.write(to_line(data))

    def _read(self, device: Device) -> None:
        self._say_latency(device)
        while not self._stopped.is_set():
            chunk = device.read(_PATIENCE_S)
            if chunk:
                self._take(chunk, time.monotonic_ns())

    def _take(self, chunk: bytes, now_ns: int) -> None:
        self._mavlink += sum(chunk.count(first) for first in _MAVLINK)
        for datagram, after in self._reader.feed(chunk):
            own = datagram in self._said
            self._echoes += own
            self._datagrams += 1
            # The bytes after it in the same piece have taken their time on the line.
            self._put(datagram, now_ns - after * self._byte_ns, own)
            if own:
                self._tell_once("echoes", "gives back what it is given: own frames are left out")
        self._look_at_garbage()

    def _look_at_garbage(self) -> None:
        """Says what is wrong when much comes and no datagram is among it."""
        seen, garbled = self._clean
        if self._datagrams != seen:
            self._clean, self._mavlink = (self._datagrams, self._reader.garbled_bytes), 0
        elif self._reader.garbled_bytes - garbled > _MUCH_GARBLED:
            guess = "bytes of MAVLink" if self._mavlink > _MUCH_GARBLED // 100 else "another speed of the line"
            self._tell_once(
                "garbled", f"gives {_MUCH_GARBLED} bytes and no frame among them: perhaps {guess}, or another program's"
            )

    def _say_latency(self, device: Device) -> None:
        if device.latency_ms is not None and device.latency_ms > _LATENCY_MS:
            self._tell_once(
                "latency",
                f"keeps bytes for up to {device.latency_ms} ms: as root write 1 to latency_timer of the device in"
                " /sys/class/tty, see docs/how-to/radios.md",
            )

    def _tell_once(self, key: str, what: str) -> None:
        if self.say is not None and key not in self._told:
            self._told.add(key)
            self._tell(what)
