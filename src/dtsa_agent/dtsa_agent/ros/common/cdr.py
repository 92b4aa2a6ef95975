"""Messages as plain CDR, little endian, and how frames and receiver bits lie in them. Needs no ROS.

rclpy makes an object of every field of a message, one by one: 14 us a message, in place of 2 us. A struct packs and
unpacks all fields of a message at once.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from functools import lru_cache
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

REPRESENTATION = b"\x00\x01\x00\x00"  # stands before each body: plain CDR, little endian
_FRAME = (4, b"map\0")  # frame_id of a header: length and text
SECOND = 1_000_000_000  # ns
_HEADER, _HEADER_VALUES = 16, 5  # bytes of a header in that frame, and values of a struct with the representation
_COUNT = struct.Struct("<I")
_MOST_KEPT = 512  # layouts of messages of a kind

# Where the run's id lies in the messages that carry one, as CDR: after 4 bytes of representation and a header in frame
# "map". It is random, and so outside all that is compared between flights.
RUN_BYTES = slice(20, 24)
_WITH_RUN = "Slot Transmission Frame Report Configuration RunStatus SlotRecord"
RUN_MESSAGES = frozenset(f"dtsa_msgs/msg/{name}" for name in _WITH_RUN.split())


def ns_of(stamp: Any) -> int:
    """Return the time of a builtin_interfaces/Time, of ROS or of another decoder, ns."""
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


class CdrMessage:
    """Messages of numbers and of sequences of numbers, behind a header in frame ``map``.

    Sequences are packed and read as the bytes of their elements. Messages whose sequences have the same lengths share
    a struct; which one a message needs is known by its length, as a rule.

    :param fields: by name, in the message's order: a letter as in :mod:`struct`, with ``*`` before that of a sequence.
        There are two sequences or more.
    """

    def __init__(self, fields: Mapping[str, str]) -> None:
        self.fields = tuple(fields)
        self._codes = tuple(fields.values())
        #: Of the elements, as NumPy has it, by field.
        self.kinds = tuple(f"<{code[-1]}" for code in self._codes)
        self._sizes = tuple(struct.calcsize(kind) for kind in self.kinds)
        self._sequences_of = itemgetter(*(at for at, code in enumerate(self._codes) if code[0] == "*"))
        # A header is five of a struct's values, a number one, a sequence two: number of elements, and these.
        place, values, counts = _HEADER_VALUES, [], []
        for code in self._codes:
            if code[0] == "*":
                counts.append(place)
                place += 1
            values.append(place)
            place += 1
        self._values_of, self._fixed_of = itemgetter(1, 2, *values), itemgetter(0, 3, 4, *counts)
        self._in_order = itemgetter(*np.argsort([*range(_HEADER_VALUES), *values, *counts]).tolist())
        self._layout = lru_cache(_MOST_KEPT)(self._make_layout)
        self._known: dict[int, tuple[struct.Struct, tuple[Any, ...]]] = {}  # by the message's length

    def _make_layout(self, lengths: Sequence[int]) -> tuple[struct.Struct, tuple[int, ...]]:
        """Return a struct for sequences of these lengths (bytes), and how many elements they have."""
        layout, left, counts = "<4siII4s", iter(lengths), []
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
        """Return the message as CDR: the header's stamp in ns, and the fields in their order.

        Fields are numbers, and bytes of sequences.
        """
        layout, counts = self._layout(tuple([len(value) for value in self._sequences_of(values)]))
        given = REPRESENTATION, *divmod(time_ns, SECOND), *_FRAME, *values, *counts
        return layout.pack(*self._in_order(given))

    def read(self, data: bytes) -> tuple[Any, ...] | None:
        """Return seconds and ns of the header's stamp, and the fields as :meth:`pack` takes them.

        None if the message is not laid out like this.
        """
        known = self._known.get(len(data))
        if known is not None:
            values = known[0].unpack_from(data)
            if self._fixed_of(values) == known[1]:
                return self._values_of(values)
        lengths = self._lengths(data)
        if lengths is None:
            return None
        layout, counts = self._layout(lengths)
        values, fixed = layout.unpack_from(data), (REPRESENTATION, *_FRAME, *counts)
        if self._fixed_of(values) != fixed:
            return None
        if len(self._known) >= _MOST_KEPT:
            self._known.clear()
        self._known[len(data)] = layout, fixed
        return self._values_of(values)

    def _lengths(self, data: bytes) -> tuple[int, ...] | None:
        """Return the bytes of each sequence; None if the message ends before them. rclpy leaves bytes behind them."""
        body, at, lengths = memoryview(data)[len(REPRESENTATION) :], _HEADER, []
        for code, size in zip(self._codes, self._sizes, strict=True):
            if code[0] == "*":
                at += -at % _COUNT.size + _COUNT.size
                count = int.from_bytes(body[at - _COUNT.size : at], "little")
                lengths.append(count * size)
                at += (-at % size if count else 0) + count * size
            else:
                at += -at % size + size
        return tuple(lengths) if at <= len(body) else None


def _gap(layout: str, size: int) -> str:
    """Return what stands in a struct between what it has so far and a field that is aligned to its size."""
    return "x" * (-(struct.calcsize(layout) - len(REPRESENTATION)) % size)


# Covariances are row-major 6 x 6 over (x, y, z, rotation about x, y, z), in m^2 and rad^2, (m/s)^2 and (rad/s)^2. Zeros
# would mean that a value is exact.
PRECISION = 1e-6  # m^2 or (m/s)^2: a millimetre, a millimetre per second
UNKNOWN = 1e6  # nothing is known about this value


def diagonal(linear: float, angular: float) -> NDArray[np.float64]:
    """Return a covariance without correlations, (36,), by the variances of the first and of the last three values."""
    return np.diag([linear] * 3 + [angular] * 3).ravel()


POSE_COVARIANCE = TWIST_COVARIANCE = diagonal(PRECISION, UNKNOWN)  # of simulated bodies: the attitude is not modelled


def without_run(data: bytes | memoryview) -> bytes:
    """Return a message of :data:`RUN_MESSAGES`, as CDR, with the run's id blanked."""
    return b"".join((data[: RUN_BYTES.start], bytes(4), data[RUN_BYTES.stop :]))


def pack_received(mask: NDArray[np.bool_]) -> bytes:
    """Return the field ``received``, one bit an agent and frame, of a mask (F, N) by frame and agent."""
    return np.packbits(mask, axis=1, bitorder="little").tobytes()


def unpack_received(data: bytes | memoryview, frames: int, agents: int) -> NDArray[np.uint8]:
    """Return the mask (F, N), 0 or 1, that :func:`pack_received` packed; ValueError: the length does not fit."""
    rows = np.frombuffer(data, dtype=np.uint8).reshape(frames, (agents + 7) // 8)
    return np.unpackbits(rows, axis=1, count=agents, bitorder="little")


def split_frames(data: bytes | memoryview, lengths: Sequence[int]) -> list[bytes]:
    """Return the frames that lie one after the other in ``data``, by their lengths in bytes; 0 gives an empty one.

    ValueError: the lengths do not add up to the data.
    """
    frames, at, whole = [], 0, bytes(data)
    for length in lengths:
        frames.append(whole[at : at + length])
        at += length
    if at != len(whole):
        raise ValueError(f"{len(whole)} bytes of frames, {at} in their lengths")
    return frames
