"""Where the simulated Crazyflies stand at the start."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError

LAYOUTS = ("ellipse", "grid", "line")


def positions(layout: str, count: int, half_axes: tuple[float, float] = (1.2, 2.0)) -> NDArray[np.float64]:
    """Start positions on the floor.

    :param layout: `ellipse` (in the order of their ids, counter-clockwise from the x axis), `grid` or `line`.
    :param count: number of vehicles.
    :param half_axes: m, along x and y.
    :return: (3, count), m, world; z is 0.
    :raises ConfigError: unknown layout.
    """
    a, b = half_axes
    result = np.zeros((3, count))
    if layout == "ellipse":
        angle = 2 * math.pi * np.arange(count) / count
        result[0], result[1] = a * np.cos(angle), b * np.sin(angle)
    elif layout == "grid":
        columns = max(1, math.ceil(math.sqrt(count * a / b)))
        rows = math.ceil(count / columns)
        index = np.arange(count)
        result[0] = _spread(index % columns, columns, a)
        result[1] = _spread(index // columns, rows, b)
    elif layout == "line":
        result[1] = _spread(np.arange(count), count, b)
    else:
        raise ConfigError("layout", layout, "one of " + ", ".join(LAYOUTS))
    return result


def _spread(index: NDArray[np.int64], number: int, half: float) -> NDArray[np.float64]:
    if number == 1:
        return np.zeros(len(index))
    return np.asarray(half * (2 * index / (number - 1) - 1), dtype=np.float64)
