"""Simulated Crazyradios in place of pyusb's devices, for simulation only: an unmodified cflib uses them.

The dongles are those of `fake-crazyflie --simulated-radio SOCKET`: one connection a dongle, one message a transfer
(dtsa_bench.crazyflies.simulated.radio.side lists them).
"""

from __future__ import annotations

import errno
import socket
import struct
import time
from array import array
from collections import deque
from pathlib import Path
from typing import Any

import usb.core

from dtsa_agent.core.errors import ConfigError

from .crazyradio_port import FIRST_FIRMWARE, GET_SNIFFER_DROP_COUNT, SET_RADIO_MODE, SNIFFER, VENDOR_IN, VENDOR_OUT

LIST, CLAIM, REQUEST, PACKET, READ, DROPPED = range(6)
VENDOR = 0x1915
GONE_S = 0.01  # pause before the error of a dongle that has gone: cflib asks again at once, for ever
ANSWER_S = 1.0


class SimulatedDongle:
    """One Crazyradio as pyusb has it: what cflib and agents use of a `usb.core.Device`."""

    def __init__(self, path: Path, number: int, version: int) -> None:
        self.bcdDevice, self.serial_number = version, f"{0x51D0000000 + number:010X}"
        self._path, self._number = path, number
        self._socket: socket.socket | None = None
        self._sniffs = False
        self._arrived: deque[bytes] = deque()
        self._ctx = self  # pyusb's functions ask it about interfaces and resources

    def set_configuration(self, configuration: int | None = None) -> None:
        """There is one."""

    def reset(self) -> None:
        """Nothing to do."""

    def managed_claim_interface(self, device: Any, interface: int) -> None:
        """Take the dongle, unless this program has it."""
        if self._socket is not None:
            return
        try:
            connection = _connect(self._path)
            connection.send(bytes((CLAIM, self._number)))
            free = connection.recv(1) == b"\x01"
        except OSError:
            raise self._disconnected() from None
        if not free:
            connection.close()
            raise usb.core.USBError("the dongle is in use", None, errno.EBUSY)
        self._socket = connection

    def dispose(self, device: Any = None) -> None:
        """Others may have it."""
        if self._socket is not None:
            self._socket.close()
        self._socket, self._sniffs = None, False
        self._arrived.clear()

    def write(self, endpoint: int, data: Any, timeout: int | None = None) -> int:
        """A packet; an empty one ends a transfer of whole USB packets, which is sent already."""
        if len(data):
            self._send(bytes((PACKET,)) + bytes(data))
        return len(data)

    def read(self, endpoint: int, size: int, timeout: int | None = None) -> array[int]:
        """The answer to a packet; in sniffer mode: the next packet that was heard."""
        if not self._sniffs:
            return array("B", self._receive(timeout))
        if not self._arrived:
            self._send(bytes((READ,)))
            self._await(PACKET, timeout)
        return array("B", self._arrived.popleft())

    def ctrl_transfer(
        self, kind: int, request: int, wValue: int = 0, wIndex: int = 0, data_or_wLength: Any = None,
        timeout: int | None = None,
    ) -> Any:  # fmt: skip
        """A request of the vendor."""
        if kind == VENDOR_OUT:
            if request == SET_RADIO_MODE:
                if wValue > SNIFFER or self.bcdDevice < FIRST_FIRMWARE:
                    raise usb.core.USBError("Pipe error", None, errno.EPIPE)
                self._sniffs = wValue == SNIFFER
            self._send(struct.pack("<BBHH", REQUEST, request, wValue, wIndex) + bytes(data_or_wLength or ()))
            return 0
        if kind == VENDOR_IN and request == GET_SNIFFER_DROP_COUNT and self._sniffs:
            self._send(bytes((DROPPED,)))
            return array("B", self._await(DROPPED, timeout))
        raise usb.core.USBError("not supported", None, errno.EPIPE)

    def _send(self, message: bytes) -> None:
        self.managed_claim_interface(self, 0)
        assert self._socket is not None
        try:
            self._socket.send(message)
        except OSError:
            raise self._disconnected() from None

    def _receive(self, timeout_ms: int | None) -> bytes:
        data = b""
        try:
            if self._socket is not None:
                self._socket.settimeout(timeout_ms / 1000 if timeout_ms else None)
                data = self._socket.recv(128)
        except TimeoutError:
            raise usb.core.USBTimeoutError("no answer", None, errno.ETIMEDOUT) from None
        except OSError:
            data = b""
        if not data:
            raise self._disconnected()
        return data

    def _await(self, kind: int, timeout_ms: int | None) -> bytes:
        """The next message of a kind; packets that come before it wait."""
        while True:
            message = self._receive(timeout_ms)
            if message[0] == PACKET:
                self._arrived.append(message[1:])
            if message[0] == kind:
                return message[1:]

    def _disconnected(self) -> usb.core.USBError:
        self.dispose()
        time.sleep(GONE_S)
        return usb.core.USBError("the simulated radio has gone", None, errno.ENODEV)


def _connect(path: Path) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        connection.settimeout(ANSWER_S)
        connection.connect(str(path))
    except OSError:
        connection.close()
        raise
    return connection


def simulated_dongles(path: Path) -> list[SimulatedDongle]:
    """The dongles behind a socket.

    :raises ConfigError: nobody listens there.
    """
    try:
        with _connect(path) as connection:
            connection.send(bytes((LIST,)))
            answer = connection.recv(256)
    except OSError as error:
        allowed = "the socket of a running `fake-crazyflie --simulated-radio SOCKET`"
        raise ConfigError("simulated_radio", str(path), allowed) from error
    versions = enumerate(struct.iter_unpack(">H", answer))
    return [SimulatedDongle(path, k, version) for k, (version,) in versions if version]  # 0: it is pulled


def replace_real_dongles(path: Path) -> None:
    """Let pyusb find these dongles, and no other device.

    :raises ConfigError: nobody listens at the socket.
    """
    simulated_dongles(path)
    usb.core.find = lambda idVendor=None, **_: iter(simulated_dongles(path) if idVendor == VENDOR else ())
