"""How close agents came to each other in a run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_bench.log.arrays import swarm_section
from dtsa_bench.log.flight_log import FlightLog
from dtsa_bench.pages.html import reduce_bins, thin

MAX_CRASHES = 50  # that are shown
PAIRS = 5  # closest pairs whose distance is drawn
BLOCK = 512  # moments whose pair distances are computed at once

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Distances:
    """Distances of all pairs of agents over time."""

    time_s: Array  # (T,)
    least: Array  # (T,) m, of all pairs
    pairs: list[tuple[int, int]]  # ids, the closest first
    series: list[Array]  # (T,) m, one a pair
    crashes: list[tuple[int, int, int]]  # ids, and the first moment at which they were too close: index of time_s


def pair_distances(run: FlightLog, collision_m: float = 0.2) -> Distances | None:
    """Distances at the recorded moments, and pairs below `collision_m`; None with fewer than two agents."""
    time_s, path = run.instants_s, run.path
    if run.agents < 2 or not len(time_s):
        return None
    first, second = np.triu_indices(run.agents, 1)
    least = np.empty(len(time_s))
    closest = np.full(len(first), np.inf)
    touched = np.full(len(first), -1)
    for start in range(0, len(least), BLOCK):
        place = path[start : start + BLOCK]
        apart = np.sqrt(((place[:, :, first] - place[:, :, second]) ** 2).sum(axis=1))
        apart[np.isnan(apart)] = np.inf
        least[start : start + BLOCK] = apart.min(axis=1)
        np.minimum(closest, apart.min(axis=0), out=closest)
        near = apart < collision_m
        new = near.any(axis=0) & (touched < 0)
        touched[new] = start + near[:, new].argmax(axis=0)
    chosen = [k for k in np.argsort(closest, kind="stable")[:PAIRS].tolist() if math.isfinite(closest[k])]
    if not chosen:
        return None  # no two agents of whom it is known where they were
    ids = np.stack((first, second), axis=1) + 1
    series = [np.sqrt(((path[:, :, first[k]] - path[:, :, second[k]]) ** 2).sum(axis=1)) for k in chosen]
    crashes = [(*ids[k].tolist(), int(touched[k])) for k in np.argsort(touched, kind="stable") if touched[k] >= 0]
    return Distances(time_s, least, [tuple(ids[k].tolist()) for k in chosen], series, crashes)


def collision_m(run: FlightLog) -> float:
    """Below this distance two agents have crashed, m."""
    limits = run.settings.get("limits", {})
    return float(limits.get("collision_m", 0.2)) if isinstance(limits, Mapping) else 0.2


def list_crashes(distances: Distances | None, run: FlightLog, summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Which agents crashed, when and where; the first ones if there are many."""
    if distances is None:
        return []
    crashes, path = distances.crashes, run.path
    pair = tuple(summary.get("collided_pair") or ())
    if not crashes and len(pair) == 2:
        # They crashed within a slot, and only its ends were recorded.
        gap = path[:, :, pair[0] - 1] - path[:, :, pair[1] - 1]
        crashes = [(*pair, int(np.nanargmin((gap**2).sum(axis=1))))]
    rows = []
    for first, second, moment in crashes[:MAX_CRASHES]:
        a, b = (path[moment, :, agent - 1] for agent in (first, second))
        rows.append({
            "ids": [first, second], "time_s": round(float(distances.time_s[moment]), 3),
            "place": thin((a + b) / 2, 3), "distance_m": round(float(np.linalg.norm(a - b)), 4),
        })  # fmt: skip
    return rows


def distance_chart(distances: Distances | None, run: FlightLog) -> dict[str, Any] | None:
    """Distances over time as a page shows them, and what they are compared with."""
    if distances is None:
        return None
    return {
        "time": thin(reduce_bins(distances.time_s, np.mean)),
        "least": thin(reduce_bins(distances.least, np.min), 4),
        "pairs": [
            {
                "ids": list(pair),
                "distance": thin(reduce_bins(series, np.nanmin), 4),
                "least": round(float(np.nanmin(series)), 4),
                "time": round(float(distances.time_s[int(np.nanargmin(series))]), 3),
            }
            for pair, series in zip(distances.pairs, distances.series, strict=True)
        ],
        "collision": collision_m(run),
        "r_min": float(swarm_section(run.settings).get("r_min", 0.3) or 0.3),
    }
