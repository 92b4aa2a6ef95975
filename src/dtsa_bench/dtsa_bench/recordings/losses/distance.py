"""How losses depend on the distance from the sender to the receiver."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_channel_sim.model.loss_record import LOST, UNKNOWN
from dtsa_channel_sim.model.loss_table import LossTable

from .chain_fit import CHI2_95, wilson

_FINE = 2000  # steps of distance in which losses are counted
_BINS = 8


def by_distance(tables: Sequence[LossTable], spread: float = 1.0) -> dict[str, Any] | None:
    """Shares lost in bins of distance that hold about equally many receptions, and a logistic curve.

    The curve is loss = 1 / (1 + exp(-slope (d - half_m))).

    :param tables: flights.
    :param spread: how many times more shares vary than those of independent losses; widens the intervals.
    :returns: None where no distance is known, or all are the same.
    """
    known = [table for table in tables if table.distance_m is not None]
    most = max(
        (float(np.nanmax(table.distance_m)) for table in known if np.isfinite(table.distance_m).any()), default=0
    )
    if most <= 0.0:
        return None
    sent, lost = np.zeros(_FINE, np.int64), np.zeros(_FINE, np.int64)
    total = np.zeros(_FINE)
    for table in known:
        assert table.distance_m is not None
        use = (table.outcome != UNKNOWN) & np.isfinite(table.distance_m)
        distance = table.distance_m[use].astype(np.float64)
        place = np.minimum((distance * (_FINE / most)).astype(np.int64), _FINE - 1)
        sent += np.bincount(place, minlength=_FINE)
        lost += np.bincount(place, table.outcome[use] == LOST, _FINE).astype(np.int64)
        total += np.bincount(place, distance, _FINE)
    there = sent > 0
    if np.count_nonzero(there) < 2:
        return None
    return {
        "bins": _bins(sent, lost, most, spread),
        "logistic": _logistic(total[there] / sent[there], sent[there], lost[there], spread),
    }


def _bins(sent: NDArray[np.int64], lost: NDArray[np.int64], most: float, spread: float) -> list[dict[str, Any]]:
    edges = [0]
    total = np.cumsum(sent)
    for part in range(1, _BINS):
        edges.append(int(np.searchsorted(total, total[-1] * part / _BINS)) + 1)
    edges = sorted({*edges, len(sent)})
    bins = []
    for first, end in pairwise(edges):
        count, gone = int(sent[first:end].sum()), int(lost[first:end].sum())
        if count:
            low, high = wilson(np.array([gone / spread]), np.array([count / spread]))
            bins.append({
                "from_m": round(first * most / _FINE, 3), "to_m": round(end * most / _FINE, 3), "sent": count,
                "lost": gone, "loss": gone / count, "loss_interval": [float(low[0]), float(high[0])],
            })  # fmt: skip
    return bins


def _logistic(
    distance: NDArray[np.float64], sent: NDArray[np.int64], lost: NDArray[np.int64], spread: float
) -> dict[str, Any] | None:
    """By maximum likelihood; None where it has no maximum: nothing, or all, was lost on one side of a distance."""
    if not lost.sum() or lost.sum() == sent.sum():
        return None
    middle = float((distance * sent).sum() / sent.sum())
    scale = max(float(np.sqrt(((distance - middle) ** 2 * sent).sum() / sent.sum())), 1e-9)
    x = (distance - middle) / scale
    share = float(lost.sum() / sent.sum())
    point = np.array([math.log(share / (1.0 - share)), 0.0])
    information = np.eye(2)
    for _ in range(60):
        p = 1.0 / (1.0 + np.exp(-np.clip(point[0] + point[1] * x, -30, 30)))
        score = np.array([(lost - sent * p).sum(), ((lost - sent * p) * x).sum()])
        weight = sent * p * (1.0 - p)
        information = np.array([[weight.sum(), (weight * x).sum()], [(weight * x).sum(), (weight * x * x).sum()]])
        if np.linalg.det(information) < 1e-9:
            return None
        step = np.linalg.solve(information, score)
        point = point + step * min(1.0, 2.0 / max(1e-9, float(np.abs(step).max())))
        if np.abs(step).max() < 1e-9:
            break
    if np.abs(point).max() > 25.0:
        return None
    half = math.sqrt(CHI2_95 * spread * float(np.linalg.inv(information)[1, 1]))
    return {
        "slope_per_m": point[1] / scale,
        "slope_interval": [(point[1] - half) / scale, (point[1] + half) / scale],
        "half_m": middle - point[0] * scale / point[1] if point[1] else None,
    }
