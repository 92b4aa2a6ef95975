"""Clocks of the agents, and keeping their slots together by what is heard."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.reference.timebase import ClockAligner
from dtsa_channel_sim import ClockConfig, make_clocks

MS = 1_000_000


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


def test_aligner_moves_by_half_the_median():
    aligner = ClockAligner()
    offsets = [100, 900_000, 300, 200, 400, -800_000, 600, 500, 700]
    assert [aligner.hear(offset) for offset in offsets] == [0] * 8 + [200]
    assert [aligner.hear(-offset) for offset in offsets] == [0] * 8 + [-200]
    assert aligner.corrections == 2
    even = ClockAligner(receptions=2, gain=1.0)
    assert [even.hear(offset) for offset in (10, 30)] == [0, 20]


def test_aligner_ignores_what_is_far_off():
    aligner = ClockAligner(receptions=1)
    assert aligner.hear(1_000_000) == 500_000
    assert [aligner.hear(offset) for offset in (1_000_001, -1_000_001)] == [0, 0]
    assert (aligner.ignored, aligner.ignored_in_a_row) == (2, 2)
    assert aligner.hear(2) == 1
    assert (aligner.ignored, aligner.ignored_in_a_row) == (2, 0)
