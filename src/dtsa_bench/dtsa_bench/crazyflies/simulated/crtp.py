"""Packets of the Crazyflie's real-time protocol: one header byte, then at most 30 bytes of data."""

from __future__ import annotations

MAX_DATA = 30

# Ports
CONSOLE = 0
PARAM = 2
COMMANDER = 3
MEMORY = 4
LOG = 5
LOCALIZATION = 6
GENERIC_COMMANDER = 7
HIGH_LEVEL = 8
SUPERVISOR = 9
PLATFORM = 13
LINK = 15


def pack(port: int, channel: int, data: bytes) -> bytes:
    """One datagram.

    :param port: 0..15.
    :param channel: 0..3.
    :param data: at most 30 bytes.
    :raises ValueError: data is too long for a packet.
    """
    if len(data) > MAX_DATA:
        raise ValueError(f"data of {len(data)} bytes; allowed: at most {MAX_DATA}")
    return bytes((port << 4 | 0x0C | channel,)) + data


def unpack(datagram: bytes) -> tuple[int, int, bytes] | None:
    """Port, channel and data of a datagram; None for one that is no packet (empty or too long)."""
    if not 1 <= len(datagram) <= MAX_DATA + 1:
        return None
    header = datagram[0]
    # Bits 2 and 3 of the header belong to the radio link and are ignored.
    return header >> 4, header & 3, datagram[1:]
