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
_LOOK_S = 0.5  # between two looks whether a device that has gone is back


class DeviceError(Exception):
    """A device has gone, or does not take what it is given; the text says why."""


class Device(Protocol):
    """What is open while it is there."""

    def close(self) -> None:
        """Gives it back."""


D = TypeVar("D", bound=Device)


class DevicePort(ABC, Generic[D]):
    """A :class:`.port.DatagramPort` and a :class:`.port.Listener`; the thread is started by :meth:`begin`.

    A device that is unplugged is used again when it is back.

    :param name: what it is called in what it says, as "device /dev/ttyUSB0".
    :param kind: what it is, as "device".
    :param properties: see there.
    :param device: open already.
    """

    def __init__(self, name: str, kind: str, properties: PortProperties, device: D) -> None:
        self.properties = properties
        self.say: Callable[[str], None] | None = None  # is told a line when the device goes, and when it is back
        self._arrived: deque[ReceivedDatagram] = deque()
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)  # readable while something waits
        self.overflowed = 0  # datagrams for which there was no room
        self._name, self._missing = name, f"the {kind} is not there"
        self._device: D | None = device
        self._unplugged = 0
        self._lock = threading.Lock()  # the thread that reads closes the device, another one writes to it
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name=kind, daemon=True)

    def begin(self) -> None:
        """Begins to read: all that a reader needs is there."""
        self._thread.start()

    # What differs.

    @abstractmethod
    def _open(self) -> D:
        """The device anew.

        :raises ConfigError: if it is not back yet.
        """

    @abstractmethod
    def _write(self, device: D, data: bytes) -> None:
        """Hands it a datagram.

        :raises DeviceError: if it does not take it.
        """

    @abstractmethod
    def _read(self, device: D) -> None:
        """Reads until it is stopped.

        :raises DeviceError: if the device goes.
        """

    @abstractmethod
    def counts(self) -> dict[str, int]:
        """What it counts, by name."""

    def _lost(self) -> None:
        """The device has gone."""

    # What is the same.

    def fileno(self) -> int:
        """For ``select``: readable when something has arrived."""
        return self._event

    def send(self, data: bytes) -> str:
        """Hands a datagram to the device; why that was not possible, or an empty text.

        :param data: the datagram.
        """
        with self._lock:
            if self._device is None:
                return self._missing
            try:
                self._write(self._device, data)
            except DeviceError as error:
                return str(error)
        return ""

    def receive(self, most: int) -> list[ReceivedDatagram]:
        """What has arrived, in this order, so many at most; empty if nothing has."""
        if not self._arrived:
            return []
        with suppress(BlockingIOError):
            os.eventfd_read(self._event)
        found = [self._arrived.popleft() for _ in range(min(most, len(self._arrived)))]
        if self._arrived:
            os.eventfd_write(self._event, 1)
        return found

    def deliver(self, station: Station, clock: ClockMap, most: int) -> int:
        """Hand what has arrived, but for its own, to a station; returns how many datagrams have, so many at most."""
        found = self.receive(most)
        for one in found:
            if not one.own:
                station.receive(one.data, clock.local_ns(one.arrival_ns))
        return len(found)

    def _put(self, data: bytes, arrival_ns: int, own: bool) -> None:
        """The thread that reads has found a datagram."""
        if len(self._arrived) >= _ROOM:
            self.overflowed += 1
            return
        self._arrived.append(ReceivedDatagram(data, arrival_ns, own))
        os.eventfd_write(self._event, 1)

    def _run(self) -> None:
        while not self._stopped.is_set():
            device = self._device
            if device is None:
                if not self._stopped.wait(_LOOK_S):
                    self._come_back()
                continue
            try:
                self._read(device)
            except DeviceError as error:
                self._go(device, str(error))

    def _go(self, device: D, why: str) -> None:
        with self._lock:  # nobody writes to it any more
            self._device = None
        device.close()  # this may take its time: no agent waits for it
        self._lost()
        self._unplugged += 1
        self._tell(f"has gone ({why}): no frame leaves or arrives until it is back")

    def _come_back(self) -> None:
        try:
            device = self._open()
        except ConfigError:  # not yet
            return
        with self._lock:
            self._device = device
        self._tell("is back")

    def _tell(self, what: str) -> None:
        if self.say is not None:
            self.say(f"{self._name} {what}")

    def close(self) -> None:
        """Ends the thread; the device is free for others."""
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
