"""A Crazyradio 2.0 in sniffer mode, through pyusb."""

from __future__ import annotations

import contextlib
import errno
import importlib.util
from pathlib import Path
from typing import Any

from dtsa_agent.air.device_port import DeviceError
from dtsa_agent.core.errors import ConfigError

from .packets import (
    BROADCAST,
    FIRST_FIRMWARE,
    GET_SNIFFER_DROP_COUNT,
    NORMAL,
    RATES,
    SET_DATA_RATE,
    SET_RADIO_ADDRESS,
    SET_RADIO_CHANNEL,
    SET_RADIO_MODE,
    SNIFFER,
    USB_PACKET,
    VENDOR_IN,
    VENDOR_OUT,
)
from .settings import CrazyradioSettings

_VENDOR, _PRODUCT = 0x1915, 0x7777
_OUT, _IN = 0x01, 0x81
_READ_MS, _WRITE_MS, _REQUEST_MS = 100, 20, 1000
_BY_NUMBER = 4  # digits at most; a serial number has ten
_RIGHTS = "one that this user may open: a udev rule gives the right (docs/how-to/radios.md)"
_HOW = "tools/dtsa setup --extra cflib, or pip install pyusb libusb-package"


class DongleError(DeviceError):
    """The dongle does not do what it is told; the text says why."""


class Dongle:
    """A dongle that hears all broadcasts between Crazyflies on its channel, and sends some.

    :raises ConfigError: if it cannot be used.
    """

    def __init__(self, settings: CrazyradioSettings) -> None:
        if importlib.util.find_spec("usb") is None:
            raise ConfigError("pyusb", "not installed", _HOW)
        import usb.core
        import usb.util

        self._errors: Any = (usb.core.USBError, NotImplementedError)
        self._timeout: Any = usb.core.USBTimeoutError
        self._release = usb.util.dispose_resources
        place = settings.place
        self._device = _found(settings)
        version = int(self._device.bcdDevice)
        if version < FIRST_FIRMWARE:
            has = f"{settings.uri}: firmware {version >> 8:x}.{version & 0xFF:x}"
            raise ConfigError("uri", has, "a Crazyradio 2.0 with firmware 5.4 or later: it has sniffer mode")
        try:
            self._device.set_configuration(1)
            usb.util.claim_interface(self._device, 0)
            self._request(SET_RADIO_MODE, NORMAL)  # it may have been left otherwise: begin with an empty queue
            self._request(SET_RADIO_CHANNEL, place.channel)
            self._request(SET_DATA_RATE, RATES[place.rate])
            self._request(SET_RADIO_ADDRESS, 0, BROADCAST)
            self._request(SET_RADIO_MODE, SNIFFER)
        except self._errors as error:
            self._release(self._device)
            raise _explained(settings.uri, error) from None

    def _request(self, number: int, value: int, data: bytes = b"") -> None:
        self._device.ctrl_transfer(VENDOR_OUT, number, value, 0, data, _REQUEST_MS)

    def read(self) -> bytes:
        """What has arrived, or empty bytes after a while.

        :raises DongleError: if it has gone.
        """
        try:
            return bytes(self._device.read(_IN, 2 * USB_PACKET, _READ_MS))
        except self._timeout:
            return b""
        except self._errors as error:
            raise DongleError(_text(error)) from None

    def write(self, transfer: bytes) -> None:
        """Sends a packet; when it leaves, nobody knows.

        :raises DongleError: if the dongle does not take it.
        """
        try:
            self._device.write(_OUT, transfer, _WRITE_MS)
            if not len(transfer) % USB_PACKET:
                self._device.write(_OUT, b"", _WRITE_MS)
        except self._errors as error:
            raise DongleError(_text(error)) from None

    def dropped(self) -> int:
        """Packets that the dongle has heard and lost, because they were not read in time.

        :raises DongleError: if it has gone.
        """
        try:
            answer = self._device.ctrl_transfer(VENDOR_IN, GET_SNIFFER_DROP_COUNT, 0, 0, 4, _REQUEST_MS)
        except self._errors as error:
            raise DongleError(_text(error)) from None
        return int.from_bytes(bytes(answer), "little")

    def close(self) -> None:
        """The dongle is as after plugging in, for others."""
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


def _found(settings: CrazyradioSettings) -> Any:
    """The device that the URI names.

    :raises ConfigError: if there is none, or it may not be looked at.
    """
    import usb.core

    radio, simulated = settings.place.radio, None
    if settings.simulated_radio:
        from .simulated import simulated_dongles

        simulated = simulated_dongles(Path(settings.simulated_radio))
    try:
        found: list[Any] = _real_devices() if simulated is None else simulated
        if len(radio) <= _BY_NUMBER and radio.isdigit():
            chosen = found[int(radio) : int(radio) + 1]
        else:
            chosen = [device for device in found if str(device.serial_number).upper() == radio.upper()]
    except usb.core.NoBackendError:
        raise ConfigError("libusb", "not found", f"libusb 1.0: {_HOW}") from None
    except (
        usb.core.USBError,
        NotImplementedError,
        ValueError,
    ) as error:  # pyusb: ValueError where a text cannot be read
        raise _explained(settings.uri, error) from None
    if not chosen:
        raise ConfigError("uri", settings.uri, f"a Crazyradio that is plugged in; there are {len(found)}")
    return chosen[0]


def _explained(uri: str, error: Exception) -> ConfigError:
    number = getattr(error, "errno", None)
    if number == errno.EACCES or isinstance(error, ValueError):
        return ConfigError("uri", uri, _RIGHTS)
    if number == errno.EBUSY:
        return ConfigError("uri", uri, "one that no other program uses")
    return ConfigError("uri", uri, f"a dongle that does what it is told ({_text(error)})")


def _text(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error or type(error).__name__)
