"""The radios of a fleet: dongles for the hosts that connect to a socket, receivers for the Crazyflies.

A host connects with one socket a dongle. Messages are whole (SOCK_SEQPACKET); their first byte is their kind:

| kind | from the host | answer |
|---|---|---|
| 0 list | | one pair of bytes a dongle: version of its firmware; 0: it is pulled |
| 1 claim | number of the dongle | 1, or 0: it is in use |
| 2 request | number, value (2), index (2), data | |
| 3 packet | the packet | status and payload; nothing without acknowledgements |
| 4 read | | in sniffer mode: 3 and the next packet that was heard, as soon as there is one |
| 5 dropped | | 5 and the number of packets that were heard and lost, 4 bytes |
"""

from __future__ import annotations

import contextlib
import selectors
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.crazyflies.simulated.fleet_config import DEVICES, RadioSettings

from .air import RadioAir
from .dongle import DongleModel
from .receiver import RadioReceiver

LIST, CLAIM, REQUEST, PACKET, READ, DROPPED = range(6)
_REQUEST = struct.Struct("<BBHH")
_LONGEST = 128


@dataclass(slots=True, eq=False)
class _Host:
    """A host's connection."""

    socket: socket.socket
    dongle: int | None = None

    def send(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # a host that has gone
            self.socket.send(data)


class RadioServer:
    """Dongles, air and receivers.

    :param deliver: gets a vehicle's index, a packet for it and the time (s).
    :param passes: index and direction (True: up): whether a packet passes the faults of a vehicle's link.
    """

    def __init__(
        self,
        settings: RadioSettings,
        deliver: Callable[[int, bytes, float], None],
        passes: Callable[[int, bool], bool],
    ) -> None:
        self.settings = settings
        self.origin_ns = time.monotonic_ns()
        first = self.first = settings.dongles + 1  # id on the air of the first vehicle
        self.receivers = [
            RadioReceiver(station, partial(deliver, index)) for index, station in enumerate(settings.stations)
        ]
        self.air = RadioAir(settings.dongles + len(self.receivers), settings.loss, settings.seed)
        self.air.receivers = dict(enumerate(self.receivers, first))
        self.air.passes = lambda radio, up: passes(radio - first, up)
        self.dongles = [DongleModel(radio, settings, self.air) for radio in range(1, first)]
        self._listener: socket.socket | None = None
        self._selector: selectors.BaseSelector
        self._hosts: list[_Host] = []
        self._unplugged: set[int] = set()

    def listen(self, selector: selectors.BaseSelector) -> None:
        """Hosts may connect, and the fleet's time begins; ConfigError: the socket cannot be made.

        :param selector: learns of hosts that come and go; the data of what is ready is to be called.
        """
        self._selector, self._listener = selector, _listen(self.settings.path)
        selector.register(self._listener, selectors.EVENT_READ, self._accept)
        self.origin_ns = time.monotonic_ns()

    def now_ns(self) -> int:
        """The fleet's time."""
        return time.monotonic_ns() - self.origin_ns

    def _accept(self) -> None:
        assert self._listener is not None
        with contextlib.suppress(OSError):
            host = _Host(self._listener.accept()[0])
            host.socket.setblocking(False)
            self._hosts.append(host)
            self._selector.register(host.socket, selectors.EVENT_READ, partial(self._serve, host))

    def _serve(self, host: _Host) -> None:
        """Receive what a host has sent."""
        try:
            message = host.socket.recv(_LONGEST)
        except BlockingIOError:
            return
        except OSError:
            message = b""
        if not message:
            self._disconnect(host)
        elif message[0] == LIST:
            version = DEVICES[self.settings.device]
            versions = [0 if k in self._unplugged else version for k in range(len(self.dongles))]
            host.send(struct.pack(f">{len(versions)}H", *versions))
        elif message[0] == CLAIM and len(message) == 2:
            number, taken = message[1], {other.dongle for other in self._hosts}
            free = number < len(self.dongles) and number not in taken | self._unplugged
            host.dongle = number if free else host.dongle
            host.send(bytes((free,)))
        elif host.dongle is not None:
            self._use(self.dongles[host.dongle], host, message)

    def _use(self, dongle: DongleModel, host: _Host, message: bytes) -> None:
        kind = message[0]
        if kind == REQUEST and len(message) >= _REQUEST.size:
            _, number, value, _ = _REQUEST.unpack_from(message)
            dongle.request(number, value, message[_REQUEST.size :], self.now_ns())
        elif kind == PACKET and len(message) > 1:
            dongle.transfer(message[1:], self.now_ns(), host.send)
        elif kind == READ:
            dongle.sniffer.give = lambda data: host.send(bytes((PACKET,)) + data)
            dongle.sniffer.read()
        elif kind == DROPPED:
            host.send(struct.pack("<BI", DROPPED, dongle.sniffer.dropped))

    def unplug(self, number: int) -> None:
        """Pull a dongle, whichever host has it."""
        self._unplugged.add(number)
        for host in self._hosts:
            if host.dongle == number:
                with contextlib.suppress(OSError):
                    host.socket.shutdown(socket.SHUT_RDWR)  # `_serve` sees it go

    def plug_in(self) -> None:
        """All dongles are plugged in."""
        self._unplugged.clear()

    def _disconnect(self, host: _Host) -> None:
        """A host goes; its dongle is free again."""
        self._selector.unregister(host.socket)
        host.socket.close()
        self._hosts.remove(host)
        if host.dongle is not None:
            self.dongles[host.dongle].reset()

    def wait_s(self, longest: float) -> float:
        """How long until something is due, at most so long (s)."""
        due = self.air.agenda.next_ns
        return longest if due is None else min(longest, max(0.0, (due - self.now_ns()) / 1e9))

    def run(self) -> None:
        """Do what is due."""
        self.air.agenda.run(self.now_ns())

    def close(self) -> None:
        """The socket goes, and all hosts with it."""
        if self._listener is None:
            return
        for host in [*self._hosts]:
            self._disconnect(host)
        self._listener.close()
        if self.settings.path is not None:
            self.settings.path.unlink(missing_ok=True)


def _listen(path: Path | None) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    if path is not None and path.is_socket():  # of a fleet that was killed?
        try:
            listener.connect(str(path))
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
        listener.close()
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        listener.bind(str(path))
    except OSError as error:
        listener.close()
        raise ConfigError("simulated_radio", str(path), f"a path for a new socket ({error.strerror})") from error
    listener.listen(32)
    listener.setblocking(False)
    return listener
