"""Clocks of the agents, and keeping their slots together by what is heard."""

from __future__ import annotations

import math

import numpy as np
import pytest
from drifting_clocks import to_channel, to_local
from hypothesis import given
from hypothesis import strategies as st

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.reference.timebase import ClockAligner
from dtsa_channel_sim import Air, Channel, ChannelConfig, ClockConfig, make_clocks

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


@given(st.lists(st.integers(-(10**6), 10**6), max_size=40))
def test_aligner_is_symmetric(offsets):
    one, two = ClockAligner(receptions=4), ClockAligner(receptions=4)
    assert [one.hear(o) for o in offsets] == [-two.hear(-o) for o in offsets]


def ten_minutes(*, loss, align, jitter_ns=5000, agents=18, slots=60_000, burst_length=0.0, seed=1):
    """TDMA on drifting clocks through the real-time channel.

    Returns the largest distance of two agents' slots (ns) after the first ten rounds, and the number of
    frames that collided.
    """
    slot_ns = 10 * MS
    length = 30
    clocks = make_clocks(ClockConfig(drift_ppm=50, offset_ns=10**12, seed=seed), agents)
    # Crystals over the whole range, whatever the seed drew; in no order, so that neighbours meet.
    random = np.random.default_rng(seed)
    drifts = random.permutation(np.linspace(-50_000, 50_000, agents)).astype(int)
    clocks = [c._replace(drift_ppb=d) for c, d in zip(clocks, drifts.tolist(), strict=True)]
    channel = Channel(ChannelConfig(agents=agents, loss=loss, burst_length=burst_length, seed=seed))
    line = Air(channel)
    config = channel.config
    travel = config.airtime.total_ns(length)
    # Local time at which each agent's slot 0 starts; a frame goes out a quarter of a slot later.
    zero = [to_local(clock, 0) for clock in clocks]
    guard = slot_ns // 4
    aligners = [ClockAligner() for _ in clocks]
    jitter = (jitter_ns * random.standard_normal(slots)).astype(int).tolist()  # of each transmission
    spread = collided = 0
    for slot in range(slots):
        owner = slot % agents
        start = to_channel(clocks[owner], zero[owner] + slot * slot_ns + guard) + jitter[slot]
        line.begin(slot, owner + 1, start, length)
        for verdict in line.settle((slot - 4) * slot_ns):
            collided += verdict.collided > 0
            if not align:
                continue
            for listener in np.flatnonzero(verdict.received).tolist():
                # The frame carries its slot's number: compare with when the own clock would have sent it.
                heard = to_local(clocks[listener], verdict.end_ns) - travel
                zero[listener] += aligners[listener].hear(heard - (zero[listener] + verdict.frame_id * slot_ns + guard))
        if slot % agents == 0 and slot > 10 * agents:
            starts = [to_channel(c, z + slot * slot_ns) for c, z in zip(clocks, zero, strict=True)]
            spread = max(spread, max(starts) - min(starts))
    return spread, collided


@pytest.mark.parametrize(("loss", "burst_length"), [(0.0, 0.0), (0.2, 0.0), (0.5, 0.0), (0.2, 20.0)])
def test_slots_stay_together_for_ten_minutes(loss, burst_length):
    spread, collided = ten_minutes(loss=loss, burst_length=burst_length, align=True)
    assert spread < 200_000
    assert collided == 0


def test_without_alignment_frames_overlap():
    spread, collided = ten_minutes(loss=0.2, align=False)
    assert spread > 55 * MS
    assert collided > 1000
