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


# -- tables of contents ------------------------------------------------------------------------------------------------
LOG_TYPES = {
    "uint8_t": (1, "B"),
    "uint16_t": (2, "H"),
    "uint32_t": (3, "I"),
    "int8_t": (4, "b"),
    "int16_t": (5, "h"),
    "int32_t": (6, "i"),
    "float": (7, "f"),
    "FP16": (8, "e"),
}
PARAM_TYPES = {
    "uint8_t": (0x08, "B"),
    "uint16_t": (0x09, "H"),
    "uint32_t": (0x0A, "I"),
    "int8_t": (0x00, "b"),
    "int16_t": (0x01, "h"),
    "int32_t": (0x02, "i"),
    "float": (0x06, "f"),
}
READ_ONLY = 0x40
LOG_FORMAT_BY_CODE = dict(LOG_TYPES.values())
LOG_LIMITS = {"B": (0, 255), "H": (0, 65535), "I": (0, 2**32 - 1), "b": (-128, 127), "h": (-32768, 32767)}
LOG_LIMITS["i"] = (-(2**31), 2**31 - 1)


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


def _log(group: str, type_name: str, *names: str) -> list[VariableEntry]:
    return [VariableEntry(group, name, type_name) for name in names]


LOG_ENTRIES: tuple[VariableEntry, ...] = (
    *_log("stateEstimateZ", "int16_t", "x", "y", "z", "vx", "vy", "vz"),
    *_log("stateEstimateZ", "uint32_t", "quat"),
    *_log("stateEstimateZ", "int16_t", "rateRoll", "ratePitch", "rateYaw"),
    *_log("stateEstimate", "float", "x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw"),
    *_log("pm", "uint16_t", "vbatMV"),
    *_log("pm", "float", "vbat"),
    *_log("pm", "int8_t", "state"),
    *_log("pm", "uint8_t", "batteryLevel"),
    *_log("supervisor", "uint16_t", "info"),
    *_log("sys", "uint8_t", "canfly", "isFlying", "isTumbled"),
    *_log("kalman", "float", "varPX", "varPY", "varPZ"),
    *_log("radio", "uint8_t", "rssi"),
)

PARAM_ENTRIES: tuple[VariableEntry, ...] = (
    VariableEntry("kalman", "resetEstimation", "uint8_t", 0),
    VariableEntry("kalman", "initialX", "float", 0.0),
    VariableEntry("kalman", "initialY", "float", 0.0),
    VariableEntry("kalman", "initialZ", "float", 0.0),
    VariableEntry("locSrv", "extPosStdDev", "float", 0.01),
    VariableEntry("locSrv", "extQuatStdDev", "float", 4.5e-3),
    VariableEntry("stabilizer", "estimator", "uint8_t", 2),
    VariableEntry("stabilizer", "controller", "uint8_t", 1),
    VariableEntry("stabilizer", "stop", "uint8_t", 0),
    VariableEntry("commander", "enHighLevel", "uint8_t", 1),
    VariableEntry("hlCommander", "vtoff", "float", 0.5),
    VariableEntry("hlCommander", "vland", "float", 0.5),
    VariableEntry("hlCommander", "groupmask", "uint8_t", 0),
    VariableEntry("posCtlPid", "xVelMax", "float", 1.0),
    VariableEntry("posCtlPid", "yVelMax", "float", 1.0),
    VariableEntry("posCtlPid", "zVelMax", "float", 1.0),
    VariableEntry("ring", "effect", "uint8_t", 6),
    VariableEntry("led", "bitmask", "uint8_t", 0),
    VariableEntry("usd", "logging", "uint8_t", 0),
    VariableEntry("colAv", "enable", "uint8_t", 0),
    VariableEntry("firmware", "revision0", "uint32_t", 0xD75A0001, read_only=True),
    VariableEntry("firmware", "modified", "uint8_t", 0, read_only=True),
    VariableEntry("deck", "bcLighthouse4", "uint8_t", 1, read_only=True),
)

PARAM_ID = {entry.full_name: index for index, entry in enumerate(PARAM_ENTRIES)}


class VariableTable:
    """A table of contents that answers the host's questions (protocol version 4 and later)."""

    INFO = 3
    ITEM = 2

    def __init__(self, entries: Sequence[VariableEntry], *, log: bool) -> None:
        self.entries = tuple(entries)
        types = LOG_TYPES if log else PARAM_TYPES
        self._items = [  # as they go over the air: type, group, name
            bytes((types[e.type][0] | (READ_ONLY if e.read_only else 0),)) + f"{e.group}\0{e.name}\0".encode()
            for e in self.entries
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


def saturate(value: float, form: str) -> float | int:
    """A value as a variable of this struct format holds it: rounded and kept within its range."""
    if form in "fe":
        return float(value)
    low, high = LOG_LIMITS[form]
    return min(max(round(value), low), high)
