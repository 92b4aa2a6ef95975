"""Clocks of the agents; that slots stay together: tools/test/test_own_clocks.py."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dtsa_agent.core.errors import ConfigError
from dtsa_channel_sim import ClockConfig, make_clocks


def test_clocks_depend_on_seed_and_agent_alone():
    config = ClockConfig(offset_ns=10**9, drift_ppm=50, jitter_ns=1000, seed=3)
    clocks = make_clocks(config, 200)
    assert make_clocks(config, 12) == clocks[:12]
    assert make_clocks(ClockConfig.from_dict(config.to_dict()), 200) == clocks
    drift = np.array([clock.drift_ppb for clock in clocks])
    assert np.abs(drift).max() <= 50_000
    assert abs(drift.mean()) < 4.5 * 50_000 / math.sqrt(3 * 200)
    assert np.abs(drift).max() > 45_000
    assert np.abs([clock.offset_ns for clock in clocks]).max() <= 10**9


@pytest.mark.parametrize(("name", "value"), [("offset_ns", -1), ("drift_ppm", 2000), ("jitter_ns", "x"), ("skew", 1)])
def test_bad_clock_settings(name, value):
    with pytest.raises(ConfigError) as caught:
        ClockConfig.from_dict({name: value})
    assert caught.value.field == name
