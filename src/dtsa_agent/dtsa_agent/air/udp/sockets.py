"""A multicast group on one network interface, with the kernel's times of arrival."""

from __future__ import annotations

import fcntl
import socket
import struct
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple

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


class Datagram(NamedTuple):
    """What has arrived."""

    data: bytes
    arrival_ns: int  # CLOCK_MONOTONIC
    own: bool  # this very socket has sent it


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


class MulticastSocket:
    """Sends to a group and hears what others send to it. A context manager.

    Datagrams of other groups and interfaces do not get in. What it sends comes back to it, marked as its own: other
    agents on this computer hear it in the same way.

    :param settings: interface and group.
    :raises ConfigError: if the interface cannot be used.
    """

    def __init__(self, settings: UdpSettings) -> None:
        self._group = settings.address
        group, port = self._group
        local = interface_address(settings.interface)
        membership = struct.pack("=4s4si", socket.inet_aton(group), b"\0\0\0\0", settings.interface_index())
        self._out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._in = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._stamps = StampClock()
        self.unreadable = 0  # how often it could not be read
        try:
            self._out.bind((local, 0))
            self._out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, membership)
            self._out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, settings.ttl)
            self._out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
            self._out.setsockopt(socket.IPPROTO_IP, _IP_RECVERR, 1)  # else Linux drops, at a full queue, in silence
            self._in.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._in.bind(self._group)
            self._in.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
            self._in.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
            with suppress(OSError):  # arrivals are then as exact as this process is quick
                self._in.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            for end in (self._in, self._out):
                end.setblocking(False)
        except OSError as error:
            self.close()
            where = f"{settings.interface}, group {group}:{port}"
            raise ConfigError("interface", where, f"one that takes part in the group ({error.strerror})") from None
        self.address: tuple[str, int] = self._out.getsockname()  # from which it sends
        self._read = self._in.recvmsg

    def fileno(self) -> int:
        """For ``select``: readable when something has arrived."""
        return self._in.fileno()

    def send(self, data: bytes) -> str:
        """Sends to the group at once; why the network has not taken it, or an empty text.

        :param data: the datagram.
        """
        try:
            self._out.sendto(data, self._group)
        except OSError as error:  # the interface is down for a while, or its queue is full
            return error.strerror or type(error).__name__
        return ""

    def receive(self, most: int) -> list[Datagram]:
        """What has arrived, in this order; empty if nothing has.

        :param most: number of datagrams at a time.
        """
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
        return [Datagram(data, when(_stamp(notes)), source == own) for data, notes, _, source in arrived]

    @property
    def clock_steps(self) -> int:
        """How often the computer's time of day has been set."""
        return self._stamps.steps

    def close(self) -> None:
        """Leaves the group."""
        self._in.close()
        self._out.close()

    def __enter__(self) -> MulticastSocket:
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
