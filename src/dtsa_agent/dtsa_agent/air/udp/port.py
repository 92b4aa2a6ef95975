"""A multicast group on one network interface, with the kernel's times of arrival."""

from __future__ import annotations

import fcntl
import socket
import struct
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

from dtsa_agent.air.port import ReceivedDatagram
from dtsa_agent.core.errors import ConfigError

from .settings import UdpSettings

_SIOCGIFADDR = 0x8915
_IP_RECVERR = 11
_IP_MULTICAST_ALL = 49  # Linux: 0: only groups that this socket has joined
_SO_TIMESTAMPNS = 35
_STAMP = struct.Struct("@ll")
_ROOM = socket.CMSG_SPACE(_STAMP.size)  # bytes for a stamp beside a datagram
_LONGEST = 512  # bytes of a datagram that are looked at; frames of ours are far shorter
_SECOND = 1_000_000_000
_STEP_NS = 1_000_000  # the clock of the stamps has been set if it moved by this between two looks
_EXACT_NS = 2_000  # between two looks at one clock: good enough for the other one in between
_OLDEST_NS = 60 * _SECOND  # a stamp cannot be older than the longest sleep of a process
_LOOK_NS = _SECOND  # a listener looks this often whether its interface is still the same


class StampClock:
    """Turns the kernel's stamps of arrival, which are CLOCK_REALTIME, into CLOCK_MONOTONIC.

    Both clocks are looked at after datagrams have been read. When the first one has been set since the last look,
    stamps of before are worth nothing, and the time of the look stands for them.
    """

    def __init__(self) -> None:
        self._ahead_ns, self._now_ns = _look()
        self._usable = True
        self.steps = 0  # how often the clock of the stamps has been set

    def look(self) -> None:
        """Datagrams have been read: looks at both clocks."""
        ahead, self._now_ns = _look()
        self._usable = abs(ahead - self._ahead_ns) <= _STEP_NS
        self.steps += not self._usable
        self._ahead_ns = ahead

    def arrival_ns(self, stamp_ns: int | None) -> int:
        """When a datagram arrived, CLOCK_MONOTONIC.

        :param stamp_ns: the kernel's stamp, CLOCK_REALTIME; None: it has given none.
        """
        if stamp_ns is None or not self._usable:
            return self._now_ns
        arrival = stamp_ns - self._ahead_ns
        return arrival if -_OLDEST_NS < arrival - self._now_ns <= 0 else self._now_ns


def _look() -> tuple[int, int]:
    """How far CLOCK_REALTIME is ahead of CLOCK_MONOTONIC, ns, and the latter, ns: the best of three looks."""
    best = (1 << 62, 0, 0)
    for _ in range(3):
        before, real, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after - before < _EXACT_NS:
            return real - (before + after) // 2, after
        best = min(best, (after - before, real - (before + after) // 2, after))
    return best[1], best[2]


class Place(NamedTuple):
    """Where an interface is now: both change when it is made anew or gets another address."""

    number: int  # that the kernel gives the interface
    address: str  # IPv4


class UdpPort:
    """Sends to a group and hears what others send to it. A context manager.

    Datagrams of other groups and interfaces do not get in. What it sends comes back to it, marked as its own: other
    agents on this computer hear it in the same way. When the interface is made anew, or gets another address, the group
    is joined again: at a send that the network refuses, and for those that only listen within a second.

    :param settings: interface and group.
    :raises ConfigError: if the interface cannot be used.
    """

    def __init__(self, settings: UdpSettings) -> None:
        self._settings, self._group, self.properties = settings, settings.address, settings.properties
        group, port = self._group
        place = _place(settings)
        self._in = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._stamps = StampClock()
        self.unreadable = 0  # how often it could not be read
        self.interface_changes = 0  # how often the group was joined again
        self.say: Callable[[str], None] | None = None  # is told a line when the interface goes, and when it is back
        self._place: Place | None = None  # by which the group is joined; None: the interface has gone
        self._membership = b""
        self._look_ns = time.monotonic_ns() + _LOOK_NS
        try:
            self._in.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._in.bind(self._group)
            self._in.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
            with suppress(OSError):  # arrivals are then as exact as this process is quick
                self._in.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            self._in.setblocking(False)
            self._join(place)
        except OSError as error:
            self.close()
            where = f"{settings.interface}, group {group}:{port}"
            raise ConfigError("interface", where, f"one that takes part in the group ({error.strerror})") from None
        self._read = self._in.recvmsg

    def _join(self, place: Place) -> None:
        """Joins the group, and sends to it, by an interface as it is now."""
        membership = struct.pack("=4s4si", socket.inet_aton(self._group[0]), b"\0\0\0\0", place.number)
        out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)  # a bound socket cannot get another address
        try:
            out.bind((place.address, 0))
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
        self._out, self._membership, self._place = out, membership, place
        self.address: tuple[str, int] = out.getsockname()  # from which it sends

    def look(self) -> bool:
        """Joins the group again if the interface is another one than before; whether that was so."""
        try:
            place = _place(self._settings)
        except ConfigError:
            if self._place is not None:
                self._tell("has gone, or has no address: no frame leaves or arrives until it is back")
            self._place = None
            return False
        if place == self._place:
            return False
        try:
            self._join(place)
        except OSError:  # it is not ready yet
            return False
        self.interface_changes += 1
        self._tell(f"is another one now (number {place.number}, address {place.address}): joined the group again")
        return True

    def _tell(self, what: str) -> None:
        if self.say is not None:
            self.say(f"interface {self._settings.interface} {what}")

    def fileno(self) -> int:
        """For ``select``: readable when something has arrived."""
        return self._in.fileno()

    def send(self, data: bytes) -> str:
        """Sends to the group at once; why the network has not taken it, or an empty text.

        :param data: the datagram.
        """
        refusal = self._send(data)
        return self._send(data) if refusal and self.look() else refusal

    def _send(self, data: bytes) -> str:
        try:
            self._out.sendto(data, self._group)
        except OSError as error:  # the interface is down for a while, or its queue is full
            return error.strerror or type(error).__name__
        return ""

    def receive(self, most: int) -> list[ReceivedDatagram]:
        """What has arrived, in this order; empty if nothing has.

        :param most: number of datagrams at a time.
        """
        now = time.monotonic_ns()
        if now >= self._look_ns:
            self._look_ns = now + _LOOK_NS
            self.look()
        arrived: list[tuple[bytes, list[tuple[int, int, bytes]], int, Any]] = []  # as the system gives them
        try:
            while len(arrived) < most:
                arrived.append(self._read(_LONGEST, _ROOM))
        except (BlockingIOError, InterruptedError):
            pass
        except OSError:  # an interface that has gone, for example: it may come back
            self.unreadable += 1
        if not arrived:
            return []
        self._stamps.look()  # afterwards: however long this process was kept waiting, all have arrived before
        when, own = self._stamps.arrival_ns, self.address
        return [ReceivedDatagram(data, when(_stamp(notes)), source == own) for data, notes, _, source in arrived]

    def counts(self) -> dict[str, int]:
        """Failed reads, how often the clock has been set, and how often the interface was another one."""
        return {
            "unreadable": self.unreadable,
            "clock_steps": self._stamps.steps,
            "interface_changes": self.interface_changes,
        }

    def close(self) -> None:
        """Leaves the group."""
        self._in.close()
        self._out.close()

    def __enter__(self) -> UdpPort:
        return self

    def __exit__(self, *unused: object) -> None:
        self.close()


def _stamp(notes: Sequence[tuple[int, int, bytes]]) -> int | None:
    """The kernel's stamp of a datagram, CLOCK_REALTIME, ns; None: it has given none."""
    for level, kind, value in notes:
        if kind == _SO_TIMESTAMPNS and level == socket.SOL_SOCKET and len(value) >= _STAMP.size:
            seconds, nanoseconds = _STAMP.unpack_from(value)
            return int(seconds) * _SECOND + int(nanoseconds)
    return None


def _place(settings: UdpSettings) -> Place:
    return Place(settings.interface_index(), interface_address(settings.interface))


def interface_address(name: str) -> str:
    """The IPv4 address of a network interface.

    :param name: of the interface.
    :raises ConfigError: if it has none.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        try:
            answer = fcntl.ioctl(asked, _SIOCGIFADDR, struct.pack("256s", name.encode()[:15]))
        except OSError:
            raise ConfigError("interface", name, "one with an IPv4 address") from None
    return socket.inet_ntoa(answer[20:24])
