"""Trajectories that were uploaded: the memory that holds them, and how the firmware flies them."""

from __future__ import annotations

import errno
import math
import struct
from dataclasses import dataclass, field

from .planner import Goal, Triple, evaluate

MEMORY_TYPE = 0x12
MEMORY_BYTES = 4096
DEFINITIONS = 10
IN_MEMORY = 1  # the only place that is modelled
POLYNOMIALS, COMPRESSED = 0, 1  # how one is stored
CONTROL_POINTS = (0, 1, 3, 7)  # of a coordinate of a compressed piece, by its kind
SCALES = (1000.0, 1000.0, 1000.0, 1800.0 / math.pi)  # mm and tenths of degrees
PIECE = struct.Struct("<33f")  # coefficients of x, y, z and yaw, constant first, 8 each; then the duration
PACKET_BYTES = 24  # of data, at most, in one answer


@dataclass(frozen=True, slots=True)
class Piece:
    """One piece of a trajectory."""

    axes: tuple[tuple[float, ...], ...]  # x, y, z (m) and yaw (rad), constant first
    duration: float  # s

    def at(self, t: float) -> tuple[Triple, ...]:
        """Value, first and second derivative of x, y, z and yaw at t (s)."""
        return tuple(evaluate(axis, t) for axis in self.axes)


@dataclass(frozen=True, slots=True)
class Trajectory:
    """A trajectory that is flown.

    :param start: s, when it began.
    :param pieces: what it consists of.
    :param timescale: factor: it takes that many times as long as it says.
    :param reverse: from its end to its beginning.
    :param shift: m, by which it was moved to where it was started.
    """

    start: float
    pieces: tuple[Piece, ...]
    timescale: float = 1.0
    reverse: bool = False
    shift: Triple = (0.0, 0.0, 0.0)

    @property
    def duration(self) -> float:
        """How long it takes, s."""
        return self.timescale * sum(piece.duration for piece in self.pieces)

    def goal(self, t: float) -> Goal:
        """Where it leads at t (s); after its end: the end, at rest."""
        left = (t - self.start) / self.timescale
        pieces = self.pieces[::-1] if self.reverse else self.pieces
        for piece in pieces:
            if left <= piece.duration:
                return self._goal(piece, max(left, 0.0), rest=False)
            left -= piece.duration
        return self._goal(pieces[-1], pieces[-1].duration, rest=True)

    def _goal(self, piece: Piece, t: float, *, rest: bool) -> Goal:
        along = -1.0 if self.reverse else 1.0
        x, y, z, yaw = piece.at(piece.duration - t if self.reverse else t)
        axes = (x, y, z)
        px, py, pz = (axis[0] + shift for axis, shift in zip(axes, self.shift, strict=True))
        if rest:
            return Goal((px, py, pz), yaw=yaw[0])
        vx, vy, vz = (along * axis[1] / self.timescale for axis in axes)
        ax, ay, az = (axis[2] / self.timescale**2 for axis in axes)
        return Goal((px, py, pz), (vx, vy, vz), (ax, ay, az), yaw[0])


@dataclass(slots=True)
class TrajectoryMemory:
    """4096 bytes for pieces of trajectories, and what was said about them."""

    data: bytearray = field(default_factory=lambda: bytearray(MEMORY_BYTES))
    defined: dict[int, tuple[int, int, int]] = field(default_factory=dict)  # by id: kind, first byte, number of pieces

    def info(self, data: bytes) -> bytes | None:
        """Answer to a question about the memories: this is the only one."""
        if data[:1] == b"\x01":
            return b"\x01\x01"
        if data[:1] == b"\x02" and len(data) > 1:
            return data[:2] + (struct.pack("<BI8x", MEMORY_TYPE, MEMORY_BYTES) if data[1] == 0 else b"")
        return None

    def read(self, request: bytes) -> bytes:
        """Answer to a request to read."""
        number, address, length = struct.unpack_from("<BIB", request)
        if number != 0 or length > PACKET_BYTES or address + length > MEMORY_BYTES:
            return request[:5] + bytes((errno.EIO,))
        return request[:5] + b"\0" + bytes(self.data[address : address + length])

    def write(self, request: bytes) -> bytes:
        """Answer to a request to write."""
        number, address = struct.unpack_from("<BI", request)
        new = request[5:]
        if number != 0 or address + len(new) > MEMORY_BYTES:
            return request[:5] + bytes((errno.EIO,))
        self.data[address : address + len(new)] = new
        return request[:5] + b"\0"

    def define(self, data: bytes) -> int:
        """What is where in the memory; 0, or an error number of the firmware's."""
        number, place, kind, offset, pieces = struct.unpack_from("<BBBIB", data)
        if number >= DEFINITIONS:
            return errno.ENOEXEC
        self.defined.pop(number, None)
        if place == IN_MEMORY and kind in (POLYNOMIALS, COMPRESSED):
            self.defined[number] = kind, offset, pieces
        return 0

    def compressed(self, number: int) -> bool:
        """Whether a trajectory was defined as compressed.

        :param number: of the trajectory, 0 to 255.
        """
        return self.defined.get(number, (POLYNOMIALS,))[0] == COMPRESSED

    def pieces(self, number: int) -> tuple[Piece, ...] | None:
        """The pieces of a trajectory as they are in the memory now; None: there are none that could be flown.

        :param number: of the trajectory, 0 to 255.
        """
        if number not in self.defined:
            return None
        kind, offset, count = self.defined[number]
        try:
            found = self._expanded(offset) if kind == COMPRESSED else self._plain(offset, count)
        except struct.error:  # beyond the end of the memory
            return None
        finite = all(math.isfinite(v) for piece in found for axis in (*piece.axes, (piece.duration,)) for v in axis)
        return tuple(found) if found and finite else None

    def _plain(self, offset: int, count: int) -> list[Piece]:
        result = []
        for k in range(count):
            values = PIECE.unpack_from(self.data, offset + k * PIECE.size)
            result.append(Piece(tuple(values[8 * axis : 8 * axis + 8] for axis in range(4)), values[32]))
        return result

    def _expanded(self, offset: int) -> list[Piece]:
        """Pieces from control points; each begins where the one before ends."""
        begin = struct.unpack_from("<4h", self.data, offset)
        here = [value / scale for value, scale in zip(begin, SCALES, strict=True)]
        offset += 8
        result = []
        while True:
            kinds, milliseconds = struct.unpack_from("<BH", self.data, offset)
            offset += 3
            if not milliseconds:
                return result
            axes = []
            for axis in range(4):
                form = f"<{CONTROL_POINTS[kinds >> 2 * axis & 3]}h"
                points = struct.unpack_from(form, self.data, offset)
                offset += struct.calcsize(form)
                curve = [here[axis], *(point / SCALES[axis] for point in points)]
                axes.append(_polynomial(curve, milliseconds / 1000))
                here[axis] = curve[-1]
            result.append(Piece(tuple(axes), milliseconds / 1000))


def _polynomial(points: list[float], duration: float) -> tuple[float, ...]:
    """Coefficients (constant first) of a Bezier curve that takes so long (s)."""
    n = len(points) - 1
    return tuple(
        math.comb(n, k) / duration**k * sum((-1) ** (k - i) * math.comb(k, i) * points[i] for i in range(k + 1))
        for k in range(n + 1)
    )
