"""Layouts of messages as plain CDR, little endian, for what is written and read in every slot.

rclpy makes an object of every field of a message, one by one, which takes longer than all else that an agent does in a
slot. A struct packs and unpacks all fields of a message at once.
"""

from __future__ import annotations

import struct

REPRESENTATION = b"\x00\x01\x00\x00"  # stands before each body: plain CDR, little endian
FRAME = (4, b"map\0")  # frame_id of a header: length and text


class Layout:
    """Collects fields that lie one after the other, for a struct.

    :param start: bytes from the start of the message's body to the first field, or the same modulo 8.
    """

    def __init__(self, start: int = 0) -> None:
        self.end = start
        self._format = "<"

    def header(self) -> Layout:
        """Adds what stands before a body, and a ``std_msgs/Header`` in frame ``map``: five values."""
        self._format += "4s"
        self.numbers("iII")
        self._format += "4s"
        self.end += 4
        return self

    def numbers(self, codes: str) -> Layout:
        """Adds numbers.

        :param codes: one letter each, as in :mod:`struct`.
        """
        for code in codes:
            self._align(struct.calcsize(f"<{code}"))
            self._format += code
            self.end += struct.calcsize(f"<{code}")
        return self

    def elements(self, count: int, size: int) -> Layout:
        """Adds the elements of a sequence, as bytes.

        :param count: number of elements.
        :param size: bytes of each.
        """
        if count:
            self._align(size)
        self._format += f"{count * size}s"
        self.end += count * size
        return self

    def sequence(self, count: int, size: int) -> Layout:
        """Adds the number of elements of a sequence, and the elements as :meth:`elements` does.

        :param count: number of elements.
        :param size: bytes of an element.
        """
        return self.numbers("I").elements(count, size)

    def struct(self) -> struct.Struct:
        """All these fields."""
        return struct.Struct(self._format)

    def _align(self, size: int) -> None:
        gap = -self.end % size
        self._format += "x" * gap
        self.end += gap


def sequence_at(data: bytes, at: int) -> tuple[bytes, int]:
    """Elements of one byte each, and where the number of elements of the next sequence lies.

    :param data: the message.
    :param at: where the number of elements lies.
    :raises struct.error: if the message ends before.
    """
    (count,) = _COUNT.unpack_from(data, at)
    begin = at + _COUNT.size
    end = begin + count
    if end > len(data):
        raise struct.error("a sequence that ends beyond its message")
    return data[begin:end], end + -end % 4


_COUNT = struct.Struct("<I")
