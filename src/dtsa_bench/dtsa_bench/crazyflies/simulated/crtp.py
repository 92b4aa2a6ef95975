"""The Crazyflie's real-time protocol: packets, and the tables of what can be logged and which parameters can be set.

A packet is one header byte, then at most 30 bytes of data. The host keeps a table in its cache under the checksum that
it gets, so the checksum comes from the contents.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

MAX_DATA = 30
# Ports
CONSOLE, PARAM, COMMANDER, MEMORY, LOG, LOCALIZATION = 0, 2, 3, 4, 5, 6
GENERIC_COMMANDER, HIGH_LEVEL, SUPERVISOR, PLATFORM, LINK = 7, 8, 9, 13, 15


def pack(port: int, channel: int, data: bytes) -> bytes:
    """One datagram: port 0 to 15, channel 0 to 3, at most 30 bytes of data.

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


# -- tables of contents: code and struct format by type ----------------------------------------------------------------
LOG_TYPES = {
    "uint8_t": (1, "B"), "uint16_t": (2, "H"), "uint32_t": (3, "I"), "int8_t": (4, "b"), "int16_t": (5, "h"),
    "int32_t": (6, "i"), "float": (7, "f"), "FP16": (8, "e"),
}  # fmt: skip
PARAM_TYPES = {
    "uint8_t": (0x08, "B"), "uint16_t": (0x09, "H"), "uint32_t": (0x0A, "I"), "int8_t": (0x00, "b"),
    "int16_t": (0x01, "h"), "int32_t": (0x02, "i"), "float": (0x06, "f"),
}  # fmt: skip
READ_ONLY = 0x40
LOG_FORMAT_BY_CODE = dict(LOG_TYPES.values())


@dataclass(frozen=True, slots=True)
class VariableEntry:
    """One variable or parameter."""

    group: str
    name: str
    type: str
    value: float = 0.0  # parameters: the default
    read_only: bool = False

    @property
    def full_name(self) -> str:
        """`group.name`, as users write it."""
        return f"{self.group}.{self.name}"


_LOGS = (
    ("int16_t", "stateEstimateZ", "x y z vx vy vz"),
    ("uint32_t", "stateEstimateZ", "quat"),
    ("int16_t", "stateEstimateZ", "rateRoll ratePitch rateYaw"),
    ("float", "stateEstimate", "x y z vx vy vz roll pitch yaw"),
    ("uint16_t", "pm", "vbatMV"),
    ("float", "pm", "vbat"),
    ("int8_t", "pm", "state"),
    ("uint8_t", "pm", "batteryLevel"),
    ("uint16_t", "supervisor", "info"),
    ("uint8_t", "sys", "canfly isFlying isTumbled"),
    ("float", "kalman", "varPX varPY varPZ"),
    ("uint8_t", "radio", "rssi"),
)
_PARAMETERS: tuple[tuple[str, str, dict[str, float]], ...] = (
    ("uint8_t", "kalman", {"resetEstimation": 0}),
    ("float", "kalman", {"initialX": 0.0, "initialY": 0.0, "initialZ": 0.0}),
    ("float", "locSrv", {"extPosStdDev": 0.01, "extQuatStdDev": 4.5e-3}),
    ("uint8_t", "stabilizer", {"estimator": 2, "controller": 1, "stop": 0}),
    ("uint8_t", "commander", {"enHighLevel": 1}),
    ("float", "hlCommander", {"vtoff": 0.5, "vland": 0.5}),
    ("uint8_t", "hlCommander", {"groupmask": 0}),
    ("float", "posCtlPid", {"xVelMax": 1.0, "yVelMax": 1.0, "zVelMax": 1.0}),
    ("uint8_t", "ring", {"effect": 6}),
    ("uint8_t", "led", {"bitmask": 0}),
    ("uint8_t", "usd", {"logging": 0}),
    ("uint8_t", "colAv", {"enable": 0}),
    ("uint32_t", "firmware", {"revision0": 0xD75A0001}),
    ("uint8_t", "firmware", {"modified": 0}),
    ("uint8_t", "deck", {"bcLighthouse4": 1}),
)
LOG_ENTRIES = tuple(VariableEntry(group, name, type_) for type_, group, names in _LOGS for name in names.split())
PARAM_ENTRIES = tuple(
    VariableEntry(group, name, type_, value, read_only=group in ("firmware", "deck"))
    for type_, group, values in _PARAMETERS
    for name, value in values.items()
)
PARAM_ID = {entry.full_name: index for index, entry in enumerate(PARAM_ENTRIES)}


class VariableTable:
    """A table of contents that answers the host's questions (protocol version 4 and later)."""

    INFO = 3
    ITEM = 2

    def __init__(self, entries: Sequence[VariableEntry], *, log: bool) -> None:
        types = LOG_TYPES if log else PARAM_TYPES
        self._items = [  # as they go over the air: type, group, name
            bytes((types[e.type][0] | (READ_ONLY if e.read_only else 0),)) + f"{e.group}\0{e.name}\0".encode()
            for e in entries
        ]
        self.checksum = zlib.crc32(b"".join(self._items))
        self._tail = bytes((16, 128)) if log else b""  # the firmware's room for log blocks and variables

    def answer(self, data: bytes) -> bytes | None:
        """Reply to a request on the table's channel; None if it is not one that the firmware answers."""
        if data[:1] == bytes((self.INFO,)):
            return struct.pack("<BHI", self.INFO, len(self._items), self.checksum) + self._tail
        if data[:1] == bytes((self.ITEM,)) and len(data) >= 3:
            (index,) = struct.unpack_from("<H", data, 1)
            if index < len(self._items):
                return data[:3] + self._items[index]
            return bytes((self.ITEM,))  # the firmware's answer to an index out of range
        return None


LOG_TABLE = VariableTable(LOG_ENTRIES, log=True)
PARAM_TABLE = VariableTable(PARAM_ENTRIES, log=False)


def pack_value(value: float, form: str) -> bytes:
    """A value as a variable of this struct format holds it: rounded and kept within its range."""
    if form not in "fe":
        bits = 8 * struct.calcsize("<" + form)
        low, high = (0, 2**bits - 1) if form.isupper() else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        value = min(max(round(value), low), high)
    return struct.pack("<" + form, value)
