"""Vehicles that may not exchange roles are brought to their places, one at a time, over or past the others. Pure.

All hover at one height. One flies straight where that is clear; else it climbs to a layer above, flies over the others,
and sinks. Where everybody's place is taken by somebody else, one first moves aside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.crazyflie.safety.rules import SafetySettings

from .places import APART_M, MissionError, close_pairs

CLEAR_M = 0.45  # m: a straight way, and a place aside, keep this distance from everybody who hovers
LAYER_M = 0.6  # m above those who hover: the one who moves is no danger to them there
NEAR_M = 0.05  # m: nothing to do
GRID_M = 0.15  # m, of the places aside

Array = NDArray[np.float64]
Place = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Move:
    """One vehicle flies, the others hover."""

    index: int
    waypoints: tuple[Place, ...]  # m, frame map


def plan_moves(names: Sequence[str], hover: Array, goal: Array, fence: SafetySettings) -> list[Move]:
    """How to bring everybody to its place.

    :param names: of the vehicles.
    :param hover: (3, N), m, map: where they hover.
    :param goal: (3, N), m, map: where each has to be.
    :param fence: the room.
    :raises MissionError: with names and distances, when it cannot be done safely.
    """
    here = np.array(hover, dtype=np.float64)
    layer = float(max(here[2].max(), goal[2].max())) + LAYER_M
    _check(names, here, goal, layer, fence)
    moves: list[Move] = []
    left = [k for k in range(len(names)) if np.linalg.norm(here[:, k] - goal[:, k]) > NEAR_M]
    while left:
        free = [k for k in left if _clearance(here, k, goal[:2, k]) >= APART_M]
        if free:
            k = min(free, key=lambda k: float(np.linalg.norm(here[:, k] - goal[:, k])))
            place = goal[:, k]
            left.remove(k)
        else:  # each stands where another one has to be
            k, place = _aside(names, here, goal, left, fence)
        moves.append(Move(k, _way(here, k, place, layer)))
        here[:, k] = place
    return moves


def _check(names: Sequence[str], here: Array, goal: Array, layer: float, fence: SafetySettings) -> None:
    problems = []
    if fence.geofence and layer > fence.geofence_max[2]:
        problems.append(
            f"{layer:.2f} m, the height over the others, is above the geofence's {fence.geofence_max[2]:g} m"
        )
    problems += close_pairs(names, here, "hover") + close_pairs(names, goal, "would begin")
    if problems:
        raise MissionError(f"no vehicle can be led to its place (at least {APART_M} m apart): {'; '.join(problems)}")


def _clearance(here: Array, k: int, place: Array) -> float:
    """Distance (m) of a place, (2,), from everybody but one."""
    others = np.delete(here[:2], k, axis=1)
    return float(np.linalg.norm(others - place[:, None], axis=0).min(initial=np.inf))


def _aside(
    names: Sequence[str], here: Array, goal: Array, left: Sequence[int], fence: SafetySettings
) -> tuple[int, Array]:
    """Who moves aside, and to where: the nearest place that is clear of all who hover and of all goals.

    :raises MissionError: there is none.
    """
    low, high = (np.array(corner)[:2] for corner in (fence.geofence_min, fence.geofence_max))
    if not fence.geofence:
        everything = np.hstack([here[:2], goal[:2]])
        low, high = everything.min(axis=1) - 1.0, everything.max(axis=1) + 1.0
    axes = [np.arange(a + GRID_M, b, GRID_M) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij")).reshape(2, -1)
    taken = np.hstack([here[:2], goal[:2]])
    distance = np.linalg.norm(grid[:, :, None] - taken[:, None, :], axis=0).min(axis=1, initial=np.inf)
    clear = grid[:, distance >= CLEAR_M]
    if clear.size == 0:
        best = float(distance.max(initial=0.0))
        waiting = ", ".join(names[k] for k in left)
        raise MissionError(f"{waiting} stand at each other's places, and no place aside is more than {best:.2f} m away "
                           f"from all (needed {CLEAR_M} m)")  # fmt: skip
    ways = np.linalg.norm(clear[:, :, None] - here[:2, None, list(left)], axis=0)
    spot, who = np.unravel_index(int(ways.argmin()), ways.shape)
    k = left[int(who)]
    return k, np.array([*clear[:, spot], here[2, k]])


def _way(here: Array, k: int, place: Array, layer: float) -> tuple[Place, ...]:
    """Straight where that is clear, else over the others."""
    begin, end = here[:, k], place
    others = np.delete(here[:2], k, axis=1)
    way = end[:2] - begin[:2]
    square = float(way @ way)
    along = np.clip((way @ (others - begin[:2, None])) / max(square, 1e-12), 0.0, 1.0)
    closest = np.linalg.norm(begin[:2, None] + way[:, None] * along - others, axis=0).min(initial=np.inf)
    last = _place(end)
    if closest >= CLEAR_M:
        return (last,)
    return (float(begin[0]), float(begin[1]), layer), (float(end[0]), float(end[1]), layer), last


def _place(p: Array) -> Place:
    return float(p[0]), float(p[1]), float(p[2])
