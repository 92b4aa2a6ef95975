"""Piecewise polynomial trajectories: what can be uploaded to a Crazyflie, and where and how fast one leads.

The firmware keeps them in 4096 bytes, a piece in 132 of them: eight coefficients (constant first) each of x, y, z in m
and yaw in rad, then the duration in s. Up to ten trajectories have a number and a place in that memory. One with more
than 31 pieces is stored as the firmware's compressed kind: control points of Bezier curves in mm and tenths of degrees,
durations in ms.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.crazyflie.settings.config import StationSettings
from dtsa_agent.crazyflie.state.conversions import Vector, place_text

from .limits import outside_fence

COEFFICIENTS = 8
PIECE_BYTES = (4 * COEFFICIENTS + 1) * 4
MEMORY_BYTES = 4096
DEFINITIONS = 10  # numbers of trajectories: 0 to 9
PLAIN, COMPRESSED = 0, 1  # the firmware's names for how one is stored
DEGREE = COEFFICIENTS - 1
MM, DECIDEGREES = 1000.0, 1800.0 / math.pi  # a metre and a radian in control points
FULL = 3  # kind of a coordinate with seven control points after the first; 0: none, it stays
SAMPLES = 100  # of each piece
EVERY_S, MOST_TIMES = 0.05, 5000  # of several that are compared
STEP_M = 0.5  # the firmware flies a step between two pieces as fast as it can: a larger one is refused
START_M = 0.5  # farther from where the vehicle is no trajectory begins


@dataclass(frozen=True, slots=True)
class Piece:
    """One piece of a trajectory.

    :raises ValueError: there are not eight finite coefficients each, or no time for it.
    """

    x: tuple[float, ...]  # m, coefficients of powers of the time (s) since its beginning, constant first
    y: tuple[float, ...]
    z: tuple[float, ...]
    yaw: tuple[float, ...]  # rad
    duration: float  # s

    def __post_init__(self) -> None:
        for axis in ("x", "y", "z", "yaw"):
            values = getattr(self, axis)
            if len(values) != COEFFICIENTS:
                raise ValueError(f"{axis} has {len(values)} coefficients, not {COEFFICIENTS}")
            if not all(map(math.isfinite, values)):
                raise ValueError(f"a coefficient of {axis} is not finite")
        if not 0.0 < self.duration < math.inf:
            raise ValueError(f"a duration of {self.duration:g} s")

    def packed(self) -> bytes:
        """Its bytes in the Crazyflie's memory."""
        return struct.pack("<33f", *self.x, *self.y, *self.z, *self.yaw, self.duration)


@dataclass(frozen=True, slots=True)
class Trajectory:
    """A trajectory in a Crazyflie's memory.

    :param number: by which it is started, 0 to 9.
    :param offset: number of pieces before it in the memory.
    :param pieces: what it consists of.
    :raises ValueError: it does not fit, or jumps.
    """

    number: int
    offset: int
    pieces: tuple[Piece, ...]

    def __post_init__(self) -> None:
        if not 0 <= self.number < DEFINITIONS:
            raise ValueError(f"trajectory {self.number}: numbers are 0 to {DEFINITIONS - 1}")
        if not self.pieces:
            raise ValueError(f"trajectory {self.number}: it has no pieces")
        try:
            size = len(self.packed())
        except (OverflowError, struct.error) as error:
            raise ValueError(f"trajectory {self.number}: a number that is too large to be stored") from error
        if self.begin + size > MEMORY_BYTES:
            wanted = f"its {len(self.pieces)} pieces take {size} bytes behind {self.begin} others"
            raise ValueError(f"trajectory {self.number}: {wanted}; there are {MEMORY_BYTES}")
        places, speeds = _sampled(self.pieces)
        if not (np.isfinite(places).all() and np.isfinite(speeds).all()):
            raise ValueError(f"trajectory {self.number}: it leads nowhere")
        steps = np.linalg.norm(places[1:, 0] - places[:-1, -1], axis=1)
        if len(steps) and steps.max() > STEP_M:
            raise ValueError(
                f"trajectory {self.number}: piece {int(steps.argmax()) + 1} begins {steps.max():.2f} m from the end "
                "of the one before"
            )

    @property
    def duration(self) -> float:
        """How long it takes, s."""
        return sum(piece.duration for piece in self.pieces)

    @property
    def begin(self) -> int:
        """Its first byte in the memory."""
        return self.offset * PIECE_BYTES

    @property
    def kind(self) -> int:
        """How it is stored: `PLAIN`, or `COMPRESSED` if there is no room for that."""
        return PLAIN if self.begin + len(self.pieces) * PIECE_BYTES <= MEMORY_BYTES else COMPRESSED

    def packed(self) -> bytes:
        """Its bytes in the Crazyflie's memory."""
        return b"".join(piece.packed() for piece in self.pieces) if self.kind == PLAIN else _compressed(self.pieces)

    def flown(self) -> tuple[Piece, ...]:
        """What the firmware makes of it: of a compressed one each piece begins where the one before ends."""
        if self.kind == PLAIN:
            return self.pieces
        places, _ = _sampled(self.pieces)
        ends = np.vstack([places[:1, 0], places[:-1, -1]])
        result = []
        for piece, end, start in zip(self.pieces, ends, places[:, 0], strict=True):
            bend = [math.comb(DEGREE, k) * (-1 / piece.duration) ** k for k in range(COEFFICIENTS)]  # (1 - t/T)^7
            axes = []
            for axis, step in zip((piece.x, piece.y, piece.z), (end - start).tolist(), strict=True):
                axes.append(tuple(c + step * b for c, b in zip(axis, bend, strict=True)))
            result.append(Piece(axes[0], axes[1], axes[2], piece.yaw, piece.duration))
        return tuple(result)

    def overlaps(self, other: Trajectory) -> bool:
        """Whether another one takes bytes of its memory."""
        return self.begin < other.begin + len(other.packed()) and other.begin < self.begin + len(self.packed())


def _compressed(pieces: Sequence[Piece]) -> bytes:
    """Pieces as the firmware's compressed kind: where the first one begins, then each, then an end without duration."""
    scales = (MM, MM, MM, DECIDEGREES)
    first = pieces[0]
    here = [round(axis[0] * scale) for axis, scale in zip((first.x, first.y, first.z, first.yaw), scales, strict=True)]
    data = struct.pack("<4h", *here)
    for piece in pieces:
        kinds, body = 0, b""
        for i, axis in enumerate((piece.x, piece.y, piece.z, piece.yaw)):
            points = [round(value * scales[i]) for value in control_points(axis, piece.duration)]
            if any(point != here[i] for point in points):
                kinds |= FULL << 2 * i
                body += struct.pack("<7h", *points[1:])  # the first one is the last one of the piece before
                here[i] = points[-1]
        data += struct.pack("<BH", kinds, max(1, round(piece.duration * 1000))) + body
    return data + struct.pack("<BH", 0, 0)


def control_points(coefficients: Sequence[float], duration: float) -> list[float]:
    """Control points of the Bezier curve that is a polynomial of degree 7 from 0 to `duration` (s)."""
    scaled = [c * duration**k for k, c in enumerate(coefficients)]
    return [sum(math.comb(i, k) / math.comb(DEGREE, k) * scaled[k] for k in range(i + 1)) for i in range(COEFFICIENTS)]


def why_not(
    trajectory: Trajectory, here: Vector, station: StationSettings, timescale: float, *, reverse: bool, relative: bool
) -> str:
    """Why a trajectory must not be started; empty if it may.

    :param here: m, world, where the vehicle is.
    :param timescale: factor: it takes that many times as long as it says.
    :param reverse: from its end to its beginning.
    :param relative: moved so that it begins where the vehicle is.
    """
    if not 0.0 < timescale < math.inf:
        return f"trajectory {trajectory.number}: a timescale of {timescale:g}"
    if trajectory.kind == COMPRESSED and (reverse or timescale != 1.0):
        return f"trajectory {trajectory.number}: one of so many pieces is flown forwards and at its own pace only"
    places, speeds = _sampled(trajectory.flown())
    start = places[-1, -1] if reverse else places[0, 0]
    if relative:
        places = places + (np.asarray(here) - start)
    elif (away := math.dist(start, here)) > START_M:
        beginning = f"{place_text(_vector(start))} in the world, {away:.2f} m from here"
        return f"trajectory {trajectory.number} begins at {beginning}: go there first"
    speed = float(speeds.max()) / timescale
    if speed > station.max_stream_mps:
        return (
            f"trajectory {trajectory.number} reaches {speed:.2f} m/s (station.max_stream_mps is "
            f"{station.max_stream_mps:g})"
        )
    flat = places.reshape(-1, 3)
    for corner in (*flat.argmin(axis=0), *flat.argmax(axis=0)):
        if problem := outside_fence(_vector(flat[corner]), station):
            return f"trajectory {trajectory.number}: {problem}"
    return ""


@dataclass(frozen=True, slots=True)
class Planned:
    """A trajectory that a vehicle is about to fly. Parameters as for `why_not`."""

    name: str  # the vehicle's
    trajectory: Trajectory
    here: Vector
    timescale: float
    reverse: bool
    relative: bool

    @property
    def duration(self) -> float:
        """How long it takes, s."""
        return self.trajectory.duration * self.timescale

    def places(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 3) m, world: where it leads at times (s) since its beginning; after its end: its end."""
        pieces = self.trajectory.flown()
        ends = np.cumsum([piece.duration for piece in pieces])
        t = np.clip(times / self.timescale, 0.0, ends[-1])
        t = ends[-1] - t if self.reverse else t
        index = np.minimum(np.searchsorted(ends, t), len(pieces) - 1)
        since = (t - np.concatenate([[0.0], ends[:-1]])[index])[:, None]
        coefficients = np.array([(piece.x, piece.y, piece.z) for piece in pieces])[index]
        places = np.zeros((len(times), 3))
        for power in range(COEFFICIENTS - 1, -1, -1):
            places = places * since + coefficients[:, :, power]
        return places + (np.asarray(self.here) - places[0]) if self.relative else places


def meeting(planned: Sequence[Planned], hovering: Mapping[str, Vector], least_m: float) -> str:
    """Who would come too close to whom if all started now; empty: nobody.

    :param planned: what is flown. :param hovering: m, world: where others hover, by name.
    :param least_m: m, smallest distance.
    """
    longest = max((plan.duration for plan in planned), default=0.0)
    times = np.linspace(0.0, longest, min(MOST_TIMES, max(2, round(longest / EVERY_S))))
    names = [*(plan.name for plan in planned), *hovering]
    ways = [plan.places(times) for plan in planned] + [np.tile(place, (len(times), 1)) for place in hovering.values()]
    for a in range(len(planned)):
        for b in range(a + 1, len(ways)):
            gaps = np.linalg.norm(ways[a] - ways[b], axis=1)
            if gaps.min() < least_m:
                when = float(times[gaps.argmin()])
                return f"{names[a]} and {names[b]} would come within {gaps.min():.2f} m after {when:.1f} s"
    return ""


def _vector(place: NDArray[np.float64]) -> Vector:
    return float(place[0]), float(place[1]), float(place[2])


def _sampled(pieces: Sequence[Piece]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places (m; piece, sample, axis) and speeds (m/s; piece, sample) of a trajectory at its own pace."""
    coefficients = np.array([(piece.x, piece.y, piece.z) for piece in pieces])  # piece, axis, power
    t = np.array([piece.duration for piece in pieces])[:, None] * np.linspace(0.0, 1.0, SAMPLES)
    places = np.zeros((len(pieces), SAMPLES, 3))
    velocities = np.zeros_like(places)
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused
        for power in range(COEFFICIENTS - 1, -1, -1):  # Horner's scheme for the value and its derivative
            velocities = velocities * t[:, :, None] + places
            places = places * t[:, :, None] + coefficients[:, None, :, power]
        return places, np.linalg.norm(velocities, axis=2)
