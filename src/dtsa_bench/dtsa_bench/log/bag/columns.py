"""Turns many CDR messages of one type into NumPy columns.

Messages of a run mostly have the same layout: the same lengths of all strings and sequences. The layout
is worked out on one message; all others whose length fields agree with it are then cut into columns at
once.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from .errors import BagError

BATCH = 2048  # messages that are cut at once
_LENGTH = struct.Struct("<I")
_DTYPES = {"bool": "?", "byte": "u1", "char": "u1", "float32": "<f4", "float64": "<f8"}
_DTYPES |= {f"{sign}int{bits}": f"<{sign or 'i'}{bits // 8}" for sign in ("", "u") for bits in (8, 16, 32, 64)}
STRING = "string"


class Leaf(NamedTuple):
    """One column's place in messages of one layout."""

    name: str
    dtype: str  # NumPy dtype, or STRING
    offsets: tuple[int, ...]  # of its values; one value a string, else only the first
    many: int  # number of values; -1: a single value, not an array
    sizes: tuple[int, ...] = ()  # bytes of each string


class _Walker:
    """Works the layout of one message out."""

    def __init__(self, store: Typestore, data: bytes, wanted: Collection[str] | None) -> None:
        self._store, self._data, self._wanted = store, data, wanted
        self._position = 4  # after the encapsulation header
        self.leaves: list[Leaf] = []
        self.lengths: list[int] = []  # offsets of all length fields

    def message(self, kind: str, prefix: str, keep: bool) -> None:
        for name, description in self._store.fielddefs[kind][1]:
            self._field(description, f"{prefix}{name}", keep)
        if self._position > len(self._data):
            raise ValueError("it is too short")

    def _align(self, size: int) -> None:
        self._position += -(self._position - 4) % size

    def _length(self) -> int:
        self._align(4)
        (value,) = _LENGTH.unpack_from(self._data, self._position)
        self.lengths.append(self._position)
        self._position += 4
        if value > len(self._data):
            raise ValueError("a length in it is too large")
        return int(value)

    def _keep(self, leaf: Leaf, keep: bool) -> None:
        if keep and (self._wanted is None or leaf.name in self._wanted):
            self.leaves.append(leaf)

    def _strings(self, name: str, count: int, keep: bool) -> None:
        offsets, sizes = [], []
        for _ in range(1 if count < 0 else count):
            size = self._length()
            offsets.append(self._position)
            sizes.append(max(0, size - 1))
            self._position += size
        self._keep(Leaf(name, STRING, tuple(offsets), count, tuple(sizes)), keep)

    def _numbers(self, name: str, code: str, count: int, keep: bool) -> None:
        dtype = np.dtype(_DTYPES[code])
        if count:
            self._align(dtype.itemsize)
        self._keep(Leaf(name, dtype.str, (self._position,), count), keep)
        self._position += dtype.itemsize * abs(count)

    def _values(self, description: tuple[Any, Any], name: str, count: int, keep: bool) -> None:
        """`count` values of one element type; -1: a single one."""
        node, detail = description
        if node == Nodetype.BASE and detail[0] == STRING:
            self._strings(name, count, keep)
        elif node == Nodetype.BASE:
            self._numbers(name, detail[0], count, keep)
        elif count < 0:
            self.message(detail, f"{name}.", keep)
        else:
            for _ in range(count):
                self.message(detail, f"{name}.", False)

    def _field(self, description: tuple[Any, Any], name: str, keep: bool) -> None:
        node, detail = description
        if node == Nodetype.ARRAY:
            self._values(detail[0], name, detail[1], keep)
        elif node == Nodetype.SEQUENCE:
            self._values(detail[0], name, self._length(), keep)
        else:
            self._values(description, name, -1, keep)


class Table:
    """Collects messages of one type and gives them back as columns.

    :param fields: dotted names of the fields to keep; None: all.
    """

    def __init__(self, store: Typestore, kind: str, fields: Collection[str] | None = None) -> None:
        self._store, self._kind, self._fields = store, kind, fields
        self._times = array("q")  # log time and publish time of each message
        self._waiting: list[bytes] = []
        self._blocks: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}  # field: (rows, values)
        self._done = 0

    def add(self, log_time_ns: int, publish_time_ns: int, data: bytes) -> None:
        """Add one message."""
        self._times.extend((log_time_ns, publish_time_ns))
        self._waiting.append(data)
        if len(self._waiting) >= BATCH:
            self._cut()

    def finish(self) -> dict[str, np.ndarray]:
        """All columns; see `Bag.columns`."""
        self._cut()
        times = np.array(self._times, dtype=np.int64).reshape(-1, 2)
        columns: dict[str, np.ndarray] = {"log_time_ns": times[:, 0], "publish_time_ns": times[:, 1]}
        for name, blocks in self._blocks.items():
            columns[name] = self._join(blocks)
        return columns

    def _cut(self) -> None:
        by_size: dict[int, list[int]] = {}
        for index, data in enumerate(self._waiting):
            by_size.setdefault(len(data), []).append(index)
        for size, indexes in by_size.items():
            block = np.frombuffer(b"".join([self._waiting[i] for i in indexes]), np.uint8).reshape(-1, size)
            rows = np.array(indexes)
            while len(rows):
                layout = self._layout(self._waiting[rows[0]])
                places = (np.array(layout.lengths, dtype=int)[:, None] + np.arange(4)).ravel()
                same = (block[:, places] == block[0, places]).all(axis=1)
                self._take(layout.leaves, block[same], rows[same] + self._done)
                block, rows = block[~same], rows[~same]
        self._done += len(self._waiting)
        self._waiting.clear()

    def _layout(self, data: bytes) -> _Walker:
        walker = _Walker(self._store, data, self._fields)
        try:
            if data[:2] != b"\x00\x01":
                raise ValueError("not plain little-endian CDR")
            walker.message(self._kind, "", True)
        except (ValueError, struct.error) as error:
            raise BagError(f"a message of type {self._kind} cannot be decoded: {error}") from None
        return walker

    def _take(self, leaves: list[Leaf], block: np.ndarray, rows: np.ndarray) -> None:
        for leaf in leaves:
            if leaf.dtype == STRING:
                values = _texts(leaf, block)
            else:
                dtype = np.dtype(leaf.dtype)
                start, count = leaf.offsets[0], abs(leaf.many)
                cut = np.ascontiguousarray(block[:, start : start + count * dtype.itemsize])
                values = cut.view(dtype).reshape(len(block), count) if count else np.empty((len(block), 0), dtype)
                if leaf.many < 0:
                    values = values[:, 0]
            self._blocks.setdefault(leaf.name, []).append((rows, values))

    def _join(self, blocks: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        shapes = {values.shape[1:] for _, values in blocks}
        if len(shapes) == 1:
            joined = np.empty((len(self._times) // 2, *shapes.pop()), dtype=blocks[0][1].dtype)
            for rows, values in blocks:
                joined[rows] = values
            return joined
        ragged = np.empty(len(self._times) // 2, dtype=object)
        for rows, values in blocks:
            for row, value in zip(rows.tolist(), values, strict=True):
                ragged[row] = value
        return ragged


def _texts(leaf: Leaf, block: np.ndarray) -> np.ndarray:
    """Strings of one leaf: (M,) for a single one, else (M, k), dtype object."""
    columns = []
    for offset, size in zip(leaf.offsets, leaf.sizes, strict=True):
        raw = np.ascontiguousarray(block[:, offset : offset + size])
        known: dict[bytes, str] = {}
        texts = np.empty(len(block), dtype=object)
        for row, data in enumerate(map(bytes, raw)):
            text = known.get(data)
            if text is None:
                text = known[data] = data.decode("utf-8", "replace")
            texts[row] = text
        columns.append(texts)
    if leaf.many < 0:
        return columns[0]
    return np.stack(columns, axis=1) if columns else np.empty((len(block), 0), dtype=object)
