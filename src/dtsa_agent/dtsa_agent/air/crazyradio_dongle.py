"""A Crazyradio 2.0 in sniffer mode, through pyusb: requests, packets, and broadcasts between Crazyflies.

Sources: crazyradio2-firmware 5.4, docs/development/compatible-usb-protocol.md; crazyflie2-nrf-firmware.
"""

from __future__ import annotations

import contextlib
import errno
import importlib.util
import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

from dtsa_agent.core.errors import ConfigError

from .device_port import DeviceError
from .settings import CrazyradioSettings

VENDOR_OUT, VENDOR_IN = 0x40, 0xC0
SET_RADIO_CHANNEL, SET_RADIO_ADDRESS, SET_DATA_RATE = 0x01, 0x02, 0x03
SET_RADIO_MODE, GET_SNIFFER_DROP_COUNT = 0x24, 0x26
NORMAL, SNIFFER = 0, 1  # modes
FIRST_FIRMWARE = 0x0504  # of a Crazyradio 2.0 that has sniffer mode
USB_PACKET = 64  # bytes: a transfer ends with a shorter one
LONGEST_PAYLOAD = 63
BROADCAST = bytes.fromhex("FFE7E7E7E7")  # to which Crazyflies send to each other
_HEAD = struct.Struct("<BBBI")  # length of all, RSSI, pipe, stamp
_PEER, _PEER_BITS, _PORT = 0xFF, 0xF3, 0x80
_VENDOR, _PRODUCT = 0x1915, 0x7777
_OUT, _IN = 0x01, 0x81
_READ_MS, _WRITE_MS, _REQUEST_MS = 100, 20, 1000
_BY_NUMBER = 4  # digits at most; a serial number has ten
_RIGHTS = "one that this user may open: a udev rule gives the right (docs/how-to/radios.md)"
_HOW = "tools/dtsa setup --extra cflib, or pip install pyusb libusb-package"


class RadioPacket(NamedTuple):
    """A packet that the dongle has heard."""

    payload: bytes
    rssi_dbm: int
    pipe: int  # 0 or 1: to which of its two addresses
    stamp_us: int  # of the dongle's clock when it was whole, 32 bits


class PacketReader:
    """Finds packets in what is read from the dongle.

    A packet begins a transfer, and one longer than 64 bytes may come in two parts. Whatever the bytes are, each call
    ends, and the next transfer starts from nothing.
    """

    def __init__(self) -> None:
        self._rest = b""  # of a packet that goes on
        self.garbled = 0  # transfers, or ends of these, that are no packets

    def feed(self, data: bytes) -> list[RadioPacket]:
        """Return the packets that are whole with what one read has given; empty: nothing came for a while."""
        if not data:
            self.garbled += bool(self._rest)
            self._rest = b""
            return []
        data, self._rest = self._rest + data, b""
        packets, at = [], 0
        while at < len(data) and _HEAD.size <= data[at] <= _HEAD.size + LONGEST_PAYLOAD:
            end = at + data[at]
            if end > len(data):
                # Only whole USB packets can be followed by more of the same transfer.
                if len(data) - at == USB_PACKET:
                    self._rest = data[at:]
                    return packets
                break
            _, rssi, pipe, stamp = _HEAD.unpack_from(data, at)
            packets.append(RadioPacket(data[at + _HEAD.size : end], -rssi, pipe, stamp))
            at = end
        self.garbled += at < len(data)
        return packets


def broadcast(data: bytes, port: int) -> bytes:
    """Return the transfer that sends a datagram of at most 60 bytes to all Crazyflies, on a port of 0 to 15."""
    return BROADCAST + bytes((_PEER, _PORT | port)) + data


def datagram_in(payload: bytes, port: int) -> bytes | None:
    """Return the datagram in a packet; None: it is not a broadcast between Crazyflies on this port."""
    if len(payload) < 2 or payload[0] & _PEER_BITS != _PEER_BITS or payload[1] != _PORT | port:
        return None
    return payload[2:]


class SnifferDongle:
    """A dongle that hears all broadcasts between Crazyflies on its channel, and sends some.

    Its methods raise :class:`DeviceError` if it has gone, or refuses what it is given.

    :param devices: what pyusb would find; None: it looks for them.
    :raises ConfigError: if it cannot be used.
    """

    def __init__(self, settings: CrazyradioSettings, devices: list[Any] | None = None) -> None:
        if importlib.util.find_spec("usb") is None:
            raise ConfigError("pyusb", "not installed", _HOW)
        import usb.core
        import usb.util

        self._errors: Any = (usb.core.USBError, NotImplementedError)
        self._timeout: Any = usb.core.USBTimeoutError
        self._release = usb.util.dispose_resources
        self._device = _find(settings, devices)
        version = int(self._device.bcdDevice)
        if version < FIRST_FIRMWARE:
            firmware = f"{settings.uri}: firmware {version >> 8:x}.{version & 0xFF:x}"
            raise ConfigError("uri", firmware, "a Crazyradio 2.0 with firmware 5.4 or later: it has sniffer mode")
        try:
            self._device.set_configuration(1)
            usb.util.claim_interface(self._device, 0)
            self._request(SET_RADIO_MODE, NORMAL)  # it may have been left otherwise: begin with an empty queue
            self._request(SET_RADIO_CHANNEL, settings.address.channel)
            self._request(SET_DATA_RATE, settings.address.rate_mbps)
            self._request(SET_RADIO_ADDRESS, 0, BROADCAST)
            self._request(SET_RADIO_MODE, SNIFFER)
        except self._errors as error:
            self._release(self._device)
            raise _explain(settings.uri, error) from None

    def _request(self, number: int, value: int, data: bytes = b"") -> None:
        self._device.ctrl_transfer(VENDOR_OUT, number, value, 0, data, _REQUEST_MS)

    @contextlib.contextmanager
    def _guard(self) -> Iterator[None]:
        try:
            yield
        except self._errors as error:
            raise DeviceError(_text(error)) from None

    def read(self) -> bytes:
        """Return what has arrived, or empty bytes after a while."""
        with self._guard():
            try:
                return bytes(self._device.read(_IN, 2 * USB_PACKET, _READ_MS))
            except self._timeout:
                return b""

    def write(self, transfer: bytes) -> None:
        """Send a packet; when it leaves is not known."""
        with self._guard():
            self._device.write(_OUT, transfer, _WRITE_MS)
            if not len(transfer) % USB_PACKET:
                self._device.write(_OUT, b"", _WRITE_MS)

    def dropped(self) -> int:
        """Return how many packets the dongle has heard and lost, because they were not read in time."""
        with self._guard():
            answer = self._device.ctrl_transfer(VENDOR_IN, GET_SNIFFER_DROP_COUNT, 0, 0, 4, _REQUEST_MS)
            return int.from_bytes(bytes(answer), "little")

    def close(self) -> None:
        """Leave the dongle as after plugging in, for others."""
        with contextlib.suppress(self._errors):
            self._request(SET_RADIO_MODE, NORMAL)
        self._release(self._device)


def _real_devices() -> list[Any]:
    import usb.core

    backend = None  # pyusb looks for a libusb of the system
    if importlib.util.find_spec("libusb_package") is not None:
        import libusb_package

        backend = libusb_package.get_libusb1_backend()
    return list(usb.core.find(idVendor=_VENDOR, idProduct=_PRODUCT, find_all=True, backend=backend) or ())


def _find(settings: CrazyradioSettings, devices: list[Any] | None) -> Any:
    """Return the device that the URI names.

    :raises ConfigError: if there is none, or it may not be opened.
    """
    import usb.core

    radio = settings.address.radio
    try:
        devices = _real_devices() if devices is None else devices
        if len(radio) <= _BY_NUMBER and radio.isdigit():
            matches = devices[int(radio) : int(radio) + 1]
        else:
            matches = [device for device in devices if str(device.serial_number).upper() == radio.upper()]
    except usb.core.NoBackendError:
        raise ConfigError("libusb", "not found", f"libusb 1.0: {_HOW}") from None
    except (usb.core.USBError, NotImplementedError, ValueError) as error:  # ValueError: a text that cannot be read
        raise _explain(settings.uri, error) from None
    if not matches:
        raise ConfigError("uri", settings.uri, f"a Crazyradio that is plugged in; there are {len(devices)}")
    return matches[0]


def _explain(uri: str, error: Exception) -> ConfigError:
    number = getattr(error, "errno", None)
    if number == errno.EACCES or isinstance(error, ValueError):
        return ConfigError("uri", uri, _RIGHTS)
    if number == errno.EBUSY:
        return ConfigError("uri", uri, "one that no other program uses")
    return ConfigError("uri", uri, f"a dongle that does what it is told ({_text(error)})")


def _text(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error or type(error).__name__)
