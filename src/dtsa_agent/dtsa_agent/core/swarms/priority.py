"""The paper's priority value g and its selection function, on plain arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dtsa_agent.core.compiled import MISSING
from dtsa_agent.core.compiled import kernel as _kernel
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import REASONS, SELECTIONS


def priority(position: ArrayLike, velocity: ArrayLike, slot_s: float) -> NDArray[np.float64]:
    """Priority values of all agents (eq:permission_d_p_ang).

    ``g_k = sum over j != k of |v_jk| t_s / |p_kj| * (pi - alpha_jk) / pi``. An agent at rest has g = 0; a pair without
    relative velocity adds nothing.

    :param position: (N, 3), m, any common frame.
    :param velocity: (N, 3), m/s.
    :param slot_s: t_s, s.
    :returns: g, (N,), dimensionless.
    """
    p = np.asarray(position, dtype=np.float64).T
    v = np.asarray(velocity, dtype=np.float64).T
    if p.ndim != 2 or p.shape[0] != 3 or p.shape != v.shape:
        raise ConfigError("position, velocity", (p.T.shape, v.T.shape), "two arrays of shape (N, 3)")
    if MISSING:
        from dtsa_agent.core.reference import priority as plain  # hardly ever wanted: start-up does without

        rows = [[(float(x), float(y), float(z)) for x, y, z in array.T] for array in (p, v)]
        return np.array(plain.priorities(rows[0], rows[1], float(slot_s)))
    g: NDArray[np.float64] = np.frombuffer(_kernel.priority(p.tobytes(), v.tobytes(), float(slot_s))).copy()
    return g


def select(
    g: ArrayLike, counter: ArrayLike, in_ap: ArrayLike, epsilon: float = 0.5, selection: str = "candidates"
) -> tuple[int, NDArray[np.bool_], int]:
    """The selection function (eq:pfs), with the counters h as tie-break (eq:secondary).

    ``candidates``: all of A_p with ``g >= (1 - epsilon) max g``; among them the largest h, then the lowest id.
    ``pairwise``: the text read literally, one scan in id order that keeps the significantly greater of two.

    :param g: (N,) priority values.
    :param counter: (N,) slots since each agent last sent.
    :param in_ap: (N,) whether each agent is a potential sender.
    :param epsilon: least relative difference that counts.
    :param selection: ``candidates`` or ``pairwise``.
    :returns: index of the next sender (-1: nobody), the candidates (N,), index into ``REASONS``.
    """
    if selection not in SELECTIONS:
        raise ConfigError("selection", selection, ", ".join(SELECTIONS))
    values = np.asarray(g, dtype=np.float64)
    if MISSING:
        candidates = np.zeros(len(values), dtype=np.bool_)
        from dtsa_agent.core.reference import selection as plain_selection

        members = [int(k) for k in np.flatnonzero(np.asarray(in_ap))]
        choice = plain_selection.select(
            values.tolist(), np.asarray(counter).tolist(), np.asarray(in_ap, bool).tolist(), epsilon, selection
        )
        if selection == "candidates" and choice.reason in ("priority", "tie"):
            candidates[plain_selection.candidates(values.tolist(), members, epsilon)] = True
        return choice.index, candidates, REASONS.index(choice.reason)
    h, members_ = np.asarray(counter, dtype=np.int64), np.asarray(in_ap, dtype=np.uint8)
    index, reason, close = _kernel.select(
        values.tobytes(), h.tobytes(), members_.tobytes(), float(epsilon), SELECTIONS.index(selection)
    )
    return index, np.frombuffer(close, dtype=np.bool_).copy(), reason
