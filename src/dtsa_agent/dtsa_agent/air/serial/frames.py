"""Datagrams on a line of bytes: COBS between zeros, with a check sum, found again after whatever came between.

| bytes | what |
|---|---|
| 0 | zero: what came before is over |
| 1-.. | datagram and its CRC-16 (CCITT, as of ``binascii.crc_hqx``, little-endian), by COBS without zeros |
| last | zero |

Big-endian, a frame that lacks the last byte of its check sum would be whole where that byte is zero.

COBS adds one byte to up to 254 others, whatever they are: a frame takes the same time each time.
"""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Iterator

from cobs import cobs

from .lengths import LONGEST

_CRC = 2
_MOST = LONGEST + _CRC + 1  # bytes between zeros


def to_line(datagram: bytes) -> bytes:
    """The bytes of a datagram of at most ``LONGEST`` bytes on the line."""
    zero = b"\0"
    return zero + cobs.encode(datagram + crc_hqx(datagram, 0xFFFF).to_bytes(_CRC, "little")) + zero


class LineReader:
    """Finds datagrams in what comes over a line. It keeps a frame that is not whole yet, and no more."""

    def __init__(self) -> None:
        self._begun = bytearray()  # since the last zero
        self._skipping = False  # what has come since the last zero is too long for a frame
        self.garbled = 0  # pieces between zeros that are no datagrams
        self.garbled_bytes = 0

    def feed(self, chunk: bytes) -> Iterator[tuple[bytes, int]]:
        """Yields the datagrams that end in a piece of what comes, and how many bytes of the piece follow each."""
        at = 0
        while (end := chunk.find(0, at)) >= 0:
            self._take(chunk[at:end])
            at = end + 1
            datagram = self._whole()
            if datagram is not None:
                yield datagram, len(chunk) - at
        self._take(chunk[at:])

    def _take(self, piece: bytes) -> None:
        if self._skipping or len(self._begun) + len(piece) > _MOST:
            self.garbled_bytes += len(self._begun) + len(piece)
            self._begun.clear()
            self._skipping = True
        else:
            self._begun += piece

    def _whole(self) -> bytes | None:
        """What lies between the last two zeros, if it is a datagram."""
        piece, skipped = bytes(self._begun), self._skipping
        self._begun.clear()
        self._skipping = False
        if not piece and not skipped:
            return None  # the zero at the end of a frame, and that at the beginning of the next
        if not skipped:
            try:
                content = cobs.decode(piece)
            except cobs.DecodeError:
                content = b""
            datagram = content[:-_CRC]
            if len(content) > _CRC and crc_hqx(datagram, 0xFFFF) == int.from_bytes(content[-_CRC:], "little"):
                return datagram
            self.garbled_bytes += len(piece)
        self.garbled += 1
        return None
