"""A flight from above as pixels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dtsa_agent.core import Scenario
from dtsa_bench.drawing.flight_paths import paint
from dtsa_bench.drawing.style import style


def from_above(
    scenario: Scenario, positions: NDArray[np.float64], crash: Sequence[int] | None = None
) -> NDArray[np.uint8]:
    """The paths so far.

    :param scenario: starts, targets and movers.
    :param positions: (T, 3, N) m, frame map.
    :param crash: ids of two agents that crashed.
    :returns: (480, 480, 3), red, green and blue.
    """
    with style():
        figure = Figure(figsize=(4.8, 4.8), dpi=100, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        paint(figure.add_subplot(), positions, scenario.moving, crash=crash)
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
