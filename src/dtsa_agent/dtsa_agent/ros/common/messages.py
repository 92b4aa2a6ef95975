"""The messages of a slot as tuples of their fields, and headers and times from integer nanoseconds."""

from __future__ import annotations

from array import array
from collections import namedtuple
from typing import Any, TypeAlias

import numpy as np
from builtin_interfaces.msg import Time
from dtsa_msgs.msg import Report, Slot, Transmission
from rclpy.serialization import deserialize_message
from std_msgs.msg import Header

from . import names
from .cdr import SECOND, CdrMessage

_CODES = {"uint8": "B", "uint16": "H", "uint32": "I", "int64": "q", "double": "d"}
#: The fields of a message under their names there, and ``time_ns``, the stamp of the header. Sequences are the bytes of
#: their elements, but for the ids of agents: an array.
Fields: TypeAlias = Any


class MessageType(CdrMessage):
    """A type of dtsa_msgs whose first sequence is one of ids."""

    def __init__(self, kind: Any) -> None:
        types = dict(kind.get_fields_and_field_types())
        del types["header"]
        codes = {
            name: f"*{_CODES[text[9:-1]]}" if text.startswith("sequence<") else _CODES[text]
            for name, text in types.items()
        }
        super().__init__(codes)
        self._kind = kind
        self._ids = next(at for at, code in enumerate(codes.values(), 1) if code[0] == "*")
        self._fields = namedtuple(f"{kind.__name__}Fields", ("time_ns", *codes))  # type: ignore[misc]

    def read_fields(self, data: bytes) -> Fields:
        """Return the fields of a message. Whether they fit together is not checked.

        :raises Exception: of any kind, as rclpy does, for what is no message of the type.
        """
        values = self.read(data)
        return self.fields_of(deserialize_message(data, self._kind)) if values is None else self._make_fields(*values)

    def fields_of(self, message: Any) -> Fields:
        """Return the fields of a message as rclpy has it."""
        values = (getattr(message, name) for name in self.fields)
        stamp = message.header.stamp
        return self._make_fields(stamp.sec, stamp.nanosec, *(v if isinstance(v, int) else v.tobytes() for v in values))

    def _make_fields(self, seconds: int, ns: int, *values: Any) -> Fields:
        fields, at = [seconds * SECOND + ns, *values], self._ids
        fields[at] = array("H", fields[at])
        return self._fields._make(fields)

    def arrays(self, fields: Fields) -> Fields:
        """Return the fields with sequences as flat NumPy arrays."""
        return fields._replace(**{
            name: np.frombuffer(value, kind)
            for name, kind, value in zip(self.fields, self.kinds, fields[1:], strict=True)
            if isinstance(value, bytes)
        })  # fmt: skip

    def pack_fields(self, time_ns: int, **fields: Any) -> bytes:
        """Return a message as CDR by its fields: numbers, and bytes of sequences."""
        return self.pack(time_ns, [fields[name] for name in self.fields])


SLOT, TRANSMISSION, REPORT = MessageType(Slot), MessageType(Transmission), MessageType(Report)


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
