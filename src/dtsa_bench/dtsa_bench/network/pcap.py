"""Packets that a Crazyradio has heard, as a file that Wireshark and others read.

The form is that of cflib's own packet log (link type USER15, 162), so the dissector of CRTP that comes with cflib's
sources opens the file. Before each packet stand, a byte each but for the address: 1 for a radio, 1 for received, the
address (5 bytes), the channel, the number of the dongle. The strength of the signal has no place there.
"""

from __future__ import annotations

import struct
import time
from pathlib import Path

from dtsa_agent.air.crazyradio.packets import BROADCAST, Packet
from dtsa_agent.air.crazyradio.settings import CrazyradioSettings
from dtsa_agent.core import ConfigError

_HEADER = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 0xFFFF, 162)
_RECORD = struct.Struct("<IIII")
_RADIO = _RECEIVED = 1
_UNKNOWN = bytes(5)  # address of the second pipe: nobody has set it
_HIGHEST = 255
_SECOND = 1_000_000_000


class PacketFile:
    """Writes packets, until it cannot: ``failure`` says why then.

    :param path: the file; must not exist.
    :param settings: of the dongle.
    :raises ConfigError: if the file cannot be made.
    """

    def __init__(self, path: Path, settings: CrazyradioSettings) -> None:
        self.path, self.failure = path, ""
        radio, channel, _ = settings.place
        number = int(radio) if radio.isdigit() else 0
        self._after = bytes((channel, min(number, _HIGHEST)))
        self._ahead_ns = time.time_ns() - time.monotonic_ns()
        try:
            self._file = path.open("xb", buffering=0)
            self._file.write(_HEADER)
        except OSError as error:
            raise ConfigError("pcap", str(path), f"a new file ({error.strerror or error})") from None

    def write(self, packet: Packet, arrival_ns: int) -> None:
        """Adds a packet.

        :param packet: what the dongle has heard.
        :param arrival_ns: ns, when it was whole, CLOCK_MONOTONIC.
        """
        if self.failure:
            return
        address = _UNKNOWN if packet.pipe else BROADCAST
        data = bytes((_RADIO, _RECEIVED)) + address + self._after + packet.payload
        seconds, rest = divmod(arrival_ns + self._ahead_ns, _SECOND)
        try:
            self._file.write(_RECORD.pack(seconds, rest // 1000, len(data), len(data)) + data)
        except OSError as error:
            self.failure = f"{self.path} is not whole: {error.strerror or error}"

    def close(self) -> None:
        """Ends the file."""
        self._file.close()
