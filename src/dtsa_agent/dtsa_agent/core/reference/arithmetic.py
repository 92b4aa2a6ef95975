"""What the bits of a result depend on.

Agents that hear the same must decide the same, so they must compute the same, to the last bit, on every machine:

* Numbers are IEEE 754 doubles. The four operations and the square root are rounded correctly everywhere; nothing else
  is used. ``sin``, ``acos``, ``exp`` and ``pow`` differ in their last bit from one C library to the next.
* No operation is fused with another: ``a * b + c`` is rounded twice.
* Sums have a fixed order, because addition is not associative. Dot products go x, y, z from the left. Long sums have
  four lanes (:func:`sum_in_lanes`), as a processor with vectors computes them.
* The arcsine is a polynomial of our own (:func:`arcsin`).
* What goes over the air is whole steps (:func:`quantise`), so all receivers start from the same numbers.
* Chance is a hash (:func:`mix64`) of the run's key, the slot and the agent: all can compute it, and it has no state.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

Vector = tuple[float, float, float]

ZERO: Vector = (0.0, 0.0, 0.0)

_WORD = 2**64 - 1
_HALF_PI = 1.5707963267948966
INVERSE_PI = 0.31830988618379067154

# arcsin(sqrt z) / sqrt z on [0, 1/4], highest power first: minimax, to 2e-17 relative.
_ARCSIN = (
    0.03187962140081284, -0.016187392271599134, 0.019513468251252167, 0.0065293020047365695, 0.012170138592391726,
    0.01388484282640208, 0.01735977964134998, 0.022371749733164054, 0.03038195969768514, 0.044642856805998936,
    0.07500000000385201, 0.16666666666664942, 1.0,
)  # fmt: skip


def dot(a: Vector, b: Vector) -> float:
    """a . b, summed from the left."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def minus(a: Vector, b: Vector) -> Vector:
    """a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def norm(a: Vector) -> float:
    """|a|."""
    return math.sqrt(dot(a, a))


def norm1(a: Vector) -> float:
    """The sum of the absolute values, from the left."""
    return abs(a[0]) + abs(a[1]) + abs(a[2])


def sum_in_lanes(values: Sequence[float]) -> float:
    """The sum of some numbers, in the one order that all agents use.

    Four running sums take every fourth value each; what does not fill a group of four goes to the first of them.
    """
    lanes = [0.0, 0.0, 0.0, 0.0]
    whole = len(values) // 4 * 4
    for at, value in enumerate(values):
        lanes[at % 4 if at < whole else 0] += value
    return (lanes[0] + lanes[1]) + (lanes[2] + lanes[3])


def arcsin(x: float) -> float:
    """The arcsine, rad, with the same bits on every machine.

    Near 1 the polynomial would need many terms; there arcsin x = pi / 2 - 2 arcsin sqrt((1 - x) / 2) is used.
    """
    a = abs(x)
    steep = a > 0.5
    half = 0.5 * (1.0 - a)
    z = half if steep else a * a
    root = math.sqrt(half) if steep else a
    series = _ARCSIN[0]
    for coefficient in _ARCSIN[1:]:
        series = series * z + coefficient
    angle = root * series
    return math.copysign(_HALF_PI - 2.0 * angle if steep else angle, x)


def quantise(value: float, step: float, bits: int) -> int:
    """A number in whole steps, as a signed integer of some bits: rounded half to even, saturated, never wrapped."""
    top = (1 << (bits - 1)) - 1
    steps = value / step
    if steps > top:
        return top
    if steps < -top - 1:
        return -top - 1
    return round(steps)


def signed(value: int, bits: int) -> int:
    """The signed integer whose two's complement is ``value``."""
    top = 1 << (bits - 1)
    return ((value & (2 * top - 1)) ^ top) - top


def bits_of(x: float) -> int:
    """The 64 bits of a double as a whole number: what digests are made of."""
    return int(struct.unpack("<Q", struct.pack("<d", x))[0])


def mix64(x: int) -> int:
    """64 bits that look random, from any 64 bits (splitmix64)."""
    x = (x + 0x9E3779B97F4A7C15) & _WORD
    x = ((x ^ x >> 30) * 0xBF58476D1CE4E5B9) & _WORD
    x = ((x ^ x >> 27) * 0x94D049BB133111EB) & _WORD
    return x ^ x >> 31


def share_of(draw: int) -> float:
    """A draw as a number from 0 up to 1: its highest 53 bits."""
    return (draw >> 11) * 2.0**-53
