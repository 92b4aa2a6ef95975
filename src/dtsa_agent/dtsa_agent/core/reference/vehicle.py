"""How a quadcopter answers a velocity command: point mass with first-order response and limited acceleration."""

from __future__ import annotations

from .arithmetic import Vector, minus, norm


def step(
    tau: float, a_max: float, dt: float, position: Vector, velocity: Vector, command: Vector
) -> tuple[Vector, Vector]:
    """Position and velocity after one step: a = (v_cmd - v) / tau, shortened to a_max; v += a dt; p += v dt.

    Semi-implicit Euler: the position moves with the new velocity. Estimator ``intent`` relies on it.

    :param tau: time constant, s.
    :param a_max: largest acceleration (norm), m/s^2.
    :param dt: step, s.
    :param position: m, frame map.
    :param velocity: m/s.
    :param command: commanded velocity, m/s.
    """
    difference = minus(command, velocity)
    a = (difference[0] / tau, difference[1] / tau, difference[2] / tau)
    size = norm(a)
    gain = dt * (a_max / size if size > a_max else 1.0)
    v = (velocity[0] + gain * a[0], velocity[1] + gain * a[1], velocity[2] + gain * a[2])
    return (position[0] + dt * v[0], position[1] + dt * v[1], position[2] + dt * v[2]), v
