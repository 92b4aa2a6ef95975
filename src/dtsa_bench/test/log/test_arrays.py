"""Frames of agents with clocks of their own, without nodes: verdicts are checked, spread and lateness told."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_bench.flights.measurement import TimingStatistics
from dtsa_bench.log.arrays import SentFrames
from dtsa_bench.log.verify.on_air import FramesOnAir
from dtsa_bench.log.verify.result import Mismatch
from dtsa_channel_sim import Air, Channel, ChannelConfig

MS = 1_000_000
FRAME = st.tuples(st.integers(1, 5), st.integers(0, 12 * MS), st.integers(1, 60))  # sender, ns, bytes
FRAMES = st.lists(FRAME, min_size=2, max_size=12, unique_by=lambda frame: frame[:2])


def sent_frames(config: ChannelConfig, frames: list[tuple[Any, ...]]) -> FramesOnAir:
    """Frames of slot 0 and on: sender, start in ns, bytes, whom it reached, how many lost it, and where it collided."""
    sender, asked_ns, length, received, lost, collided = (list(column) for column in zip(*frames, strict=True))
    masks, data = np.array(received, np.bool_), [bytes(size) for size in length]
    sent = SentFrames(np.arange(len(frames)), np.array(sender), data, masks, np.array(lost), np.array(collided))
    return FramesOnAir(config, sent, np.array(asked_ns))


def resolved(config: ChannelConfig, frames: list[tuple[int, int, int]]) -> tuple[list[Any], FramesOnAir]:
    """The channel's verdicts on frames, and these frames as a log has them."""
    line, starts = Air(Channel(config)), sorted(frames, key=lambda f: f[1])
    for number, frame in enumerate(starts):
        line.begin(number, *frame)
    verdicts = sorted(line.resolve(100 * MS), key=lambda v: v.frame_id)
    return verdicts, sent_frames(
        config, [(*frame, v.received, v.lost, v.collided) for frame, v in zip(starts, verdicts, strict=True)]
    )


def equal_again(sent: FramesOnAir) -> bool:
    received, lost, collided, count = sent.resolve_again({})
    assert count == len(sent.slot)
    return all(map(np.array_equal, (received, lost, collided), (sent.received, sent.lost, sent.collided)))


@given(FRAMES, st.floats(0.0, 0.5), st.integers(0, 9), st.sampled_from(("plain", "crazyflie")))
@settings(max_examples=120, deadline=None)
def test_the_channels_own_verdicts_always_pass_and_frames_arrive_when_it_says(frames, loss, seed, radio):
    """Radios behind lines make frames wait for each other."""
    verdicts, sent = resolved(ChannelConfig(agents=5, loss=loss, seed=seed, radio=radio), frames)
    assert equal_again(sent)
    for v in verdicts:
        assert (sent.end_ns[v.frame_id], sent.arrival_ns[v.frame_id]) == (v.end_ns, v.arrival_ns)


@given(FRAMES, st.integers(0, 99), st.integers(0, 4))
@settings(max_examples=60, deadline=None)
def test_one_wrong_receiver_never_passes(frames: list[tuple[int, int, int]], frame: int, receiver: int) -> None:
    _, sent = resolved(ChannelConfig(agents=5), frames)
    sent.received[frame % len(frames), receiver] ^= True
    assert not equal_again(sent)


@given(FRAMES, st.floats(0.0, 0.5), st.integers(0, 9), st.sampled_from(("plain", "crazyflie")))
@settings(max_examples=80, deadline=None)
def test_by_who_received_what_frames_arrive_when_the_channel_says_and_never_overlap(frames, loss, seed, radio):
    verdicts, sent = resolved(ChannelConfig(agents=5, loss=loss, seed=seed, radio=radio), frames)
    sent.find_times()
    for v in verdicts:
        assert (sent.end_ns[v.frame_id], sent.arrival_ns[v.frame_id]) == (v.end_ns, v.arrival_ns)
    sent.check_overlaps()


def test_two_frames_at_one_time_are_never_both_heard() -> None:
    config, deaf = ChannelConfig(agents=3), [False] * 3
    with pytest.raises(Mismatch, match="together with a frame of cf2"):
        sent_frames(config, [(1, 0, 24, [False, True, False], 0, 0), (2, 0, 24, deaf, 0, 0)]).check_overlaps()
    length_ns = config.airtime.total_ns(24)
    for gap_ns, second, passes in (
        (length_ns // 2, True, False),
        (length_ns, True, True),
        (length_ns // 2, False, True),
    ):
        heard = [(1, 0, 24, [False, False, True], 0, 0), (2, gap_ns, 24, [False, False, second], 0, 0)]
        with nullcontext() if passes else pytest.raises(Mismatch, match="together with a frame of cf1"):
            sent_frames(config, heard).check_overlaps()


def test_each_receiver_counts_once_and_a_sender_not_at_all() -> None:
    config = ChannelConfig(agents=3)
    for received, lost, collided, what in (
        ([False, True, True], 0, 0, ""), ([False, True, False], 1, 0, ""), ([True, False, False], 0, 0, "hears itself"),
        ([False, True, True], 1, 0, "counts once"), ([False, False, True], 1, 1, "counts once"),
    ):  # fmt: skip
        with pytest.raises(Mismatch, match=what) if what else nullcontext():
            sent_frames(config, [(1, 0, 24, received, lost, collided)]).check_numbers()


def test_spread_and_lateness_come_from_the_right_agents() -> None:
    patient, statistics = TimingStatistics(3, wait_ns=3_000_000), TimingStatistics(3)
    assert statistics.as_due_share == 1.0
    for offsets_ns, sends, chosen in (
        ([0, 400_000, 3_200_000], [0, 0, 1], [3, 3, 3]), ([100_000, 0, 100_000], [0, 1, 0], [2, 2, 2]),  # 3 ms late
    ):  # fmt: skip
        for each in (patient, statistics):
            each.add_slot(np.ones(3, np.bool_), np.array(sends, np.bool_), np.array(offsets_ns), np.array(chosen))
    summary = statistics.summary()
    assert (patient.as_due_share, statistics.as_due_share) == (1.0, 0.5)
    for answers in (True, False):  # a frame that was made too late to be sent; nobody knows of another
        patient.add_slot(np.full(3, answers), np.zeros(3, np.bool_), np.zeros(3, np.int64), np.array([1, 1, 1]))
    assert patient.as_due_share == pytest.approx(2 / 3)
    assert summary["clock_spread_max_ms"] == pytest.approx(0.4)
    assert summary["clock_spread_mean_ms"] == pytest.approx(0.2)
    assert summary["clock_spread_end_ms"] == pytest.approx(0.4)
    assert summary["sends_on_time_share"] == 0.5
    assert summary["send_offset_ms"]["3"] == {"median": pytest.approx(3.0), "max": pytest.approx(3.0)}
    assert TimingStatistics(3).summary()["clock_spread_max_ms"] is None
