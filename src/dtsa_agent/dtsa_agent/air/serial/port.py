"""A modem on a serial line as the port of an agent, and what listens by one."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

from dtsa_agent.air import _queue
from dtsa_agent.air.port import Datagram
from dtsa_agent.core.errors import ConfigError

from .device import Device, DeviceError
from .frames import LineReader, to_line
from .settings import SerialSettings

_PATIENCE_S = 0.1  # an end is noticed after this time at the latest
_END_S = 2.0  # a device that hangs ends with the process
_LOOK_S = 0.5  # between two looks whether a device that has gone is back
_SAID = 8  # own datagrams that are remembered: a modem that echoes gives them back at once
_GONE = "the device is not there"
_MUCH_GARBLED = 2_000  # bytes, without one datagram among them
_MAVLINK = (0xFD, 0xFE)  # first bytes of its messages
_LATENCY_MS = 2  # an adapter may keep bytes for so long


class SerialPort:
    """See the module; a :class:`~dtsa_agent.air.port.DatagramPort` and a :class:`~dtsa_agent.air.port.Listener`.

    A thread reads the device. One that is unplugged is used again when it is back.

    :param settings: which device, its speed and its modem.
    :raises ConfigError: if it cannot be used.
    """

    def __init__(self, settings: SerialSettings) -> None:
        self.properties = settings.properties
        self.say: Callable[[str], None] | None = None  # is told a line when the device goes, and when it is back
        self._settings, self._byte_ns = settings, settings.line_byte_ns
        self.compiled = _queue.open_queue()
        self._device: Device | None = Device(settings.device, settings.baud)
        self._lock = threading.Lock()  # the thread that reads closes the device, another one writes to it
        self._reader = LineReader()
        self._said: deque[bytes] = deque(maxlen=_SAID)
        self._unplugged = self._echoes = self._datagrams = 0
        self._clean = (0, 0)  # datagrams, and garbled bytes when the last of them came
        self._mavlink = 0  # pieces that may be its messages
        self._told: set[str] = set()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="serial", daemon=True)
        self._thread.start()

    def fileno(self) -> int:
        """For ``select``: readable when something has arrived."""
        return _queue.descriptor(self.compiled)

    def send(self, data: bytes) -> str:
        """Hands a datagram to the device; why that was not possible, or an empty text.

        :param data: the datagram.
        """
        with self._lock:
            if self._device is None:
                return _GONE
            try:
                self._said.append(data)  # before: an echo may be quicker than this thread
                self._device.write(to_line(data))
            except DeviceError as error:
                return str(error)
        return ""

    def receive(self, most: int) -> list[Datagram]:
        """What has arrived, in this order; empty if nothing has.

        :param most: unused: 16 datagrams at most come at a time.
        """
        return [Datagram(*one) for one in _queue.get(self.compiled)]

    def counts(self) -> dict[str, int]:
        """What came that was no datagram, what the modem gave back, and how often the device was unplugged."""
        return {
            "garbled_pieces": self._reader.garbled,
            "garbled_bytes": self._reader.garbled_bytes,
            "echoes": self._echoes,
            "dropped_by_computer": _queue.overflowed(self.compiled),
            "times_unplugged": self._unplugged,
        }

    # -- the thread that reads --------------------------------------------------------------------------------------
    def _run(self) -> None:
        while not self._stopped.is_set():
            device = self._device
            if device is None:
                if not self._stopped.wait(_LOOK_S):
                    self._come_back()
                continue
            self._say_latency(device)
            try:
                while not self._stopped.is_set():
                    chunk = device.read(_PATIENCE_S)
                    if chunk:
                        self._take(chunk, time.monotonic_ns())
            except DeviceError as error:
                self._go(device, str(error))

    def _take(self, chunk: bytes, now_ns: int) -> None:
        self._mavlink += sum(chunk.count(first) for first in _MAVLINK)
        for datagram, after in self._reader.feed(chunk):
            own = datagram in self._said
            self._echoes += own
            self._datagrams += 1
            # The bytes after it in the same piece have taken their time on the line.
            _queue.put(self.compiled, datagram, now_ns - after * self._byte_ns, own)
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
                " /sys/class/tty, see docs/how-to/serial-modems.md",
            )

    def _go(self, device: Device, why: str) -> None:
        with self._lock:  # nobody writes to it any more
            self._device = None
        device.close()  # this may take its time: no agent waits for it
        self._unplugged += 1
        self._tell(f"has gone ({why}): no frame leaves or arrives until it is back")

    def _come_back(self) -> None:
        try:
            device = Device(self._settings.device, self._settings.baud)
        except ConfigError:  # not yet
            return
        with self._lock:
            self._device = device
        self._tell("is back")

    def _tell_once(self, key: str, what: str) -> None:
        if self.say is not None and key not in self._told:
            self._told.add(key)
            self._tell(what)

    def _tell(self, what: str) -> None:
        if self.say is not None:
            self.say(f"device {self._settings.device} {what}")

    def close(self) -> None:
        """Ends the thread; the device is free for others."""
        self._stopped.set()
        self._thread.join(_END_S)
        if self._device is not None:
            self._device.close()
            self._device = None

    def __enter__(self) -> SerialPort:
        return self

    def __exit__(self, *unused: object) -> None:
        self.close()
