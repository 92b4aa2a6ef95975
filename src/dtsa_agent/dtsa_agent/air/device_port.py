"""A device that a thread reads, as the port of an agent: what serial modems and Crazyradios have in common."""

from __future__ import annotations

import os
import threading
from abc import abstractmethod
from collections import deque
from contextlib import suppress
from typing import Any

from dtsa_agent.core.errors import ConfigError

from .port import Port, PortProperties, ReceivedDatagram

#: What a device that has gone, or refuses what it is given, raises: errors of pyserial and of pyusb are OSErrors.
FAULTS = (OSError, NotImplementedError)
_END_S = 2.0  # a device that hangs ends with the process
_ROOM = 256  # datagrams that wait for the agent
_RETRY_S = 0.5  # from one attempt to open a device that has gone to the next


class DevicePort(Port):
    """A device; one that is unplugged is used again when it is back.

    :param name: for log lines, as "device /dev/ttyUSB0".
    :param kind: what it is, as "device".
    """

    def __init__(self, name: str, kind: str, properties: PortProperties) -> None:
        self.name, self.properties = name, properties
        self.overflowed = 0  # datagrams for which there was no room
        self.unplugged = 0  # how often the device has gone
        self._device: Any = self._open()  # None: it has gone
        self._arrived: deque[ReceivedDatagram] = deque()
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)  # readable while a datagram waits
        self._missing = f"the {kind} is not there"
        self._lock = threading.Lock()  # the thread that reads closes the device, another one writes to it
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name=kind, daemon=True)
        self._thread.start()

    @abstractmethod
    def _open(self) -> Any:
        """Open the device; ConfigError: it is not there, or cannot be used."""

    @abstractmethod
    def _write(self, device: Any, data: bytes) -> None:
        """Hand it a datagram; one of FAULTS: it refuses it."""

    @abstractmethod
    def _read(self, device: Any) -> None:
        """Read until stopped; one of FAULTS: it has gone."""

    @abstractmethod
    def _close(self, device: Any) -> None:
        """Free it for others."""

    def fileno(self) -> int:
        return self._event

    def send(self, data: bytes) -> str:
        with self._lock:
            if self._device is None:
                return self._missing
            try:
                self._write(self._device, data)
            except FAULTS as error:
                return reason(error)
        return ""

    def receive(self, most: int) -> list[ReceivedDatagram]:
        if not self._arrived:
            return []
        with suppress(BlockingIOError):
            os.eventfd_read(self._event)
        datagrams = [self._arrived.popleft() for _ in range(min(most, len(self._arrived)))]
        if self._arrived:
            os.eventfd_write(self._event, 1)
        return datagrams

    def _queue(self, data: bytes, arrival_ns: int) -> None:
        """Keep a datagram that the thread has read for the agent."""
        if len(self._arrived) >= _ROOM:
            self.overflowed += 1
            return
        self._arrived.append(ReceivedDatagram(data, arrival_ns))
        os.eventfd_write(self._event, 1)

    def _run(self) -> None:
        while not self._stopped.is_set():
            device = self._device
            if device is not None:
                try:
                    self._read(device)
                except FAULTS as error:
                    with self._lock:  # nothing writes to it any more
                        self._device = None
                    self._close(device)  # this may take its time: no agent waits for it
                    self.unplugged += 1
                    self.print(f"has gone ({reason(error)}): no frame leaves or arrives until it is back")
            elif not self._stopped.wait(_RETRY_S):
                with suppress(ConfigError):  # it is not there yet
                    device = self._open()
                    with self._lock:
                        self._device = device
                    self.print("is back")

    def close(self) -> None:
        self._stopped.set()
        self._thread.join(_END_S)
        device, self._device = self._device, None
        if device is not None:
            self._close(device)
        if self._event >= 0:
            os.close(self._event)
            self._event = -1


def reason(error: Exception) -> str:
    """Return what one of FAULTS says."""
    return str(getattr(error, "strerror", None) or error or type(error).__name__)
