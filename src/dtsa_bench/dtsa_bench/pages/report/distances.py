"""How close agents came to each other in a run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_bench.pages.html import reduce_bins, thin
from dtsa_bench.recordings.bag.run import RecordedRun, swarm_section

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


def pair_distances(run: RecordedRun, collision_m: float = 0.2) -> Distances | None:
    """Return the distances at the recorded moments, and pairs below `collision_m`; None with fewer than two agents."""
    motion = run.motion
    count = len(motion.ids)
    if count < 2 or not len(motion.time_ns):
        return None
    first, second = np.triu_indices(count, 1)
    least = np.empty(len(motion.time_ns))
    closest = np.full(len(first), np.inf)
    touched = np.full(len(first), -1)
    for start in range(0, len(least), BLOCK):
        position = motion.position[start : start + BLOCK]
        distance = np.sqrt(((position[:, :, first] - position[:, :, second]) ** 2).sum(axis=1))
        distance[np.isnan(distance)] = np.inf
        least[start : start + BLOCK] = distance.min(axis=1)
        np.minimum(closest, distance.min(axis=0), out=closest)
        near = distance < collision_m
        new = near.any(axis=0) & (touched < 0)
        touched[new] = start + near[:, new].argmax(axis=0)
    chosen = [k for k in np.argsort(closest, kind="stable")[:PAIRS] if math.isfinite(closest[k])]
    series = []
    for k in chosen:
        gap = motion.position[:, :, first[k]] - motion.position[:, :, second[k]]
        series.append(np.sqrt((gap**2).sum(axis=1)))
    ids = motion.ids.tolist()
    pairs = [(ids[first[k]], ids[second[k]]) for k in chosen]
    crashes = [(ids[first[k]], ids[second[k]], int(touched[k])) for k in np.flatnonzero(touched >= 0)]
    crashes.sort(key=lambda crash: crash[2])
    return Distances((motion.time_ns - run.start_ns) / 1e9, least, pairs, series, crashes)


def collision_m(run: RecordedRun) -> float:
    """Below this distance two agents have crashed, m."""
    limits = run.config.get("limits", {})
    return float(limits.get("collision_m", 0.2)) if isinstance(limits, Mapping) else 0.2


def list_crashes(distances: Distances | None, run: RecordedRun, summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the agents, times and places of crashes; the first ones if there are many."""
    if distances is None:
        return []
    crashes = distances.crashes
    pair = tuple(summary.get("collided_pair") or ())
    motion = run.motion
    places = {agent: place for place, agent in enumerate(motion.ids.tolist())}
    if not crashes and len(pair) == 2 and set(pair) <= places.keys():
        # They crashed within a slot, and only its ends were recorded.
        gap = motion.position[:, :, places[pair[0]]] - motion.position[:, :, places[pair[1]]]
        crashes = [(*pair, int(np.nanargmin((gap**2).sum(axis=1))))]
    rows = []
    for first, second, moment in crashes[:MAX_CRASHES]:
        a, b = (motion.position[moment, :, places[agent]] for agent in (first, second))
        rows.append(
            {
                "ids": [first, second],
                "time_s": round(float(distances.time_s[moment]), 3),
                "place": thin((a + b) / 2, 3),
                "distance_m": round(float(np.linalg.norm(a - b)), 4),
            }
        )
    return rows


def distance_chart(distances: Distances | None, run: RecordedRun) -> dict[str, Any] | None:
    """Return distances over time as a page shows them, and what they are compared with."""
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
        "r_min": float(swarm_section(run.config).get("r_min", 0.3) or 0.3),
    }
