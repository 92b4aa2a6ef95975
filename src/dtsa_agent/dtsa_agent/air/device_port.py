"""A device that a thread reads, as the port of an agent: what serial modems and Crazyradios have in common."""

from __future__ import annotations

import os
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Generic, Protocol, TypeVar

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.station import Station

from .port import ClockMap, PortProperties, ReceivedDatagram

_END_S = 2.0  # a device that hangs ends with the process
_ROOM = 256  # datagrams that wait for the agent
_RETRY_S = 0.5  # from one attempt to open a device that has gone to the next


class DeviceError(Exception):
    """A device has gone, or refuses what it is given; the text says why."""


class OpenDevice(Protocol):
    """A device while it is open."""

    def close(self) -> None:
        """Free it for others."""


D = TypeVar("D", bound=OpenDevice)


class DevicePort(ABC, Generic[D]):
    """A :class:`.port.DatagramPort`; a device that is unplugged is used again when it is back.

    :param name: for log lines, as "device /dev/ttyUSB0".
    :param kind: what it is, as "device".
    """

    def __init__(self, name: str, kind: str, properties: PortProperties) -> None:
        self.properties = properties
        self.log: Callable[[str], None] | None = None
        self.overflowed = 0  # datagrams for which there was no room
        self.unplugged = 0  # how often the device has gone
        self._device: D | None = self._open()
        self._arrived: deque[ReceivedDatagram] = deque()
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)  # readable while a datagram waits
        self._name, self._missing = name, f"the {kind} is not there"
        self._lock = threading.Lock()  # the thread that reads closes the device, another one writes to it
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name=kind, daemon=True)
        self._thread.start()

    @abstractmethod
    def _open(self) -> D:
        """Open the device.

        :raises ConfigError: if it is not there, or cannot be used.
        """

    @abstractmethod
    def _write(self, device: D, data: bytes) -> None:
        """Hand it a datagram.

        :raises DeviceError: if it refuses it.
        """

    @abstractmethod
    def _read(self, device: D) -> None:
        """Read until stopped.

        :raises DeviceError: if the device goes.
        """

    @abstractmethod
    def counts(self) -> dict[str, int]:
        """Return what it counts, by name."""

    def _lost(self) -> None:
        """The device has gone."""

    def fileno(self) -> int:
        """For ``select``: readable when something has arrived."""
        return self._event

    def send(self, data: bytes) -> str:
        """Hand a datagram to the device; return why that was not possible, or an empty text."""
        with self._lock:
            if self._device is None:
                return self._missing
            try:
                self._write(self._device, data)
            except DeviceError as error:
                return str(error)
        return ""

    def receive(self, most: int) -> list[ReceivedDatagram]:
        """Return what has arrived, in this order, at most so many; empty if nothing has."""
        if not self._arrived:
            return []
        with suppress(BlockingIOError):
            os.eventfd_read(self._event)
        datagrams = [self._arrived.popleft() for _ in range(min(most, len(self._arrived)))]
        if self._arrived:
            os.eventfd_write(self._event, 1)
        return datagrams

    def deliver(self, station: Station, clock: ClockMap, most: int) -> int:
        """Hand what others have sent to a station; return how many datagrams have arrived, at most so many."""
        datagrams = self.receive(most)
        for datagram in datagrams:
            if not datagram.own:
                station.receive(datagram.data, clock.local_ns(datagram.arrival_ns))
        return len(datagrams)

    def _queue(self, data: bytes, arrival_ns: int, own: bool) -> None:
        """Keep a datagram that the thread has read for the agent."""
        if len(self._arrived) >= _ROOM:
            self.overflowed += 1
            return
        self._arrived.append(ReceivedDatagram(data, arrival_ns, own))
        os.eventfd_write(self._event, 1)

    def _run(self) -> None:
        while not self._stopped.is_set():
            device = self._device
            if device is not None:
                try:
                    self._read(device)
                except DeviceError as error:
                    self._drop(device, str(error))
            elif not self._stopped.wait(_RETRY_S):
                with suppress(ConfigError):  # it is not there yet
                    device = self._open()
                    with self._lock:
                        self._device = device
                    self._print("is back")

    def _drop(self, device: D, why: str) -> None:
        with self._lock:  # nothing writes to it any more
            self._device = None
        device.close()  # this may take its time: no agent waits for it
        self._lost()
        self.unplugged += 1
        self._print(f"has gone ({why}): no frame leaves or arrives until it is back")

    def _print(self, text: str) -> None:
        if self.log is not None:
            self.log(f"{self._name} {text}")

    def close(self) -> None:
        """End the thread, and free the device for others."""
        self._stopped.set()
        self._thread.join(_END_S)
        if self._device is not None:
            self._device.close()
            self._device = None
        if self._event >= 0:
            os.close(self._event)
            self._event = -1

    def __enter__(self) -> DevicePort[D]:
        return self

    def __exit__(self, *unused: object) -> None:
        self.close()
