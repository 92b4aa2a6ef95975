"""A multicast group on one network interface as the port of an agent, with the kernel's times of arrival."""

from __future__ import annotations

import fcntl
import socket
import struct
import time
from contextlib import suppress

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.kernel import ffi, lib
from dtsa_agent.core.station import ClockMap, Station

from .port import Port, ReceivedDatagram
from .settings import UdpSettings

_SIOCGIFADDR = 0x8915
_IP_RECVERR = 11
_IP_MULTICAST_ALL = 49  # Linux: 0: only groups that this socket has joined
_SO_TIMESTAMPNS = 35
_CHECK_NS = 1_000_000_000  # from one check whether the interface is still the same to the next


class UdpPort(Port):
    """Sends to a group and hears what others send to it.

    Datagrams of other groups and interfaces do not get in. When the interface is made anew, or gets another address,
    the group is joined again: at a send that the network refuses, and for those that only listen within a second.

    :raises ConfigError: if the interface cannot be used.
    """

    def __init__(self, settings: UdpSettings) -> None:
        self._settings, self._group, self.properties = settings, settings.address, settings.properties
        self.name = f"interface {settings.interface}"
        state = _state_of(settings)
        self._in, self._out = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        self._reader = ffi.new("socket_reader *")
        lib.socket_start(self._reader, self._in.fileno())
        self.interface_changes = 0  # how often the group was joined again
        self._state: tuple[int, str] | None = None  # by which the group is joined; None: the interface has gone
        self._membership = b""
        self._check_due_ns = time.monotonic_ns() + _CHECK_NS
        try:
            self._in.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._in.bind(self._group)
            self._in.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
            with suppress(OSError):  # arrivals are then as exact as this process is quick
                self._in.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            self._in.setblocking(False)
            self._join(state)
        except OSError as error:
            self.close()
            where, allowed = f"{settings.interface}, group {settings.group}", "one that takes part in the group"
            raise ConfigError("interface", where, f"{allowed} ({error.strerror})") from None

    def _join(self, state: tuple[int, str]) -> None:
        """Join the group, and send to it, by an interface as it is now: its number and address."""
        membership = struct.pack("=4s4si", socket.inet_aton(self._group[0]), b"\0\0\0\0", state[0])
        out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)  # a bound socket cannot get another address
        try:
            out.bind((state[1], 0))
            out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, membership)
            out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, self._settings.ttl)
            out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
            out.setsockopt(socket.IPPROTO_IP, _IP_RECVERR, 1)  # else Linux drops, at a full queue, in silence
            out.setblocking(False)
            if self._membership:  # of an interface that has gone, maybe: the socket still has it
                with suppress(OSError):
                    self._in.setsockopt(socket.IPPROTO_IP, socket.IP_DROP_MEMBERSHIP, self._membership)
            self._in.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        except OSError:
            out.close()
            raise
        self._out.close()
        self._out, self._membership, self._state = out, membership, state
        address, number = out.getsockname()  # from which it sends
        self._reader.address, self._reader.port = socket.inet_aton(address), number

    def check_interface(self) -> bool:
        """Join the group again if the interface is another one than before; return whether that was so."""
        try:
            state = _state_of(self._settings)
        except ConfigError:
            if self._state is not None:
                self.print("has gone, or has no address: no frame leaves or arrives until it is back")
            self._state = None
            return False
        if state == self._state:
            return False
        try:
            self._join(state)
        except OSError:  # it is not ready yet
            return False
        self.interface_changes += 1
        self.print("is another one now (number {}, address {}): joined the group again".format(*state))
        return True

    def fileno(self) -> int:
        return self._in.fileno()

    def send(self, data: bytes) -> str:
        refusal = self._send(data)
        return self._send(data) if refusal and self.check_interface() else refusal

    def _send(self, data: bytes) -> str:
        try:
            self._out.sendto(data, self._group)
        except OSError as error:  # the interface is down for a while, or its queue is full
            return error.strerror or type(error).__name__
        return ""

    def receive(self, most: int) -> list[ReceivedDatagram]:
        self._check_in_time()
        datagrams = (self._reader.datagrams[k] for k in range(lib.socket_read(self._reader, most)))
        return [ReceivedDatagram(bytes(ffi.buffer(d.data, d.length)), d.arrival_ns) for d in datagrams if not d.own]

    def deliver(self, station: Station, clock: ClockMap, most: int) -> int:
        self._check_in_time()
        count: int = lib.socket_deliver(self._reader, most, station.c, clock.offset_ns, clock.drift_ppb, clock.began_ns)
        station.raise_fault()
        return count

    def _check_in_time(self) -> None:
        now = time.monotonic_ns()
        if now >= self._check_due_ns:
            self._check_due_ns = now + _CHECK_NS
            self.check_interface()

    def counts(self) -> dict[str, int]:
        return {
            "unreadable": self._reader.unreadable,
            "clock_steps": self._reader.clock_steps,
            "interface_changes": self.interface_changes,
        }

    def close(self) -> None:
        self._in.close()
        self._out.close()


def _state_of(settings: UdpSettings) -> tuple[int, str]:
    """Number and IPv4 address of an interface: both change when it is made anew or gets another address."""
    name, number = settings.interface, settings.interface_index()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as query:
        try:
            answer = fcntl.ioctl(query, _SIOCGIFADDR, struct.pack("256s", name.encode()[:15]))
        except OSError:
            raise ConfigError("interface", name, "one with an IPv4 address") from None
    return number, socket.inet_ntoa(answer[20:24])
