"""The vehicle: a point mass with first-order response and limited acceleration."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dtsa_agent.core.settings.flight_models import FLIGHT_MODELS, VehicleParams

vectors = st.lists(st.floats(-5, 5), min_size=3, max_size=3).map(np.array)


@given(vectors, vectors, vectors, st.sampled_from(sorted(FLIGHT_MODELS)), st.sampled_from([0.002, 0.01]))
def test_step_follows_the_formula(p: np.ndarray, v: np.ndarray, c: np.ndarray, name: str, dt: float) -> None:
    """Semi-implicit Euler: the position moves with the new velocity. Estimator ``intent`` relies on it."""
    params = FLIGHT_MODELS[name].vehicle
    a = (c - v) / params.tau
    size = math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    new_v = v + dt * (params.a_max / size if size > params.a_max else 1.0) * a
    new_p = p + dt * new_v
    params.step(dt, p, v, c)
    assert (p.tobytes(), v.tobytes()) == (new_p.tobytes(), new_v.tobytes())  # bit for bit


def test_many_vehicles_step_like_single_ones() -> None:
    params = VehicleParams()
    random = np.random.default_rng(2)
    p, v, c = random.normal(size=(3, 3, 23))
    singles = []
    for k in range(23):
        one_p, one_v = p[:, k].copy(), v[:, k].copy()
        params.step(0.01, one_p, one_v, c[:, k].copy())
        singles.append((one_p.tobytes(), one_v.tobytes()))
    params.step(0.01, p, v, c)
    assert singles == [(p[:, k].tobytes(), v[:, k].tobytes()) for k in range(23)]


def test_wrong_arrays_are_refused() -> None:
    params = VehicleParams(tau=0.1, a_max=2.0)
    for shapes in (((3,), (6,), (3,)), ((3, 2), (3, 2), (3,)), ((6,), (6,), (6,))):
        with pytest.raises(ValueError, match="shapes"):
            params.step(0.01, *map(np.zeros, shapes))
    frozen = np.zeros(3)
    frozen.flags.writeable = False
    with pytest.raises(ValueError, match="read-only"):
        params.step(0.01, frozen, np.zeros(3), np.zeros(3))
