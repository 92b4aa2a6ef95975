"""Whether recorded odometry can be the motion that the agents reported."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.ros.common.graph import names

Report = tuple[int, NDArray[np.float64], float]  # slot; place (3,) in m, frame map; speed in m/s

_PLACE_M = 1e-6  # m, for rounding
_FASTER = 20.0  # m/s^2: no vehicle changes its velocity faster


def odometry_fault(
    times_ns: NDArray[np.int64],
    found: NDArray[np.float64],
    carried: NDArray[np.bool_],
    reports: Sequence[Report],
    slot_ns: int,
) -> tuple[int, float, float] | None:
    """The first row of recorded odometry that an agent's reports rule out.

    Between two reports a vehicle changes its velocity by `_FASTER` at most. Before the first report, and in slots whose
    report came too late, the channel keeps the place that it has.

    :param times_ns: (R,) ns, when each row holds, ascending.
    :param found: (R, 3) m, frame map, the recorded positions.
    :param carried: (R,) rows of slots whose report came too late.
    :returns: index of the row, distance from where it should be and the largest allowed one, m; None: all fit.
    """
    at = names.TIME_ZERO_NS + np.array([slot for slot, _, _ in reports]) * slot_ns
    row = np.clip(np.searchsorted(at, times_ns, "right") - 1, 0, len(at) - 1)
    place, speed = np.array([report[1] for report in reports])[row], np.array([report[2] for report in reports])[row]
    gap = np.abs(times_ns - at[row]) / 1e9
    last = row == len(at) - 1  # an agent that has fallen silent is taken to stay
    allowed = np.where(last, np.inf, _PLACE_M + speed * gap + 0.5 * _FASTER * gap * gap)
    stays = carried | (times_ns < at[0])
    place[stays] = np.concatenate([found[:1], found[:-1]])[stays]
    allowed[stays] = _PLACE_M
    away = np.linalg.norm(found - place, axis=1)
    bad = np.flatnonzero(away > allowed)
    return (int(bad[0]), float(away[bad[0]]), float(allowed[bad[0]])) if len(bad) else None
