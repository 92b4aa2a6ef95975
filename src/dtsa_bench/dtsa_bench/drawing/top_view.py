"""A flight from above as SVG. Its colours are those of the page around it, whose style sheet knows the classes."""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .palette import DASHES, agent_colour, agent_turn

_SIDE = 100.0  # of the picture, in its own units
_WITHOUT, _WITH_IDS = "0 0 100 100", "-4 -4 108 108"
_LINE = 1.1  # width of a path
_MOST_POINTS, _MOST_OF_ONE, _LEAST_OF_ONE = 8000, 80, 12  # of all paths, of one
_LABELLED = 24  # agents that get their ids written

Array = NDArray[np.float64]


def half_width(path: Array) -> float:
    """Half the width of what the picture shows, m.

    :param path: (T, 2 or 3, N) m, frame map; not a number where a position is not known.
    """
    known = np.abs(path[:, :2][np.isfinite(path[:, :2])])
    return 1.13 * float(known.max(initial=0.0)) or 1.0


def top_view(
    path: Array, moving: NDArray[np.bool_], name: str, *, ids: bool = False, crash: Sequence[int] | None = None
) -> str:
    """The paths of the movers, with rings where they start and discs where all agents end.

    Classes: `way` and its `halo`, `start`, `craft`, `hover` (a craft that does not move), `crash`, `id`, `scale`.

    :param path: (T, 2 or 3, N) m, frame map; not a number where a position is not known.
    :param moving: (N,) which agents move.
    :param name: what the picture shows, for readers who hear it.
    :param ids: write the ids of the agents beside their starts, if there are few.
    :param crash: ids of two agents that crashed; a ring is drawn around them.
    """
    extent, agents = half_width(path), path.shape[2]
    place = np.round((path[:, :2] * [[1], [-1]] / extent + 1) * _SIDE / 2, 2)
    most = min(_MOST_OF_ONE, max(_LEAST_OF_ONE, _MOST_POINTS // max(1, agents)))
    parts, ends = [], {}
    for k in range(agents):
        known = np.flatnonzero(np.isfinite(place[:, :, k]).all(axis=1))
        if not len(known):
            continue
        way = np.unique(np.concatenate((known[:: max(1, len(known) // most)], known[-1:])))
        x0, y0 = place[known[0], :, k]
        x, y = ends[k + 1] = place[known[-1], :, k]
        colour = f'style="--c:{agent_colour(k + 1)}"'
        if moving[k]:
            points = " ".join(f"{x:g},{y:g}" for x, y in place[way, :, k])
            parts.append(f'<polyline class="halo" points="{points}"/>')
            parts.append(f'<polyline class="way" {colour}{_dash(k + 1)} points="{points}"/>')
            parts.append(f'<circle class="start" {colour} cx="{x0:g}" cy="{y0:g}" r="2.4"/>')
        kind = f'{colour} class="craft' if moving[k] else 'class="craft hover'
        parts.append(f'<circle {kind}" cx="{x:g}" cy="{y:g}" r="2.8"/>')
        if ids and agents <= _LABELLED:
            away = max(1.0, float(np.hypot(x0 - _SIDE / 2, y0 - _SIDE / 2)))
            x, y = (_SIDE / 2 + (at - _SIDE / 2) * (1 + 6.2 / away) for at in (x0, y0))
            parts.append(f'<text class="id" x="{x:.4g}" y="{y + 1.4:.4g}">{k + 1}</text>')
    if crash and all(agent in ends for agent in crash):
        x, y = np.mean([ends[agent] for agent in crash], axis=0)
        parts.append(f'<circle class="crash" cx="{x:g}" cy="{y:g}" r="6"/>')
    metre = _SIDE / 2 / extent
    parts.append(
        f'<path class="scale" d="M{96 - metre:g} 97.5h{metre:g}"/>'
        f'<text class="scale" x="{96 - metre / 2:g}" y="95.5">1 m</text>'
    )
    box, label = _WITH_IDS if ids else _WITHOUT, f"{html.escape(name)}, seen from above"
    return f'<svg class="view" viewBox="{box}" role="img" aria-label="{label}">{"".join(parts)}</svg>'


def _dash(agent: int) -> str:
    """The dash of an agent whose colour has come before."""
    lengths = " ".join(f"{length * _LINE:g}" for length in DASHES[agent_turn(agent)])
    return f' stroke-dasharray="{lengths}"' if lengths else ""
