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
from pathlib import Path

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.crazyflies.simulated.fleet_config import DEVICES, RadioSettings

from .air import Agenda, RadioAir
from .dongle import DongleModel
from .receiver import RadioReceiver
from .sniffer_mode import SnifferMode

LIST, CLAIM, REQUEST, PACKET, READ, DROPPED = range(6)
_REQUEST = struct.Struct("<BBHH")
_LONGEST = 128
_PATIENCE_S = 0.05


@dataclass(slots=True, eq=False)
class RadioHost:
    """A host's connection."""

    socket: socket.socket
    dongle: int | None = None


class RadioServer:
    """Dongles, air and receivers. Hosts may connect at once, or after `listen`.

    :param deliver: gets a vehicle's index, a packet for it and the time (s).
    :param passes: index and direction (True: up): whether a packet passes the faults of a vehicle's link.
    :raises ConfigError: the socket cannot be made.
    """

    def __init__(
        self,
        settings: RadioSettings,
        deliver: Callable[[int, bytes, float], None],
        passes: Callable[[int, bool], bool],
        *,
        listen: bool = True,
    ) -> None:
        self.settings = settings
        self.origin_ns = time.monotonic_ns()
        self.listener: socket.socket | None = None
        self.agenda = Agenda()
        first = settings.dongles + 1
        self.receivers = [
            RadioReceiver(station, lambda packet, t, index=index: deliver(index, packet, t))  # type: ignore[misc]
            for index, station in enumerate(settings.stations)
        ]
        by_id = {first + index: receiver for index, receiver in enumerate(self.receivers)}
        air = self.air = RadioAir(settings.dongles + len(by_id), settings.loss, settings.seed)
        #: Id on the air of the first vehicle.
        self.first = first
        sniffers: dict[int, SnifferMode] = {}
        self.dongles = [
            DongleModel(k, settings, air, self.agenda, by_id, lambda radio, up: passes(radio - first, up), sniffers)
            for k in range(1, first)
        ]
        self._taken: set[int] = set()
        self._gone: set[int] = set()  # dongles that are pulled
        self._hosts: list[RadioHost] = []
        if listen:
            self.listen()

    def listen(self) -> None:
        """Hosts may connect, and the fleet's time begins; ConfigError: the socket cannot be made."""
        self.listener = _listen(self.settings.path)
        self.origin_ns = time.monotonic_ns()

    def now_ns(self) -> int:
        """The fleet's time."""
        return time.monotonic_ns() - self.origin_ns

    def serve_host(self, host: RadioHost | None, selector: selectors.BaseSelector) -> None:
        """Receive what has come from a host (None: a new one); the selector learns of hosts that come and go."""
        if host is None:
            assert self.listener is not None
            with contextlib.suppress(OSError):
                connection = self.listener.accept()[0]
                connection.setblocking(False)
                self._hosts.append(RadioHost(connection))
                selector.register(connection, selectors.EVENT_READ, self._hosts[-1])
            return
        sock = host.socket
        if not self._serve(host):
            selector.unregister(sock)

    def _serve(self, host: RadioHost) -> bool:
        """Take what a host has sent; False when it has gone."""
        try:
            message = host.socket.recv(_LONGEST)
        except BlockingIOError:
            return True
        except OSError:
            message = b""
        if not message:
            self.leave(host)
            return False
        kind = message[0]
        if kind == LIST:
            version = DEVICES[self.settings.device]
            versions = [0 if k in self._gone else version for k in range(len(self.dongles))]
            _send(host, struct.pack(f">{len(versions)}H", *versions))
        elif kind == CLAIM and len(message) == 2:
            _send(host, bytes((self._claim(host, message[1]),)))
        elif host.dongle is not None:
            self._use(self.dongles[host.dongle], host, message)
        return True

    def _claim(self, host: RadioHost, number: int) -> bool:
        if number >= len(self.dongles) or number in self._taken | self._gone:
            return False
        self._taken.add(number)
        host.dongle = number
        return True

    def _use(self, dongle: DongleModel, host: RadioHost, message: bytes) -> None:
        kind = message[0]
        if kind == REQUEST and len(message) >= _REQUEST.size:
            _, number, value, index = _REQUEST.unpack_from(message)
            dongle.request(number, value, index, message[_REQUEST.size :], self.now_ns())
        elif kind == PACKET and len(message) > 1:
            dongle.transfer(message[1:], self.now_ns(), lambda data: _send(host, data))
        elif kind == READ:
            dongle.sniffer.give = lambda data: _send(host, bytes((PACKET,)) + data)
            dongle.sniffer.read()
        elif kind == DROPPED:
            _send(host, struct.pack("<BI", DROPPED, dongle.sniffer.dropped))

    def unplug(self, number: int) -> None:
        """Pull a dongle, whichever host has it."""
        self._gone.add(number)
        for host in self._hosts:
            if host.dongle == number:
                with contextlib.suppress(OSError):
                    host.socket.shutdown(socket.SHUT_RDWR)  # `take` sees it go

    def plug_in(self) -> None:
        """All dongles are there."""
        self._gone.clear()

    def leave(self, host: RadioHost) -> None:
        """A host goes; its dongle is free again."""
        host.socket.close()
        if host in self._hosts:
            self._hosts.remove(host)
        if host.dongle is not None:
            self._taken.discard(host.dongle)
            self.dongles[host.dongle].reset()
            host.dongle = None

    def wait_s(self) -> float | None:
        """How long until something is due; None: nothing is."""
        due = self.agenda.next_ns
        return None if due is None else max(0.0, (due - self.now_ns()) / 1e9)

    def run(self) -> None:
        """Do what is due."""
        self.agenda.run(self.now_ns())

    def close(self) -> None:
        """The socket goes."""
        if self.listener is None:
            return
        self.listener.close()
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


def _send(host: RadioHost, data: bytes) -> None:
    with contextlib.suppress(OSError):  # a host that has gone
        host.socket.send(data)


class DongleServer:
    """Simulated Crazyradios on an air of their own, without Crazyflies: serves the hosts that connect to the socket.

    :raises ConfigError: the socket cannot be made.
    """

    def __init__(self, settings: RadioSettings) -> None:
        self.server = RadioServer(settings, lambda index, packet, t: None, lambda index, up: True)
        self._stopped = False

    def stop(self) -> None:
        """End :meth:`run`; also from a signal's handler."""
        self._stopped = True

    def run(self) -> None:
        """Serve until it is stopped."""
        selector = selectors.SelectSelector()  # waits to the microsecond; epoll to the millisecond
        selector.register(self.server.listener, selectors.EVENT_READ, None)
        try:
            while not self._stopped:
                due = self.server.wait_s()
                for key, _ in selector.select(_PATIENCE_S if due is None else min(due, _PATIENCE_S)):
                    self.server.serve_host(key.data, selector)
                self.server.run()
        finally:
            for key in list(selector.get_map().values()):
                if key.data is not None:
                    self.server.leave(key.data)
            self.server.close()
