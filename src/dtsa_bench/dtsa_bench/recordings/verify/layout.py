"""Messages of known shape as CDR bytes, fast, and where in them the unused bytes between aligned fields lie.

Fast CDR leaves padding as it happens to be, so recorded and expected bytes may differ there and nowhere else.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_HEADER = 4  # bytes before the body: representation and options
_NUMBERS = {
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "<i2",
    "uint16": "<u2",
    "int32": "<i4",
    "uint32": "<u4",
    "int64": "<i8",
    "uint64": "<u8",
    "float32": "<f4",
    "float64": "<f8",
}
_BASE, _NAME, _SEQUENCE = 1, 2, 4  # rosbags' Nodetype


class _Walk:
    """Goes over a message as CDR lays it out: which bytes are used, and where numbers lie."""

    def __init__(self, store: Any) -> None:
        self.store, self.at = store, 0
        self.used: list[tuple[int, int]] = []
        self.numbers: dict[str, tuple[int, int, np.dtype[Any]]] = {}  # path: (start, count, type)

    def _take(self, size: int, align: int) -> int:
        self.at += -self.at % align
        start = self.at
        self.used.append((start, start + size))
        self.at += size
        return start

    def message(self, kind: str, value: Any, prefix: str = "") -> None:
        for name, (node, spec) in self.store.fielddefs[kind][1]:
            self._field(f"{prefix}{name}", int(node), spec, getattr(value, name))

    def _field(self, path: str, node: int, spec: Any, value: Any) -> None:
        if node == _NAME:
            self.message(spec, value, f"{path}.")
        elif node == _BASE:
            self._base(path, spec[0], value)
        else:
            (inner, kind), _ = spec
            if node == _SEQUENCE:
                self._take(4, 4)
            if int(inner) == _BASE and kind[0] in _NUMBERS:
                self._numbers(path, kind[0], len(value))
            else:
                for item in value:
                    self._field(path, int(inner), kind, item)

    def _base(self, path: str, kind: str, value: Any) -> None:
        if kind in _NUMBERS:
            self._numbers(path, kind, 1)
        else:
            self._take(4, 4)
            self._take(len(value.encode()) + 1, 1)

    def _numbers(self, path: str, kind: str, count: int) -> None:
        dtype = np.dtype(_NUMBERS[kind])
        start = self._take(dtype.itemsize * count, dtype.itemsize) if count else self.at
        self.numbers[path] = start, count, dtype


class Layout:
    """Several messages of one type with all their arrays and strings of the same lengths, filled together.

    :param example: a message of that shape; its bytes are the template.
    """

    def __init__(self, store: Any, kind: str, example: Any, rows: int = 1) -> None:
        walk = _Walk(store)
        walk.message(kind, example)
        template = np.frombuffer(bytes(store.serialize_cdr(example, kind)), dtype=np.uint8)
        self.size = template.size
        self._bytes = np.tile(template, rows)
        self.mask: NDArray[np.uint8] = np.zeros(self.size, dtype=np.uint8)  # 0xFF: used, 0: padding
        self.mask[:_HEADER] = 0xFF
        for start, end in walk.used:
            self.mask[_HEADER + start : _HEADER + end] = 0xFF
        self._numbers = {
            path: np.ndarray((rows, count), dtype, self._bytes.data, _HEADER + start, (self.size, dtype.itemsize))
            for path, (start, count, dtype) in walk.numbers.items()
        }

    def fill(self, path: str, value: Any) -> None:
        """Writes a number or an array of numbers into the messages."""
        self._numbers[path][...] = value

    def data(self) -> list[bytes]:
        """The messages as they have been filled."""
        whole = self._bytes.tobytes()
        return [whole[at : at + self.size] for at in range(0, len(whole), self.size)]


def equal_but_padding(recorded: bytes, expected: bytes, mask: NDArray[np.uint8]) -> bool:
    """Whether two messages differ at most in unused bytes."""
    if len(recorded) != len(expected) or len(expected) != mask.size:
        return False
    different = np.frombuffer(recorded, dtype=np.uint8) ^ np.frombuffer(expected, dtype=np.uint8)
    return not (different & mask).any()
