"""Simulated Crazyradios below pyusb, for simulation only: an unmodified cflib opens radio:// links to them.

The backend takes the place of libusb in this process. The dongles are those of
`fake-crazyflie --simulated-radio SOCKET`: one connection a dongle, one message a transfer
(dtsa_bench.crazyflies.simulated.radio.side says which). In sniffer mode it cuts transfers into USB packets of 64 bytes
as the host's controller and the dongle do: a transfer ends with a shorter packet, be it empty.
"""

from __future__ import annotations

import array
import errno
import socket
import struct
import time
from collections import deque
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import usb.backend
import usb.core

from dtsa_agent.core.errors import ConfigError

from .packets import (
    FIRST_FIRMWARE,
    GET_SNIFFER_DROP_COUNT,
    SET_RADIO_MODE,
    SNIFFER,
    USB_PACKET,
    VENDOR_IN,
    VENDOR_OUT,
)

LIST, CLAIM, REQUEST, PACKET, SCANNED, READ, DROPPED = range(7)
STANDARD_IN = 0x80
GET_DESCRIPTOR, STRING = 6, 3
SCAN_CHANNELS = 0x21
GONE_S = 0.01  # pause before the error of a dongle that has gone: cflib asks again at once, for ever
ANSWER_S = 1.0


class _Handle:
    """One opened dongle."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.socket: socket.socket | None = None
        self.sniffs = False
        self.written = b""  # whole USB packets of a transfer that goes on
        self.arrived: deque[bytes] = deque()  # USB packets


class SimulatedBackend(usb.backend.IBackend):  # type: ignore[misc]
    """Dongles behind a socket.

    :param path: the socket.
    :raises ConfigError: nobody listens there.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            with self._connect() as connection:
                connection.send(bytes((LIST,)))
                answer = connection.recv(256)
        except OSError as error:
            allowed = "the socket of a running `fake-crazyflie --simulated-radio SOCKET`"
            raise ConfigError("simulated_radio", str(path), allowed) from error
        self._versions = [version for (version,) in struct.iter_unpack(">H", answer)]

    def _connect(self) -> socket.socket:
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            connection.settimeout(ANSWER_S)
            connection.connect(str(self._path))
        except OSError:
            connection.close()
            raise
        return connection

    # -- what there is ----------------------------------------------------------------------------------------------
    def enumerate_devices(self) -> Any:
        return iter(range(len(self._versions)))

    def get_parent(self, dev: int) -> None:
        return None

    def get_device_descriptor(self, dev: int) -> Any:
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x0200, bDeviceClass=0, bDeviceSubClass=0, bDeviceProtocol=0,
            bMaxPacketSize0=64, idVendor=0x1915, idProduct=0x7777, bcdDevice=self._versions[dev], iManufacturer=1,
            iProduct=2, iSerialNumber=3, bNumConfigurations=1, address=dev + 1, bus=1, port_number=dev + 1,
            port_numbers=(dev + 1,), speed=2,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: int, config: int) -> Any:
        if config:
            raise IndexError("one configuration")
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=32, bNumInterfaces=1, bConfigurationValue=1, iConfiguration=0,
            bmAttributes=0x80, bMaxPower=50, extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, dev: int, intf: int, alt: int, config: int) -> Any:
        if intf or alt or config:
            raise IndexError("one interface")
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=0, bAlternateSetting=0, bNumEndpoints=2,
            bInterfaceClass=255, bInterfaceSubClass=0, bInterfaceProtocol=0, iInterface=0, extra_descriptors=[],
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev: int, ep: int, intf: int, alt: int, config: int) -> Any:
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=(0x01, 0x81)[ep], bmAttributes=2, wMaxPacketSize=64,
            bInterval=0, bRefresh=0, bSynchAddress=0, extra_descriptors=[],
        )  # fmt: skip

    # -- opening ----------------------------------------------------------------------------------------------------
    def open_device(self, dev: int) -> _Handle:
        return _Handle(dev)

    def close_device(self, dev_handle: _Handle) -> None:
        if dev_handle.socket is not None:
            dev_handle.socket.close()
            dev_handle.socket = None
            dev_handle.sniffs, dev_handle.written = False, b""
            dev_handle.arrived.clear()

    def set_configuration(self, dev_handle: _Handle, config_value: int) -> None:
        pass

    def get_configuration(self, dev_handle: _Handle) -> int:
        return 1

    def claim_interface(self, dev_handle: _Handle, intf: int) -> None:
        if dev_handle.socket is not None:
            return
        try:
            connection = self._connect()
            connection.send(bytes((CLAIM, dev_handle.number)))
            free = connection.recv(1) == b"\x01"
        except OSError as error:
            raise usb.core.USBError("the simulated radio has gone", None, errno.ENODEV) from error
        if not free:
            connection.close()
            raise usb.core.USBError("the dongle is in use", None, errno.EBUSY)
        dev_handle.socket = connection

    def release_interface(self, dev_handle: _Handle, intf: int) -> None:
        self.close_device(dev_handle)

    def reset_device(self, dev_handle: _Handle) -> None:
        pass

    # -- transfers --------------------------------------------------------------------------------------------------
    def _send(self, handle: _Handle, message: bytes) -> None:
        self.claim_interface(handle, 0)
        assert handle.socket is not None
        try:
            handle.socket.send(message)
        except OSError as error:
            self._gone(handle, error)

    def _receive(self, handle: _Handle, timeout_ms: int) -> bytes:
        if handle.socket is None:
            self._gone(handle, OSError("not claimed"))
        assert handle.socket is not None
        try:
            handle.socket.settimeout(timeout_ms / 1000 if timeout_ms else None)
            data = handle.socket.recv(128)
        except TimeoutError as error:
            raise usb.core.USBTimeoutError("no answer", None, errno.ETIMEDOUT) from error
        except OSError as error:
            self._gone(handle, error)
        if not data:
            self._gone(handle, OSError("closed"))
        return data

    def _gone(self, handle: _Handle, error: OSError) -> None:
        self.close_device(handle)
        time.sleep(GONE_S)
        raise usb.core.USBError("the simulated radio has gone", None, errno.ENODEV) from error

    def bulk_write(self, dev_handle: _Handle, ep: int, intf: int, data: Any, timeout: int) -> int:
        message = bytes(data)
        if dev_handle.sniffs:
            dev_handle.written += message
            if message and not len(message) % USB_PACKET:
                return len(message)
            message, dev_handle.written = dev_handle.written, b""
        self._send(dev_handle, bytes((PACKET,)) + message)
        return len(data)

    def bulk_read(self, dev_handle: _Handle, ep: int, intf: int, buff: Any, timeout: int) -> int:
        if dev_handle.sniffs:
            return self._read_transfer(dev_handle, buff, timeout)
        answer = self._receive(dev_handle, timeout)
        buff[: len(answer)] = array.array("B", answer)
        return len(answer)

    def _read_transfer(self, handle: _Handle, buff: Any, timeout: int) -> int:
        """USB packets until a short one, or until there is no room."""
        count = 0
        while count + USB_PACKET <= len(buff):
            if not handle.arrived:
                self._send(handle, bytes((READ,)))
                self._await(handle, PACKET, timeout)
            packet = handle.arrived.popleft()
            buff[count : count + len(packet)] = array.array("B", packet)
            count += len(packet)
            if len(packet) < USB_PACKET:
                break
        return count

    def _await(self, handle: _Handle, kind: int, timeout: int) -> bytes:
        """The next message of a kind; packets that come before it wait."""
        while True:
            message = self._receive(handle, timeout)
            if message[0] == PACKET:
                data = message[1:]
                handle.arrived.extend(data[at : at + USB_PACKET] for at in range(0, len(data) + 1, USB_PACKET))
            if message[0] == kind:
                return message[1:]

    def ctrl_transfer(
        self, dev_handle: _Handle, bmRequestType: int, bRequest: int, wValue: int, wIndex: int, data: Any, timeout: int
    ) -> int:
        if bmRequestType == VENDOR_OUT:
            if bRequest == SET_RADIO_MODE:
                if wValue > SNIFFER or self._versions[dev_handle.number] < FIRST_FIRMWARE:
                    raise usb.core.USBError("Pipe error", None, errno.EPIPE)
                dev_handle.sniffs = wValue == SNIFFER
            self._send(dev_handle, struct.pack("<BBHH", REQUEST, bRequest, wValue, wIndex) + bytes(data))
            return len(data)
        if bmRequestType == VENDOR_IN and bRequest == GET_SNIFFER_DROP_COUNT and dev_handle.sniffs:
            self._send(dev_handle, bytes((DROPPED,)))
            answer = self._await(dev_handle, DROPPED, timeout)
        elif bmRequestType == VENDOR_IN and bRequest == SCAN_CHANNELS:
            self._send(dev_handle, bytes((SCANNED,)))
            answer = self._receive(dev_handle, timeout)
            answer = b"" if answer == b"\xff" else answer
        elif bmRequestType == STANDARD_IN and bRequest == GET_DESCRIPTOR and wValue >> 8 == STRING:
            answer = self._string(dev_handle.number, wValue & 0xFF)
        else:
            raise usb.core.USBError("not supported", None, errno.EPIPE)
        count = min(len(answer), len(data))
        data[:count] = array.array("B", answer[:count])
        return count

    @staticmethod
    def _string(number: int, index: int) -> bytes:
        if not index:
            return bytes((4, STRING, 0x09, 0x04))
        text = {1: "Bitcraze", 2: "Simulated Crazyradio"}.get(index, f"{0x51D0000000 + number:010X}")
        return bytes((2 + 2 * len(text), STRING)) + text.encode("utf-16-le")

    def clear_halt(self, dev_handle: _Handle, ep: int) -> None:
        pass

    def is_kernel_driver_active(self, dev_handle: _Handle, intf: int) -> bool:
        return False
