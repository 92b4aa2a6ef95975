"""A Crazyradio 2.0 in sniffer mode as the port of an agent: broadcasts between Crazyflies, through pyusb.

Sources: crazyradio2-firmware 5.4, docs/development/compatible-usb-protocol.md; crazyflie2-nrf-firmware.
"""

from __future__ import annotations

import contextlib
import errno
import importlib.util
import struct
import time
from collections import deque
from typing import Any, NamedTuple

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.priority import realtime_thread

from .device_port import FAULTS, DevicePort, reason
from .settings import CrazyradioSettings

VENDOR_OUT, VENDOR_IN = 0x40, 0xC0
SET_RADIO_CHANNEL, SET_RADIO_ADDRESS, SET_DATA_RATE = 0x01, 0x02, 0x03
SET_RADIO_MODE, GET_SNIFFER_DROP_COUNT = 0x24, 0x26
NORMAL, SNIFFER = 0, 1  # modes
FIRST_FIRMWARE = 0x0504  # of a Crazyradio 2.0 that has sniffer mode
USB_PACKET = 64  # bytes: a transfer ends with a shorter one
BROADCAST = bytes.fromhex("FFE7E7E7E7")  # to which Crazyflies send to each other
_LONGEST_PAYLOAD = 63
_HEAD = struct.Struct("<BxxI")  # length of all; RSSI and pipe; stamp
_PEER, _PEER_BITS, _PORT = 0xFF, 0xF3, 0x80
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


class RadioPacket(NamedTuple):
    """A packet that the dongle has heard."""

    payload: bytes
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
        packets: list[RadioPacket] = []
        at = 0
        while at < len(data) and _HEAD.size <= data[at] <= _HEAD.size + _LONGEST_PAYLOAD:
            end = at + data[at]
            if end > len(data):
                # Only whole USB packets can be followed by more of the same transfer.
                if len(data) - at == USB_PACKET:
                    self._rest = data[at:]
                    return packets
                break
            _, stamp = _HEAD.unpack_from(data, at)
            packets.append(RadioPacket(data[at + _HEAD.size : end], stamp))
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
            backend = None  # pyusb looks for a libusb of the system
            if importlib.util.find_spec("libusb_package") is not None:
                import libusb_package

                backend = libusb_package.get_libusb1_backend()
            found = usb.core.find(idVendor=_VENDOR, idProduct=_PRODUCT, find_all=True, backend=backend)
            devices = list(found or ())
            if len(address.radio) <= _BY_NUMBER and address.radio.isdigit():
                matches = devices[int(address.radio) : int(address.radio) + 1]
            else:
                matches = [one for one in devices if str(one.serial_number).upper() == address.radio.upper()]
            if not matches:
                raise ConfigError("uri", uri, f"a Crazyradio that is plugged in; there are {len(devices)}")
            device = matches[0]
            version = int(device.bcdDevice)
            if version < FIRST_FIRMWARE:
                firmware = f"{uri}: firmware {version >> 8:x}.{version & 0xFF:x}"
                raise ConfigError("uri", firmware, "a Crazyradio 2.0 with firmware 5.4 or later: it has sniffer mode")
            device.set_configuration(1)
            usb.util.claim_interface(device, 0)
            _request(device, SET_RADIO_MODE, NORMAL)  # it may have been left otherwise: begin with an empty queue
            _request(device, SET_RADIO_CHANNEL, address.channel)
            _request(device, SET_DATA_RATE, address.rate_mbps)
            _request(device, SET_RADIO_ADDRESS, 0, BROADCAST)
            _request(device, SET_RADIO_MODE, SNIFFER)
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
            _request(device, SET_RADIO_MODE, NORMAL)
        usb.util.dispose_resources(device)

    def _write(self, device: Any, data: bytes) -> None:
        """Send a packet; when it leaves is not known."""
        transfer = broadcast(data, self._settings.p2p_port)
        device.write(_OUT, transfer, _WRITE_MS)
        if not len(transfer) % USB_PACKET:
            device.write(_OUT, b"", _WRITE_MS)

    def _read(self, device: Any) -> None:
        import usb.core

        reader, clock, counts_due_ns = PacketReader(), DongleClock(), 0
        before = self._dropped, self._garbled, self._unusable  # by the dongle, until it was unplugged
        while not self._stopped.is_set():
            data = b""
            with contextlib.suppress(usb.core.USBTimeoutError):
                data = bytes(device.read(_IN, 2 * USB_PACKET, _READ_MS))
            now = time.monotonic_ns()
            for packet in reader.feed(data):
                arrival_ns = clock.arrival_ns(packet.stamp_us, now)
                datagram = datagram_in(packet.payload, self._settings.p2p_port)
                if datagram is None:
                    self._others += 1
                else:
                    self._queue(datagram, arrival_ns)
            if now >= counts_due_ns:
                counts_due_ns = now + _COUNTS_NS
                dropped = bytes(device.ctrl_transfer(VENDOR_IN, GET_SNIFFER_DROP_COUNT, 0, 0, 4, _REQUEST_MS))
                counts = int.from_bytes(dropped, "little"), reader.garbled, clock.unusable
                self._dropped, self._garbled, self._unusable = map(sum, zip(before, counts, strict=True))


def _request(device: Any, number: int, value: int, data: bytes = b"") -> None:
    device.ctrl_transfer(VENDOR_OUT, number, value, 0, data, _REQUEST_MS)
