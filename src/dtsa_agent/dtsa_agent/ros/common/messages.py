"""The messages of a slot as tuples of their fields, to and from CDR; headers and times from integer nanoseconds.

rclpy makes an object of every field of a message, one by one: 14 us a message, in place of 2 us. A struct packs and
unpacks all fields of a message at once.
"""

from __future__ import annotations

import struct
from array import array
from collections import namedtuple
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from operator import itemgetter
from typing import Any, TypeAlias

import numpy as np
from builtin_interfaces.msg import Time
from dtsa_msgs.msg import Frame, Report, Slot, Transmission
from std_msgs.msg import Header

from . import names
from .cdr import REPRESENTATION, SECOND

_PLAIN = REPRESENTATION[:2]  # of the representation; the other bytes say nothing about the layout
_FRAME = names.FRAME.encode() + b"\0"
_HEADER = {"seconds": "i", "nanoseconds": "I", "frame_id": "*B"}
_COUNT = struct.Struct("<I")
_MOST_KEPT = 512  # layouts of messages of a kind
_CODES = {"uint8": "B", "uint16": "H", "uint32": "I", "int64": "q", "double": "d"}
#: The fields of a message under their names there, and ``time_ns``, the stamp of the header. Sequences are the bytes of
#: their elements, but for the ids of agents: an array.
Fields: TypeAlias = Any
_Layout = tuple[struct.Struct, tuple[int, ...]]


class CdrMessage:
    """Messages of numbers and of sequences of numbers behind a header, as plain CDR, little endian.

    What is read has ids in its first sequence. Messages whose sequences have the same lengths share a struct; which one
    a message needs is known by its length, as a rule.

    :param fields: by name, in the message's order: a letter as in :mod:`struct`, with ``*`` before that of a sequence.
    """

    def __init__(self, fields: Mapping[str, str]) -> None:
        self.fields = tuple(fields)
        self._codes = (*_HEADER.values(), *fields.values())
        self._sizes = tuple(struct.calcsize(f"<{code[-1]}") for code in self._codes)
        self.kinds = {name: f"<{code[-1]}" for name, code in fields.items()}  #: of the elements, as NumPy has it
        sequences = [at for at, code in enumerate(self._codes) if code[0] == "*"]
        # A struct has the representation, and the fields; before each sequence the number of its elements.
        places = [1 + at + sum(sequence <= at for sequence in sequences) for at in range(len(self._codes))]
        counts = [places[at] - 1 for at in sequences]
        self._sequences_of, self._counts_of = itemgetter(*sequences), itemgetter(*counts)
        self._values_of = itemgetter(*(place for at, place in enumerate(places) if at != sequences[0]))
        self._in_order = itemgetter(*np.argsort([0, *places, *counts]).tolist())
        self._ids = sequences[1] - len(_HEADER)
        self._make = namedtuple("MessageFields", ("time_ns", *fields))._make  # type: ignore[misc]
        self._layout = lru_cache(_MOST_KEPT)(self._make_layout)
        self._known: dict[int, _Layout] = {}  # by the message's length

    def _make_layout(self, lengths: Sequence[int]) -> _Layout:
        """Return a struct for sequences of these lengths (bytes), and how many elements they have."""
        layout, left, counts = "<2s2x", iter(lengths), []
        for code, size in zip(self._codes, self._sizes, strict=True):
            if code[0] == "*":
                length = next(left)
                counts.append(length // size)
                layout += _gap(layout, _COUNT.size) + "I"
                layout += (_gap(layout, size) if length else "") + f"{length}s"
            else:
                layout += _gap(layout, size) + code
        return struct.Struct(layout), tuple(counts)

    def pack(self, time_ns: int, values: Sequence[Any]) -> bytes:
        """Return a message in frame ``map``: the header's stamp in ns, and the fields in their order.

        Fields are numbers, and bytes of sequences.
        """
        given = *divmod(time_ns, SECOND), _FRAME, *values
        layout, counts = self._layout(tuple([len(value) for value in self._sequences_of(given)]))
        return layout.pack(*self._in_order((_PLAIN, *given, *counts)))

    def pack_fields(self, time_ns: int, **fields: Any) -> bytes:
        """Return a message by the names of its fields."""
        return self.pack(time_ns, [fields[name] for name in self.fields])

    def read_fields(self, data: bytes) -> Fields:
        """Return the fields of a message. Whether they fit together is not checked.

        :raises ValueError: for what is no message of the type.
        """
        layout, counts = self._known.get(len(data)) or self._find_layout(data)
        values = layout.unpack_from(data)
        if self._counts_of(values) != counts:
            values = self._find_layout(data)[0].unpack_from(data)
        if values[0] != _PLAIN:
            raise ValueError("not plain CDR, little endian")
        seconds, ns, *fields = self._values_of(values)
        fields[self._ids] = array("H", fields[self._ids])
        return self._make((seconds * SECOND + ns, *fields))

    def _find_layout(self, data: bytes) -> _Layout:
        """Return the layout of a message by the lengths that stand in it; there may be bytes behind its fields.

        :raises ValueError: if it ends before them.
        """
        body, at, lengths = memoryview(data)[len(REPRESENTATION) :], 0, []
        for code, size in zip(self._codes, self._sizes, strict=True):
            if code[0] == "*":
                at += -at % _COUNT.size + _COUNT.size
                count = int.from_bytes(body[at - _COUNT.size : at], "little")
                lengths.append(count * size)
                at += (-at % size if count else 0) + count * size
            else:
                at += -at % size + size
        if at > len(body):
            raise ValueError(f"{len(data)} bytes, which end before the message does")
        if len(self._known) >= _MOST_KEPT:
            self._known.clear()
        known = self._known[len(data)] = self._layout(tuple(lengths))
        return known

    def arrays(self, fields: Fields) -> Fields:
        """Return the fields with sequences, but for the ids, as flat NumPy arrays."""
        return fields._replace(**{
            name: np.frombuffer(value, self.kinds[name])
            for name, value in zip(self.fields, fields[1:], strict=True)
            if isinstance(value, bytes)
        })  # fmt: skip


def _gap(layout: str, size: int) -> str:
    """Return what stands in a struct between what it has so far and a field that is aligned to its size."""
    return "x" * (-(struct.calcsize(layout) - len(REPRESENTATION)) % size)


def _codes_of(kind: Any) -> Iterator[tuple[str, str]]:
    """Give the fields of a type of dtsa_msgs behind its header, as :class:`CdrMessage` takes them."""
    for name, text in kind.get_fields_and_field_types().items():
        if name != "header":
            yield name, f"*{_CODES[text[9:-1]]}" if text.startswith("sequence<") else _CODES[text]


SLOT, TRANSMISSION, REPORT, FRAME = (CdrMessage(dict(_codes_of(kind))) for kind in (Slot, Transmission, Report, Frame))


def read_report(data: bytes) -> Fields:
    """Return the fields of a dtsa_msgs/Report, sequences as flat arrays; errors as of ``read_fields``."""
    return REPORT.arrays(REPORT.read_fields(data))


def time_of(time_ns: int) -> Time:
    """Return a message's time."""
    seconds, nanoseconds = divmod(time_ns, SECOND)
    return Time(sec=seconds, nanosec=nanoseconds)


def header_of(time_ns: int) -> Header:
    """Return a message's header in frame ``map``."""
    return Header(stamp=time_of(time_ns), frame_id=names.FRAME)
