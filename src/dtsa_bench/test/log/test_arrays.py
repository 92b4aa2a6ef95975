"""Frames of agents with clocks of their own, without nodes: verdicts are checked, spread and lateness told."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_bench.flights.statistics import TimingStatistics
from dtsa_bench.log.verify.on_air import FramesOnAir
from dtsa_bench.log.verify.result import Mismatch
from dtsa_channel_sim import Air, Channel, ChannelConfig

MS = 1_000_000
FRAME = st.tuples(st.integers(1, 5), st.integers(0, 12 * MS), st.integers(1, 60))  # sender, ns, bytes
FRAMES = st.lists(FRAME, min_size=2, max_size=12, unique_by=lambda frame: frame[:2])


def check_on_air(config: ChannelConfig, frames: list[tuple[int, int, int]], flip: tuple[int, int] | None = None) -> int:
    """Check frames with the channel's verdicts, one receiver's bit turned round in deliveries and verdicts alike."""
    line, sent = Air(Channel(config)), FramesOnAir(config, own_clocks=True)
    starts = sorted(frames, key=lambda f: f[1])
    for number, (sender, start, length) in enumerate(starts):
        line.begin((number, sender), sender, start, length)
    for number, v in enumerate(sorted(line.resolve(100 * MS), key=lambda v: v.frame_id)):
        received = v.received.copy()
        if flip and number == flip[0] % len(frames):
            received[flip[1]] ^= True
        _, start, length = starts[v.frame_id[0]]
        sent.add(*v.frame_id, start, bytes(length), received, v.lost, v.collided)
    sent.check_numbers()
    sent.wait_for_lines()
    sent.check_overlaps()
    return sent.check_verdicts([])


@given(FRAMES, st.floats(0.0, 0.5), st.integers(0, 9))
@settings(max_examples=40, deadline=None)
def test_frames_that_wait_for_a_line_begin_and_arrive_when_the_channel_says(frames, loss, seed):
    config = ChannelConfig(agents=5, loss=loss, seed=seed, radio="crazyflie")
    line, sent = Air(Channel(config)), FramesOnAir(config, own_clocks=True)
    starts = sorted(frames, key=lambda f: f[1])
    for number, (sender, start, length) in enumerate(starts):
        line.begin((number, sender), sender, start, length)
    verdicts = list(line.resolve(100 * MS))
    for v in verdicts:
        _, start, length = starts[v.frame_id[0]]
        sent.add(*v.frame_id, start, bytes(length), v.received, v.lost, v.collided)
    sent.wait_for_lines()
    for v in verdicts:
        found = sent.get(*v.frame_id)
        assert (found.on_air.start_ns, found.arrival_ns) == (v.start_ns, v.arrival_ns)


@given(FRAMES, st.floats(0.0, 0.5), st.integers(0, 9), st.sampled_from(("plain", "crazyflie")))
@settings(max_examples=120, deadline=None)
def test_the_channels_own_verdicts_always_pass(frames, loss, seed, radio):
    assert check_on_air(ChannelConfig(agents=5, loss=loss, seed=seed, radio=radio), frames) == len(frames)


@given(FRAMES, st.integers(0, 99), st.integers(0, 4))
@settings(max_examples=60, deadline=None)
def test_one_wrong_receiver_never_passes(frames: list[tuple[int, int, int]], frame: int, receiver: int) -> None:
    with pytest.raises(Mismatch):
        check_on_air(ChannelConfig(agents=5), frames, flip=(frame, receiver))


def test_two_frames_at_one_time_are_never_both_heard() -> None:
    sent = FramesOnAir(ChannelConfig(agents=3), own_clocks=True)
    for sender, received in ((1, np.zeros(3, dtype=bool)), (2, np.array([True, False, True]))):
        sent.add(0, sender, 0, bytes(24), received, 0, 0)
    with pytest.raises(Mismatch, match="a sender does not hear"):
        sent.check_overlaps()
    with pytest.raises(Mismatch):
        sent.check_verdicts([])
    length_ns = ChannelConfig(agents=3).airtime.total_ns(24)
    with pytest.raises(Mismatch, match="both at cf3"):
        both_heard(length_ns // 2, second=1).check_overlaps()
    both_heard(length_ns, second=1).check_overlaps()
    sent = both_heard(length_ns // 2, second=0)
    sent.check_overlaps()
    assert sent.safety() == {"frames": 2, "overlapping_pairs": 1, "frames_collided": 0}


def both_heard(gap_ns: int, second: int) -> FramesOnAir:
    """A frame of agent 1 and one of agent 2 that starts ``gap_ns`` later; agent 3 has heard both or not."""
    sent = FramesOnAir(ChannelConfig(agents=3), own_clocks=True)
    for sender, start, heard in ((1, 0, True), (2, gap_ns, second > 0)):
        sent.add(0, sender, start, bytes(24), np.array([False, False, heard]), 0, 0)
    return sent


def test_spread_and_lateness_come_from_the_right_agents() -> None:
    statistics = TimingStatistics(3)

    def report(slots: list[int], agents: list[int], offsets_ns: list[int], lengths: list[int]) -> None:
        values = {"slot": slots, "agent": agents, "offset_ns": offsets_ns, "length": lengths}
        statistics.report(SimpleNamespace(**{name: np.array(value, np.int64) for name, value in values.items()}))

    report([0, 1], [1, 2], [0, 400_000, 100_000, 0], [0, 0, 0, 24])
    report([0], [3], [3_200_000], [24])  # late by 3 ms: not a clock that is off
    report([1], [3], [100_000], [0])
    report([], [1, 2], [], [])  # nothing but what was heard
    summary = statistics.summary()
    assert summary["clock_spread_max_ms"] == pytest.approx(0.4)
    assert summary["clock_spread_mean_ms"] == pytest.approx(0.2)
    assert summary["clock_spread_end_ms"] == pytest.approx(0.4)
    assert summary["sends_on_time_share"] == 0.5
    assert summary["send_offset_ms"]["3"] == {"median": pytest.approx(3.0), "max": pytest.approx(3.0)}
    assert TimingStatistics(3).summary()["clock_spread_max_ms"] is None
