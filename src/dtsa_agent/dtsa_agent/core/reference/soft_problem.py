"""The point nearest to a wish under soft half-spaces; ``orca`` and ``bvc`` need it.

Minimise f(x) = |x - x0|^2 / 2 + rho / 2 sum_j max(0, b_j - n_j.x)^2 over x in three dimensions. f is strongly convex
and piecewise quadratic, so Newton's method with a line search reaches the minimum exactly, as soon as a full step
leaves the set of violated half-spaces as it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from .arithmetic import Vector, dot, minus, scaled

STEPS, HALVINGS = 60, 40


@dataclass(frozen=True, slots=True)
class HalfSpace:
    """Points x with normal.x >= bound; the normal has length 1."""

    normal: Vector
    bound: float

    def lack(self, x: Vector) -> float:
        """How far a point is outside; negative: it is inside.

        :param x: (3,) the point: m/s for ``orca``, m for ``bvc``.
        """
        return self.bound - dot(self.normal, x)


@dataclass(frozen=True, slots=True)
class Pass:
    """f at one point."""

    value: float
    gradient: Vector
    curvature: tuple[Vector, Vector, Vector]  # rows of the second derivative, symmetric
    violated: frozenset[int]  # half-spaces that the point is outside of


def evaluate(x: Vector, wish: Vector, spaces: Sequence[HalfSpace], rho: float) -> Pass:
    """f, its gradient and its curvature: identity + rho sum n n^T over the violated half-spaces.

    :param x: (3,) the point: m/s for ``orca``, m for ``bvc``.
    :param wish: (3,) x0, of the same unit.
    """
    away = minus(x, wish)
    value, gradient = 0.5 * dot(away, away), list(away)
    rows = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    violated = set()
    for index, space in enumerate(spaces):
        lack = space.lack(x)
        if lack <= 0.0:
            continue
        violated.add(index)
        value += 0.5 * rho * lack * lack
        for i in range(3):
            gradient[i] -= rho * lack * space.normal[i]
            for j in range(3):
                rows[i][j] += rho * space.normal[i] * space.normal[j]
    a, b, c = ((row[0], row[1], row[2]) for row in rows)
    return Pass(value, (gradient[0], gradient[1], gradient[2]), (a, b, c), frozenset(violated))


def cross(a: Vector, b: Vector) -> Vector:
    """a x b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def newton_step(curvature: tuple[Vector, Vector, Vector], gradient: Vector) -> Vector:
    """Minus the inverse of the curvature times the gradient, by Cramer's rule; the matrix is at least the identity."""
    a, b, c = curvature
    scale = -1.0 / dot(a, cross(b, c))
    cofactors = (cross(b, c), cross(c, a), cross(a, b))
    return scaled(scale, (dot(cofactors[0], gradient), dot(cofactors[1], gradient), dot(cofactors[2], gradient)))


def moved(x: Vector, share: float, step: Vector) -> Vector:
    """x + share step."""
    return (x[0] + share * step[0], x[1] + share * step[1], x[2] + share * step[2])


def minimise(wish: Vector, spaces: Sequence[HalfSpace], rho: float) -> Vector:
    """The minimiser of f.

    :param wish: x0.
    :param spaces: the half-spaces.
    :param rho: weight of a violated one.
    """
    x = wish
    here = evaluate(x, wish, spaces, rho)
    if not here.violated:
        return x
    for _ in range(STEPS):
        step = newton_step(here.curvature, here.gradient)
        slope = dot(step, here.gradient)
        if -slope <= 1e-28:
            return x
        share, noise = 1.0, 1e-15 * (1.0 + here.value)
        for _ in range(HALVINGS + 1):
            to = moved(x, share, step)
            there = evaluate(to, wish, spaces, rho)
            if there.value <= here.value + 1e-4 * share * slope + noise:
                break
            share *= 0.5
        x = to
        if share == 1.0 and there.violated == here.violated:
            # The minimiser of this piece; once more with its own gradient removes the rounding of the first step.
            return moved(x, 1.0, newton_step(here.curvature, there.gradient))
        here = there
    return x
