"""Frames of agents with clocks of their own, without nodes: verdicts are checked, spread and lateness told."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_agent.core.reference.timebase import ClockAligner
from dtsa_bench.flights.statistics import ClockStatistics
from dtsa_bench.recordings.verify.frames import SentFrames
from dtsa_bench.recordings.verify.result import Mismatch
from dtsa_channel_sim import Air, Channel, ChannelConfig

MS = 1_000_000
FRAME = st.tuples(st.integers(1, 5), st.integers(0, 12 * MS), st.integers(1, 60))  # sender, ns, bytes
FRAMES = st.lists(FRAME, min_size=2, max_size=12, unique_by=lambda frame: frame[:2])


def on_air(
    config: ChannelConfig, frames: list[tuple[int, int, int]], flip: tuple[int, int] | None = None
) -> SentFrames:
    """Frames with the channel's verdicts on them, one receiver's bit turned round in deliveries and verdicts alike."""
    line, sent = Air(Channel(config)), SentFrames(config, own_clocks=True)
    ordered = sorted(frames, key=lambda f: f[1])
    for number, (sender, start, length) in enumerate(ordered):
        line.begin(number, sender, start, length)
        sent.send(number, sender, start, bytes(length))
    verdicts = sorted(line.settle(100 * MS), key=lambda v: v.frame_id)
    for v in verdicts:
        received = v.received.copy()
        if flip and v.frame_id == flip[0] % len(ordered):
            received[flip[1]] ^= True
        if received.any():
            sent.deliver(v.frame_id, v.sender, bytes(ordered[v.frame_id][2]), received)
        sent.judged(v.slot, v.sender, received, v.lost, v.collided)
    return sent


@given(FRAMES, st.floats(0.0, 0.5), st.integers(0, 9))
@settings(max_examples=60, deadline=None)
def test_the_channels_own_verdicts_always_pass(frames: list[tuple[int, int, int]], loss: float, seed: int) -> None:
    sent = on_air(ChannelConfig(agents=5, loss=loss, seed=seed), frames)
    sent.check_overlaps()
    assert sent.check_verdicts([]) == len(frames)


@given(FRAMES, st.floats(0.0, 0.5), st.integers(0, 9))
@settings(max_examples=60, deadline=None)
def test_when_frames_began_and_arrived_behind_a_line_follows_from_who_received_them(
    frames: list[tuple[int, int, int]], loss: float, seed: int
) -> None:
    """Starts that waited and arrivals that queued are found again from the recording, without the channel's seed."""
    config = ChannelConfig(agents=5, loss=loss, seed=seed, radio="crazyflie")
    line, sent = Air(Channel(config)), SentFrames(config, own_clocks=True)
    for number, (sender, start, length) in enumerate(sorted(frames, key=lambda f: f[1])):
        line.begin((number, sender), sender, start, length)
        sent.send(number, sender, start, bytes(length))
    verdicts = {v.frame_id: v for v in line.settle(100 * MS)}
    sent.lay({key: v.received for key, v in verdicts.items()})
    for key, verdict in verdicts.items():
        found = sent.get(*key)
        assert found is not None
        assert (found.on_air.start_ns, found.arrival_ns) == (verdict.start_ns, verdict.arrival_ns)
        if verdict.received.any():
            sent.deliver(*key, found.data, verdict.received)
        sent.judged(key[0], key[1], verdict.received, verdict.lost, verdict.collided)
    sent.check_overlaps()
    assert sent.check_verdicts([]) == len(frames)


@given(FRAMES, st.integers(0, 99), st.integers(0, 4))
@settings(max_examples=60, deadline=None)
def test_one_wrong_receiver_never_passes(frames: list[tuple[int, int, int]], frame: int, receiver: int) -> None:
    def check() -> None:
        sent = on_air(ChannelConfig(agents=5), frames, flip=(frame, receiver))
        sent.check_overlaps()
        sent.check_verdicts([])

    with pytest.raises(Mismatch):
        check()


def test_a_dropped_frame_has_disturbed_nobody() -> None:
    """Agent 1's frame met that of agent 2 in time, but came too late to be on the air: all heard agent 2."""
    sent = SentFrames(ChannelConfig(agents=3), own_clocks=True)
    nobody, others = np.zeros(3, dtype=bool), np.array([True, False, True])
    for sender, received in ((1, nobody), (2, others)):
        sent.send(0, sender, 0, bytes(24))
        sent.judged(0, sender, received, 0, 0)
    sent.deliver(0, 2, bytes(24), others)
    with pytest.raises(Mismatch, match="who sends does not hear"):
        sent.check_overlaps()
    sent.check_overlaps(late=1)
    assert sent.dropped == 1
    assert sent.check_verdicts([], late=1) == 1
    with pytest.raises(Mismatch):
        sent.check_verdicts([])


def both_heard(gap_ns: int, second: int) -> SentFrames:
    """A frame of agent 1 and one of agent 2 that starts ``gap_ns`` later; agent 3 has heard both or not."""
    sent = SentFrames(ChannelConfig(agents=3), own_clocks=True)
    for sender, start, heard in ((1, 0, True), (2, gap_ns, second > 0)):
        sent.send(0, sender, start, bytes(24))
        received = np.array([False, False, heard])
        sent.deliver(0, sender, bytes(24), received)
        sent.judged(0, sender, received, 0, 0)
    return sent


def test_two_frames_at_one_time_are_never_both_heard() -> None:
    length_ns = ChannelConfig(agents=3).airtime.total_ns(24)
    with pytest.raises(Mismatch, match="both at cf3"):
        both_heard(length_ns // 2, second=1).check_overlaps()
    both_heard(length_ns, second=1).check_overlaps()
    sent = both_heard(length_ns // 2, second=0)
    sent.check_overlaps()
    assert sent.safety()["overlapping_pairs"] == 1


def test_spread_and_lateness_come_from_the_right_agents() -> None:
    statistics = ClockStatistics(3)
    statistics.add([0, 1], [1, 2], np.array([0, 400_000, 100_000, 0]), np.array([0, 0, 0, 24]))
    statistics.add([0], [3], np.array([3_200_000]), np.array([24]))  # late by 3 ms: not a clock that is off
    statistics.add([1], [3], np.array([100_000]), np.array([0]))
    summary = statistics.summary()
    assert summary["clock_spread_max_ms"] == pytest.approx(0.4)
    assert summary["clock_spread_mean_ms"] == pytest.approx(0.2)
    assert summary["clock_spread_end_ms"] == pytest.approx(0.4)
    assert summary["sends_on_time_share"] == 0.5
    assert summary["send_offset_ms"]["3"] == {"median": pytest.approx(3.0), "max": pytest.approx(3.0)}
    statistics.add(
        np.zeros(0, np.uint32), [1, 2], np.zeros(0, np.int64), np.zeros(0, np.uint8)
    )  # nothing but what was heard
    assert ClockStatistics(3).summary()["clock_spread_max_ms"] is None


@given(st.integers(0, 2**31))
@settings(max_examples=20, deadline=None)
def test_late_frames_do_not_move_the_common_time(seed: int) -> None:
    """Frames that a busy processor sends late are outliers for the median: four of nine change nothing, five may."""
    random = np.random.default_rng(seed)
    shift, aligner = 0, ClockAligner()
    for most in (4, 9):
        for _ in range(50):
            late = np.zeros(9, dtype=np.int64)
            late[: random.integers(0, most, endpoint=True)] = random.integers(1, 900_000)
            for by in random.permutation(late).tolist():
                shift += aligner.hear(by - shift)
        assert (shift == 0) == (most == 4)
