"""Computers for trials of a real air: network namespaces, each with an address and a cable of its own.

The cable is a TAP device: what a host sends on it is read here as Ethernet frames, and what is written here arrives at
the host. The process that holds the other ends of all cables is the switch between them. This process stays where it
is; only while a host is made it looks in.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import socket
import struct
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from dtsa_agent.core.errors import DtsaError

CABLE = "air0"  # the interface of each host
_NET = "10.68"
_CLONE_NEWNET, _CLONE_NEWTIME = 0x40000000, 0x80
_TUNSETIFF, _IFF_TAP, _IFF_NO_PI = 0x400454CA, 0x0002, 0x1000
_SIOCSIFADDR, _SIOCSIFNETMASK, _SIOCGIFFLAGS, _SIOCSIFFLAGS = 0x8916, 0x891C, 0x8913, 0x8914
_IFF_UP = 1
_OWN = "/proc/self/ns/net"
_BURST = 64  # frames of a host at a time
LONGEST = 2048  # bytes of an Ethernet frame


class Unavailable(DtsaError):
    """Hosts cannot be made on this machine."""


@dataclass(frozen=True, slots=True)
class EmulatedHost:
    """One computer."""

    number: int  # from 1
    address: str
    cable: int  # file descriptor of the switch's end
    namespace: int  # file descriptor

    def start(self, command: Sequence[str], clock_ahead_s: int = 0, **more: Any) -> subprocess.Popen[str]:
        """Start a process on the host.

        :param clock_ahead_s: s, by how much its CLOCK_MONOTONIC is ahead of all others, where Linux has time
            namespaces; CLOCK_REALTIME is one for all.
        """
        libc, namespace = _libc(), self.namespace

        def enter() -> None:
            if libc.setns(namespace, _CLONE_NEWNET):
                os._exit(126)
            if clock_ahead_s and not libc.unshare(_CLONE_NEWTIME):
                with suppress(OSError), open("/proc/self/timens_offsets", "w") as offsets:
                    offsets.write(f"monotonic {clock_ahead_s} 0\nboottime {clock_ahead_s} 0\n")

        return subprocess.Popen(command, preexec_fn=enter, text=True, **more)

    def unplug(self) -> None:
        """Its interface goes, as a USB adapter that is pulled."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as loose:  # nothing comes from there or goes there
            loose.setblocking(False)
            os.dup2(loose.fileno(), self.cable, inheritable=False)

    def plug(self, address: str) -> None:
        """An interface of the same name is made anew."""
        with inside(self):
            cable = _new_cable(address)
            os.dup2(cable, self.cable, inheritable=False)
            os.close(cable)

    def readdress(self, address: str) -> None:
        """Its interface gets another address in place of the one that it has."""
        with inside(self):
            _set_address(address)

    def switch(self, up: bool) -> None:
        """Its interface is switched on or off; it keeps its address."""
        with inside(self):
            _set_up(CABLE, up)


@contextmanager
def hosts(count: int) -> Iterator[list[EmulatedHost]]:
    """Some hosts, until the end of the context; processes on them have ended by then."""
    with ExitStack() as stack:
        home = _opened(stack, _OWN, os.O_RDONLY)
        try:
            started = [_start_host(stack, number) for number in range(1, count + 1)]
        finally:
            if _libc().setns(home, _CLONE_NEWNET):
                os._exit(1)  # whatever this process did from here on would be in the wrong place
        yield started


@contextmanager
def inside(host: EmulatedHost) -> Iterator[None]:
    """Until the end of the context this thread is on a host: sockets that it makes stay there."""
    home = os.open(_OWN, os.O_RDONLY | os.O_CLOEXEC)
    try:
        if _libc().setns(host.namespace, _CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        try:
            yield
        finally:
            if _libc().setns(home, _CLONE_NEWNET):
                os._exit(1)  # as in `hosts`
    finally:
        os.close(home)


def arrived(cable: int) -> Iterator[bytes]:
    """Ethernet frames that wait on a host's cable, one after the other; not more than others can wait for."""
    for _ in range(_BURST):
        try:
            frame = os.read(cable, LONGEST)
        except (BlockingIOError, InterruptedError):
            return
        yield frame


def why_not() -> str:
    """Why no hosts can be made here; empty: they can."""
    try:
        with hosts(1):
            return ""
    except Unavailable as error:
        return str(error)


def _start_host(stack: ExitStack, number: int) -> EmulatedHost:
    """A host; this thread is in it afterwards."""
    try:
        if _libc().unshare(_CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        address = f"{_NET}.{number >> 8}.{number & 255}"
        cable = _new_cable(address)
        stack.callback(os.close, cable)
        _set_up("lo", True)
        return EmulatedHost(number, address, cable, _opened(stack, _OWN, os.O_RDONLY))
    except OSError as error:
        raise Unavailable(f"no network namespaces with TAP devices here: {error.strerror or error}") from None


def _new_cable(address: str) -> int:
    """A TAP device of the namespace in which this thread is; the switch's end."""
    cable = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        fcntl.ioctl(cable, _TUNSETIFF, struct.pack("16sH", CABLE.encode(), _IFF_TAP | _IFF_NO_PI))
        _set_address(address)
        _set_up(CABLE, True)
    except OSError:
        os.close(cable)
        raise
    return cable


def _set_address(address: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        _set(asked, _SIOCSIFADDR, CABLE, address)
        _set(asked, _SIOCSIFNETMASK, CABLE, "255.255.0.0")


def _set_up(name: str, up: bool) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        flags = fcntl.ioctl(asked, _SIOCGIFFLAGS, struct.pack("16sH14x", name.encode(), 0))
        before = struct.unpack_from("H", flags, 16)[0]
        after = before | _IFF_UP if up else before & ~_IFF_UP
        fcntl.ioctl(asked, _SIOCSIFFLAGS, struct.pack("16sH14x", name.encode(), after))


def _set(asked: socket.socket, request: int, name: str, address: str) -> None:
    inner = struct.pack("HH4s8x", socket.AF_INET, 0, socket.inet_aton(address))
    fcntl.ioctl(asked, request, struct.pack("16s16s", name.encode(), inner))


def _opened(stack: ExitStack, path: str, flags: int) -> int:
    descriptor = os.open(path, flags | os.O_CLOEXEC)
    stack.callback(os.close, descriptor)
    return descriptor


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)
