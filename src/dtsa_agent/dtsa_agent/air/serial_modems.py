"""Serial modems by name: how long a packet is on the air, and what a modem adds to that. None was ever measured here.

A row is all that differs; the port, the simulated modem and the channel's table of radios are made from it. Figures
that makers do not publish are assumed, and the row says so.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

_SECOND = 1_000_000_000
_MS = 1_000_000
NONE = "none"
OVERHEAD = 5  # bytes around a datagram on the line: two zeros, the byte of COBS, the check sum
HEADER = 8  # bytes of a datagram before its frame: two of the settings, two of times, four of one heard agent
FRAMING = HEADER + OVERHEAD  # bytes around a frame
LONGEST = 250  # bytes of a datagram


@dataclass(frozen=True, slots=True)
class Modem:
    """A modem that hands on to all others what it is given."""

    text: str  # what it is, for a table
    source: str  # where its figures are from, and what is assumed
    on_air_ns: Callable[[int], int]  # ns for which a packet of so many bytes is on the air
    bitrate: int  # bit/s on the air, as its maker counts them
    turn_round_ns: int = 0  # from having a packet until its first bit is on the air
    gap_bytes: int = 0  # it sends when for so many bytes' time none has come; 0: what it has, when its turn comes
    turn_ns: int = 0  # of its own time division, what the turn of a modem takes that has nothing to send
    packet: int = 250  # bytes of the longest packet: more are sent as several
    buffer: int = 1000  # bytes that it holds
    baud: int = 57_600  # of its line, as delivered or as is needed


def _bits(bitrate: int, overhead_bytes: int, fixed_ns: int = 0) -> Callable[[int], int]:
    """Time on the air of a radio that sends bytes one after the other, some around those of a packet."""
    return lambda length: fixed_ns - (-(overhead_bytes + length) * 8 * _SECOND // bitrate)


def lora_ns(length: int, *, spreading: int, bandwidth_hz: int) -> int:
    """Time of a LoRa packet on the air, ns (SX1261/2 data sheet, 6.1.4), with explicit header and check sum.

    ``length`` is in bytes, ``spreading`` the factor of 5 to 12.
    """
    few, coding = spreading < 7, 1  # of each four bits one more is sent
    preamble = 12 if few else 8  # symbols, as the data sheet recommends
    symbol_ns = (1 << spreading) * _SECOND // bandwidth_hz
    slow = symbol_ns > 16_380_000  # symbols so long are sent with two bits fewer each
    bits = 8 * length + 16 + 20 - 4 * spreading + (0 if few else 8)
    blocks = -(-max(bits, 0) // (4 * (spreading - 2 * slow)))
    quarters = 4 * (preamble + 8 + blocks * (coding + 4)) + (25 if few else 17)
    return quarters * symbol_ns // 4


def _e22(spreading: int, rate: str, bitrate: int) -> Modem:
    own = 4  # bytes of the module's own header
    return Modem(
        f"EBYTE E22 and the like, LoRa at {rate}",
        "Semtech SX1261/2 data sheet; EBYTE E22-400T30S manual (packet 240 bytes, buffer 1000 bytes). Assumed:"
        f" spreading factors 5, 6 and 7 at 500 kHz give these rates; {own} bytes of its own; 3 ms until it sends",
        lambda length: lora_ns(own + length, spreading=spreading, bandwidth_hz=500_000),
        bitrate, turn_round_ns=3 * _MS, gap_bytes=3, packet=240, baud=115_200,
    )  # fmt: skip


def _sik(rate: int) -> Modem:
    on_air_ns = _bits(rate, 13 + 4, 208_000)  # every packet has a trailer, an empty one too
    return Modem(
        f"SiK, RFD900 in multipoint mode at {rate // 1000} kbit/s",
        "SiK tdm.c (13 bytes, a trailer of 4 and 0.2 ms around a packet, 248 bytes, turns); RFD900x multipoint manual"
        " (57600 baud, broadcast). Assumed: in each round every modem without data sends one empty packet; a frame goes"
        " as one packet; the buffer",
        on_air_ns, rate, turn_ns=on_air_ns(0), packet=248, buffer=2048,
    )  # fmt: skip


#: Modems by the name that ``--modem`` gives them.
MODEMS: dict[str, Modem] = {
    NONE: Modem("a cable: no radio, every byte at once", "-", lambda length: 0, 0),
    "sik-64k": _sik(64_000),
    "sik-125k": _sik(125_000),
    "sik-250k": _sik(250_000),
    "e22-62k": _e22(5, "62.5 kbit/s", 62_500),
    "e22-38k": _e22(6, "38.4 kbit/s", 38_400),
    "e22-19k": _e22(7, "19.2 kbit/s", 19_200),
    "xbee": Modem(
        "XBee 802.15.4, transparent broadcast",
        "IEEE 802.15.4 at 2.4 GHz (6 bytes before a packet, 11 around data, CSMA); Digi XBee 802.15.4 manual"
        " (100 bytes, sends after 3 bytes' time, buffer 202 bytes). Assumed: 2 bytes of its own; the mean back-off",
        _bits(250_000, 6 + 11 + 2), 250_000, turn_round_ns=1_440_000, gap_bytes=3, packet=100, buffer=202, baud=115_200,
    ),
    "esp-now": Modem(
        "a bridge to ESP-NOW on an ESP32",
        "ESP-IDF, ESP-NOW (1 Mbit/s, 250 bytes, 43 bytes around data); IEEE 802.11b (long preamble, 192 us). Assumed: a"
        " bridge that sends after 3 bytes' time; the mean back-off",
        _bits(1_000_000, 43, 192_000), 1_000_000, turn_round_ns=360_000, gap_bytes=3, packet=250, baud=115_200,
    ),
}  # fmt: skip
