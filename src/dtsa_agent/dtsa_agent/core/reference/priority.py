"""The paper's priority value."""

from __future__ import annotations

import math
from collections.abc import Sequence

from .arithmetic import INVERSE_PI, Vector, arcsin, dot, minus, sum_in_lanes


def eta(p_k: Vector, v_k: Vector, p_j: Vector, v_j: Vector, slot_s: float) -> float:
    """How urgent two agents are to each other: eta_jk = |d_jk| / |p_kj| (pi - alpha_jk) / pi.

    d_jk = v_jk t_s is their relative displacement in a slot; alpha_jk (eq:permission_alpha) is the angle between v_jk
    and p_kj, 0 for a head-on approach. (pi - arccos x) / pi is computed as 1/2 + arcsin(x) / pi, and |v| / |p| as
    |v|^2 / (|p| |v|), which needs one root.

    :param p_k: position of agent k, m.
    :param v_k: its velocity, m/s.
    :param p_j: position of agent j, m.
    :param v_j: its velocity, m/s.
    :param slot_s: t_s, s.
    :returns: eta, dimensionless; 0 for v_jk = 0, and for p_kj = 0: that is a crash, and the run is over.
    """
    p_kj, v_jk = minus(p_k, p_j), minus(v_j, v_k)
    speed2 = dot(v_jk, v_jk)
    product = math.sqrt(dot(p_kj, p_kj) * speed2)  # |p_kj| |v_jk|
    if not product > 0.0:
        return 0.0
    inverse = 1.0 / product
    cosine = max(-1.0, min(1.0, dot(v_jk, p_kj) * inverse))
    share = 0.5 + arcsin(cosine) * INVERSE_PI
    return speed2 * inverse * slot_s * share


def priorities(positions: Sequence[Vector], velocities: Sequence[Vector], slot_s: float) -> list[float]:
    """The priority values g_k of all agents, the sum of eta_jk over all j but k (eq:permission_d_p_ang).

    eta is symmetric, so each pair is computed once. The order of the sum: from the agents before k one after the other,
    then the sum in lanes over those after it. An agent at rest has g = 0.

    :param positions: of all agents, m.
    :param velocities: of all agents, m/s.
    :param slot_s: t_s, s.
    """
    count = len(positions)
    g = [0.0] * count
    for k in range(count):
        later = range(k + 1, count)
        row = [eta(positions[k], velocities[k], positions[j], velocities[j], slot_s) for j in later]
        for j, value in zip(later, row, strict=True):
            g[j] += value
        g[k] += sum_in_lanes(row)
    return [0.0 if v == (0.0, 0.0, 0.0) else value for v, value in zip(velocities, g, strict=True)]
