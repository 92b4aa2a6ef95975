"""A Crazyradio 2.0 in sniffer mode as the port of an agent: broadcasts between Crazyflies, through pyusb."""

from __future__ import annotations

import contextlib
import errno
import importlib.util
import time
from collections import deque
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.priority import realtime_thread

from . import crazyradio_packets as radio
from .crazyradio_packets import PacketReader, broadcast, datagram_in
from .device_port import FAULTS, DevicePort, reason
from .settings import CrazyradioSettings

_VENDOR, _PRODUCT = 0x1915, 0x7777
_OUT, _IN = 0x01, 0x81
_READ_MS, _WRITE_MS, _REQUEST_MS = 100, 20, 1000
_BY_NUMBER = 4  # digits at most; a serial number has ten
_REASONS = {
    errno.EACCES: "one that this user may open: a udev rule gives the right (docs/how-to/radios.md)",
    errno.EBUSY: "one that no other program uses",
}
_HOW = "tools/dtsa setup --extra cflib, or pip install pyusb libusb-package"
_US, _SECOND = 1_000, 1_000_000_000
_COUNTS_NS = _SECOND  # from one question for the dongle's counts to the next
_PRIORITY = 20
_TURN_US = 1 << 32  # after 71.6 minutes a stamp starts at 0 again
_LATEST_NS = 60 * _SECOND  # later than this nothing is read: the longest sleep of a process
_EARLIEST_NS = _SECOND  # nothing is read by so much earlier than all others
_WINDOW = 96  # packets, of which one at least is read without delay
_OLDEST_NS = 10 * _SECOND  # clocks of crystals differ by less than 1 ms within this time
_FIT_NS = 10_000_000  # stamps fit each other to this
_ODD = 3  # stamps in a row that fit each other and no others: the dongle was restarted


class DongleClock:
    """Turns stamps of a dongle, 32 bits of microseconds, into CLOCK_MONOTONIC.

    USB is never early. So the shortest time between a stamp and its arrival, of the last packets, tells how far the
    clocks are apart, and how much later another packet arrived does not matter. That shortest time itself counts as
    part of a packet's flight.
    """

    def __init__(self) -> None:
        # Of the last packets: when each was read, and by how much that is ahead of its stamp, ns.
        self._packets: deque[tuple[int, int]] = deque(maxlen=_WINDOW)
        self._odd_ns = 0  # by how much it was ahead of the last stamp that did not fit
        self._odd = 0  # how many of these came in a row
        self.unusable = 0  # stamps

    def arrival_ns(self, stamp_us: int, read_ns: int) -> int:
        """When a packet was whole, CLOCK_MONOTONIC, ns; when it was read (ns), if its stamp tells nothing."""
        packets = self._packets
        while packets and read_ns - packets[0][0] > _OLDEST_NS:
            packets.popleft()
        least_ns = min((ahead for _, ahead in packets), default=read_ns - stamp_us * _US)
        turns = ((read_ns - least_ns) // _US - stamp_us + _TURN_US // 2) // _TURN_US
        ahead_ns = read_ns - (stamp_us + turns * _TURN_US) * _US
        late_ns = ahead_ns - least_ns
        if not -_EARLIEST_NS < late_ns < _LATEST_NS:
            self._odd = self._odd + 1 if abs(ahead_ns - self._odd_ns) < _FIT_NS else 1
            self._odd_ns = ahead_ns
            if self._odd < _ODD:
                self.unusable += 1
                return read_ns
            packets.clear()
            late_ns = 0
        self._odd = 0
        packets.append((read_ns, ahead_ns))
        return read_ns - max(late_ns, 0)


class CrazyradioPort(DevicePort):
    """A Crazyradio that hears all broadcasts between Crazyflies on its channel, and sends some.

    :raises ConfigError: if it cannot be used.
    """

    def __init__(self, settings: CrazyradioSettings) -> None:
        self._settings = settings
        self._others = self._dropped = self._garbled = self._unusable = 0
        super().__init__(f"dongle {settings.uri}", "dongle", settings.properties)

    def counts(self) -> dict[str, int]:
        """Return what the dongle has lost, what else was on the air, and how often it was unplugged."""
        return {
            "dropped_by_dongle": self._dropped,
            "dropped_by_computer": self.overflowed,
            "other_packets": self._others,
            "garbled_transfers": self._garbled,
            "strange_stamps": self._unusable,
            "times_unplugged": self.unplugged,
        }

    def _run(self) -> None:
        with realtime_thread(_PRIORITY):  # as agents do: what they wait for comes by this thread
            super()._run()

    def _open(self) -> Any:
        """Return a ``usb.core.Device`` in sniffer mode."""
        settings = self._settings
        uri, address = settings.uri, settings.address
        if importlib.util.find_spec("usb") is None:
            raise ConfigError("pyusb", "not installed", _HOW)
        import usb.core
        import usb.util

        device = None
        try:
            devices = _devices(settings.simulated_radio)
            if len(address.radio) <= _BY_NUMBER and address.radio.isdigit():
                matches = devices[int(address.radio) : int(address.radio) + 1]
            else:
                matches = [one for one in devices if str(one.serial_number).upper() == address.radio.upper()]
            if not matches:
                raise ConfigError("uri", uri, f"a Crazyradio that is plugged in; there are {len(devices)}")
            device = matches[0]
            version = int(device.bcdDevice)
            if version < radio.FIRST_FIRMWARE:
                firmware = f"{uri}: firmware {version >> 8:x}.{version & 0xFF:x}"
                raise ConfigError("uri", firmware, "a Crazyradio 2.0 with firmware 5.4 or later: it has sniffer mode")
            device.set_configuration(1)
            usb.util.claim_interface(device, 0)
            _request(
                device, radio.SET_RADIO_MODE, radio.NORMAL
            )  # it may have been left otherwise: begin with an empty queue
            _request(device, radio.SET_RADIO_CHANNEL, address.channel)
            _request(device, radio.SET_DATA_RATE, address.rate_mbps)
            _request(device, radio.SET_RADIO_ADDRESS, 0, radio.BROADCAST)
            _request(device, radio.SET_RADIO_MODE, radio.SNIFFER)
        except usb.core.NoBackendError:
            raise ConfigError("libusb", "not found", f"libusb 1.0: {_HOW}") from None
        except ConfigError:
            raise
        except (*FAULTS, ValueError) as error:  # ValueError: it may not read the serial number
            if device is not None:
                usb.util.dispose_resources(device)
            number = errno.EACCES if isinstance(error, ValueError) else getattr(error, "errno", None) or 0
            allowed = _REASONS.get(number) or f"a dongle that does what it is told ({reason(error)})"
            raise ConfigError("uri", uri, allowed) from None
        return device

    def _close(self, device: Any) -> None:
        """Leave it as after plugging in."""
        import usb.util

        with contextlib.suppress(*FAULTS):
            _request(device, radio.SET_RADIO_MODE, radio.NORMAL)
        usb.util.dispose_resources(device)

    def _write(self, device: Any, data: bytes) -> None:
        """Send a packet; when it leaves is not known."""
        transfer = broadcast(data, self._settings.p2p_port)
        device.write(_OUT, transfer, _WRITE_MS)
        if not len(transfer) % radio.USB_PACKET:
            device.write(_OUT, b"", _WRITE_MS)

    def _read(self, device: Any) -> None:
        import usb.core

        reader, clock, counts_due_ns = PacketReader(), DongleClock(), 0
        before = self._dropped, self._garbled, self._unusable  # by the dongle, until it was unplugged
        while not self._stopped.is_set():
            data = b""
            with contextlib.suppress(usb.core.USBTimeoutError):
                data = bytes(device.read(_IN, 2 * radio.USB_PACKET, _READ_MS))
            now = time.monotonic_ns()
            for packet in reader.feed(data):
                arrival_ns = clock.arrival_ns(packet.stamp_us, now)
                datagram = datagram_in(packet.payload, self._settings.p2p_port)
                if datagram is None:
                    self._others += 1
                else:
                    self._queue(datagram, arrival_ns, False)
            if now >= counts_due_ns:
                counts_due_ns = now + _COUNTS_NS
                dropped = bytes(
                    device.ctrl_transfer(radio.VENDOR_IN, radio.GET_SNIFFER_DROP_COUNT, 0, 0, 4, _REQUEST_MS)
                )
                counts = int.from_bytes(dropped, "little"), reader.garbled, clock.unusable
                self._dropped, self._garbled, self._unusable = map(sum, zip(before, counts, strict=True))


def _request(device: Any, number: int, value: int, data: bytes = b"") -> None:
    device.ctrl_transfer(radio.VENDOR_OUT, number, value, 0, data, _REQUEST_MS)


def _devices(simulated_radio: str) -> list[Any]:
    import usb.core

    if simulated_radio:
        from .crazyradio_simulated import simulated_dongles

        return simulated_dongles(Path(simulated_radio))
    backend = None  # pyusb looks for a libusb of the system
    if importlib.util.find_spec("libusb_package") is not None:
        import libusb_package

        backend = libusb_package.get_libusb1_backend()
    return list(usb.core.find(idVendor=_VENDOR, idProduct=_PRODUCT, find_all=True, backend=backend) or ())
