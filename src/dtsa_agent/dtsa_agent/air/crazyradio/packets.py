"""What a Crazyradio 2.0 in sniffer mode is told, and what it gives: bytes of USB, and of broadcasts between Crazyflies.

Sources: crazyradio2-firmware 5.4, docs/development/compatible-usb-protocol.md; crazyflie2-nrf-firmware.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

VENDOR_OUT, VENDOR_IN = 0x40, 0xC0
SET_RADIO_CHANNEL, SET_RADIO_ADDRESS, SET_DATA_RATE = 0x01, 0x02, 0x03
SET_RADIO_MODE, SET_SNIFFER_ADDRESS, GET_SNIFFER_DROP_COUNT = 0x24, 0x25, 0x26
NORMAL, SNIFFER = 0, 1  # modes
FIRST_FIRMWARE = 0x0504  # of a Crazyradio 2.0 that has sniffer mode
RATES = {"1M": 1, "2M": 2}  # a Crazyradio 2.0 has no 250K
HIGHEST_CHANNEL = 100
USB_PACKET = 64  # bytes: a transfer ends with a shorter one
LONGEST_PAYLOAD = 63
BROADCAST = bytes.fromhex("FFE7E7E7E7")  # to which Crazyflies send to each other
LONGEST_DATA = 60  # bytes of a broadcast between Crazyflies
PORTS = 16
_HEAD = struct.Struct("<BBBI")  # length of all, RSSI, pipe, stamp
_PEER, _PEER_BITS, _PORT = 0xFF, 0xF3, 0x80


class Packet(NamedTuple):
    """A packet that the dongle has heard."""

    payload: bytes
    rssi_dbm: int
    pipe: int  # 0 or 1: to which of its two addresses
    stamp_us: int  # of the dongle's clock when it was whole, 32 bits


class PacketReader:
    """Finds packets in what is read from the dongle.

    A packet begins a transfer, and one longer than 64 bytes may come in two parts. Whatever the bytes are, each call
    ends, and the next transfer begins anew.
    """

    def __init__(self) -> None:
        self._rest = b""  # of a packet that goes on
        self.garbled = 0  # transfers, or ends of these, that are no packets

    def feed(self, data: bytes) -> list[Packet]:
        """The packets that are whole with what one read has given; empty: nothing came for a while."""
        if not data:
            self.garbled += bool(self._rest)
            self._rest = b""
            return []
        data, self._rest = self._rest + data, b""
        found, at = [], 0
        while at < len(data):
            length = data[at]
            if not _HEAD.size <= length <= _HEAD.size + LONGEST_PAYLOAD:
                break
            if at + length > len(data):
                # Only whole USB packets can be followed by more of the same transfer.
                if len(data) - at == USB_PACKET:
                    self._rest = data[at:]
                    return found
                break
            _, rssi, pipe, stamp = _HEAD.unpack_from(data, at)
            found.append(Packet(data[at + _HEAD.size : at + length], -rssi, pipe, stamp))
            at += length
        self.garbled += at < len(data)
        return found


def broadcast(data: bytes, port: int) -> bytes:
    """The transfer that sends a datagram of at most 60 bytes to all Crazyflies and their like, on a port of 0 to 15."""
    return BROADCAST + bytes((_PEER, _PORT | port)) + data


def datagram_in(payload: bytes, port: int) -> bytes | None:
    """The datagram in a packet; None: it is not a broadcast between Crazyflies on this port."""
    if len(payload) < 2 or payload[0] & _PEER_BITS != _PEER_BITS or payload[1] != _PORT | port:
        return None
    return payload[2:]
