"""What goes over USB to a Crazyradio 2.0 in sniffer mode: requests, packets, and broadcasts between Crazyflies.

Sources: crazyradio2-firmware 5.4, docs/development/compatible-usb-protocol.md; crazyflie2-nrf-firmware.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

VENDOR_OUT, VENDOR_IN = 0x40, 0xC0
SET_RADIO_CHANNEL, SET_RADIO_ADDRESS, SET_DATA_RATE = 0x01, 0x02, 0x03
SET_RADIO_MODE, GET_SNIFFER_DROP_COUNT = 0x24, 0x26
NORMAL, SNIFFER = 0, 1  # modes
FIRST_FIRMWARE = 0x0504  # of a Crazyradio 2.0 that has sniffer mode
USB_PACKET = 64  # bytes: a transfer ends with a shorter one
BROADCAST = bytes.fromhex("FFE7E7E7E7")  # to which Crazyflies send to each other
_LONGEST_PAYLOAD = 63
_HEAD = struct.Struct("<BBBI")  # length of all, RSSI, pipe, stamp
_PEER, _PEER_BITS, _PORT = 0xFF, 0xF3, 0x80


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
