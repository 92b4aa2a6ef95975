"""A frame in a datagram: who is on the same group by chance, or with other settings, is told apart at a glance.

| bytes | what |
|---|---|
| 0-1 | ``DT`` |
| 2 | version, 1 |
| 3 | 0 |
| 4-7 | of the settings that all agents share, and of the session: 32 bits of their hash, little-endian |
| 8-.. | the frame, sealed or not |
"""

from __future__ import annotations

from dtsa_agent.core.agreement import agreed_settings, settings_hash
from dtsa_agent.core.config import SwarmConfig

HEADER = 8  # bytes before the frame
MODE = "udp"
_MAGIC = b"DT\x01\x00"
NOT_OURS, LENGTH, OTHER_SETTINGS = "not ours", "length", "other settings"


class Wrapping:
    """Puts frames into datagrams and takes them out.

    :param config: what all agents share.
    """

    def __init__(self, config: SwarmConfig) -> None:
        agreed = settings_hash(agreed_settings(config, MODE)) & 0xFFFFFFFF
        self._header = _MAGIC + agreed.to_bytes(4, "little")
        self._length = HEADER + config.frame_length

    def wrap(self, frame: bytes) -> bytes:
        """The datagram of a frame.

        :param frame: the frame, sealed if the settings say so.
        """
        return self._header + frame

    def fault(self, data: bytes) -> str:
        """Why a datagram holds no frame for us; empty: it holds one.

        :param data: the datagram.
        """
        if data[:3] != _MAGIC[:3]:
            return NOT_OURS
        if data[:HEADER] != self._header:
            return OTHER_SETTINGS if len(data) >= HEADER else LENGTH
        return "" if len(data) == self._length else LENGTH
