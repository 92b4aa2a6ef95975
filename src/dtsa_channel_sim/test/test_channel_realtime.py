"""Arbitration on one time line: whatever the order of arrival, and the same as slot by slot."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_agent.core.errors import LocalProtocolError
from dtsa_channel_sim import Channel, ChannelConfig, RealtimeArbiter

MS = 1_000_000
FRAMES = st.lists(st.tuples(st.integers(1, 6), st.integers(0, 30 * MS), st.integers(1, 60)), min_size=1, max_size=40)


def summary(verdicts):
    return [(v.frame_id, v.sender, v.slot, v.received.tolist(), v.lost, v.collided) for v in verdicts]


def arbiter(**config):
    return RealtimeArbiter(Channel(ChannelConfig(agents=6, **config)))


@given(FRAMES, st.randoms(use_true_random=False), st.integers(50_000, 5 * MS))
@settings(max_examples=80, deadline=None)
def test_order_and_rhythm_do_not_matter(frames, order, step):
    frames = [(i, *frame) for i, frame in enumerate(dict.fromkeys(frames))]
    at_once = arbiter(loss=0.2, seed=4)
    for frame in frames:
        at_once.push(*frame)
    expected = summary(at_once.settle(60 * MS))
    assert len(expected) == len(frames)
    assert at_once.pending == 0
    # Now in random order, each frame just in time for the settling that needs it.
    stepwise = arbiter(loss=0.2, seed=4)
    order.shuffle(frames)
    result, now = [], 0
    while now < 60 * MS:
        now += step
        for frame in frames:
            if now - step <= frame[2] < now:
                stepwise.push(*frame)
        result += summary(stepwise.settle(now))
    assert stepwise.late == 0
    # Frames of equal end, start and sender aside, the order of verdicts is that of the ends, too.
    assert sorted(result) == sorted(expected)


@given(FRAMES)
@settings(max_examples=80, deadline=None)
def test_against_overlap_by_pairs(frames):
    line = arbiter()
    airtime = Channel(ChannelConfig(agents=6)).config.airtime
    for i, frame in enumerate(frames):
        line.push(i, *frame)
    for verdict in line.settle(60 * MS):
        sender, start, length = frames[verdict.frame_id]
        first, last = start + airtime.ramp_up_ns, start + airtime.total_ns(length)
        bad = {sender}
        for i, (other, begin, size) in enumerate(frames):
            if i == verdict.frame_id:
                continue
            end = begin + airtime.total_ns(size)
            if begin < last and first < end:
                bad.add(other)
            if begin + airtime.ramp_up_ns < last and first < end:
                bad |= set(range(1, 7)) - {other}
        expected = [agent not in bad for agent in range(1, 7)]
        assert verdict.received.tolist() == expected
        assert (verdict.start_ns, verdict.end_ns, verdict.arrival_ns) == (start, last, last + 300_000)


def test_both_frames_of_a_late_transmission_are_destroyed():
    line = arbiter()
    line.push("late", 1, 10 * MS - 200_000, 60)
    line.push("owner", 2, 10 * MS, 24)
    verdicts = line.settle(20 * MS)
    assert [v.frame_id for v in verdicts] == ["late", "owner"]
    assert [v.collided for v in verdicts] == [5, 5]
    assert [v.slot for v in verdicts] == [0, 1]


def test_lockstep_and_time_line_agree():
    channel, line = Channel(ChannelConfig(agents=6, loss=0.3, seed=9)), arbiter(loss=0.3, seed=9)
    for slot in range(200):
        sender = slot % 6 + 1
        line.push(slot, sender, slot * 10 * MS + 1 * MS, 30)
        (verdict,) = line.settle((slot + 1) * 10 * MS)
        assert np.array_equal(verdict.received, channel.arbitrate(slot, (sender,)).mask(6)[0])


def test_nothing_is_settled_before_it_has_left_the_air():
    line = arbiter()
    line.push(0, 1, 0, 24)
    assert line.settle(270_499) == []
    assert line.pending == 1
    assert len(line.settle(270_500)) == 1
    assert line.settle(10 * MS) == []


def test_late_frames_are_counted_and_cannot_undo_verdicts():
    line = arbiter()
    line.push(0, 1, 0, 24)
    (first,) = line.settle(1 * MS)
    assert first.received.sum() == 5
    assert not first.late
    line.push(1, 2, 100_000, 24)
    (second,) = line.settle(2 * MS)
    assert second.late
    assert second.collided == 5
    assert line.late == 1


def test_memory_does_not_grow():
    line = arbiter()
    for slot in range(500):
        line.push(slot, slot % 6 + 1, slot * MS, 60)
        line.settle(slot * MS)
    assert len(line._past) < 5
    assert line.pending < 5


def test_changes_in_flight_begin_with_the_next_slot():
    channel = Channel(ChannelConfig(agents=6))
    line = RealtimeArbiter(channel)
    received = []
    for slot in range(10):
        if slot == 4:
            assert channel.set(jam=True).slot == 4
        line.push(slot, 1, slot * 10 * MS + 1, 24)
        received += [int(v.received.sum()) for v in line.settle((slot + 1) * 10 * MS - 1)]
    assert received == [5, 5, 5, 5, 0, 0, 0, 0, 0, 0]


@pytest.mark.parametrize("frame", [(0, 0, 0, 24), (0, 7, 0, 24), (0, 1, 0, 0), (0, 1, 0, 256), ("twice", 1, 5, 5)])
def test_impossible_frames(frame):
    line = arbiter()
    line.push("twice", 1, 0, 24)
    with pytest.raises(LocalProtocolError):
        line.push(*frame)
