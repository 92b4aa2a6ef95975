"""The air: one time line, whatever the order of arrival; the same as slot by slot; and what a radio senses of it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_agent.core.errors import LocalProtocolError
from dtsa_channel_sim import Air, Channel, ChannelConfig, OnAir

MS = 1_000_000
FRAMES = st.lists(st.tuples(st.integers(1, 6), st.integers(0, 30 * MS), st.integers(1, 60)), min_size=1, max_size=40)


def summary(verdicts):
    return [
        (v.frame_id, v.sender, v.slot, v.start_ns, v.arrival_ns, v.received.tolist(), v.lost, v.collided)
        for v in verdicts
    ]


def arbiter(**config):
    return Air(Channel(ChannelConfig(agents=6, **config)))


@given(FRAMES, st.randoms(use_true_random=False), st.integers(50_000, 5 * MS), st.sampled_from(["plain", "crazyflie"]))
@settings(max_examples=140, deadline=None)
def test_order_and_rhythm_do_not_matter(frames, order, step, radio):
    frames = [(i, *frame) for i, frame in enumerate(dict.fromkeys(frames))]
    if radio != "plain":  # its line sends frames of one moment in the order in which they were handed over
        frames = list({frame[1:3]: frame for frame in frames}.values())
    at_once, stepwise = (arbiter(loss=0.2, seed=4, radio=radio) for _ in range(2))
    for frame in frames:
        at_once.begin(*frame)
    expected = summary(at_once.resolve(60 * MS))
    assert len(expected) == len(frames)
    assert at_once.pending == 0
    # Now in random order, each frame just in time for the settling that needs it.
    order.shuffle(frames)
    result, now = [], 0
    while now < 60 * MS:
        now += step
        for frame in frames:
            if now - step <= frame[2] < now:
                stepwise.begin(*frame)
        result += summary(stepwise.resolve(now))
    assert stepwise.late == 0
    # Frames of equal end, start and sender aside, the order of verdicts is that of the ends, too.
    assert sorted(result) == sorted(expected)


@given(FRAMES)
@settings(max_examples=80, deadline=None)
def test_against_overlap_by_pairs(frames):
    line = arbiter()
    airtime = Channel(ChannelConfig(agents=6)).config.airtime
    for i, frame in enumerate(frames):
        line.begin(i, *frame)
    for verdict in line.resolve(60 * MS):
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


SLOTS = st.lists(st.lists(st.integers(1, 6), unique=True, max_size=4), min_size=1, max_size=12)
MEDIA = st.fixed_dictionaries(
    {"loss": st.sampled_from([0.0, 0.3])},
    optional={
        "range_m": st.just(4.0),
        "capture_db": st.just(6.0),
        "partition": st.just([[1, 2, 3], [4, 5, 6]]),
        "burst_length": st.just(3.0),
    },
)


@given(SLOTS, MEDIA, st.integers(0, 99), st.integers(1, 60))
@settings(max_examples=80, deadline=None)
def test_slots_are_transmissions_that_start_together(slots, medium, seed, length):
    config = ChannelConfig(agents=6, seed=seed, **medium)
    places = np.random.default_rng(seed).uniform(-4.0, 4.0, (3, 6))
    channel, line = Channel(config), Air(Channel(config))
    for slot, senders in enumerate(slots):
        by_slot = channel.arbitrate(slot, senders, [length] * len(senders), places)
        for sender in senders:
            line.begin((slot, sender), sender, slot * config.slot_ns, length)
        verdicts = {v.sender: v for v in line.resolve((slot + 1) * config.slot_ns, places)}
        assert sorted(verdicts) == sorted(senders)
        mask = by_slot.mask(6)
        for row, sender in enumerate(senders):
            assert np.array_equal(verdicts[sender].received, mask[row])
            assert verdicts[sender].lost == (by_slot.lost or (0,) * 6)[row]
            assert verdicts[sender].collided == (by_slot.collided or (0,) * 6)[row]


@given(
    FRAMES, st.integers(0, 31 * MS), st.integers(1, 3),
    st.sampled_from([{}, {"range_m": 4.0}, {"partition": [[1, 2, 3, 7], [4, 5, 6]]}]),
)  # fmt: skip
@settings(max_examples=120, deadline=None)
def test_a_radio_senses_what_would_destroy_a_frame_there(frames, when, listener, medium):
    """Agent 7, beside the listener, sends for a nanosecond: the listener receives that unless its air is busy."""
    places = np.random.default_rng(when).uniform(-4.0, 4.0, (3, 7))
    places[:, 6] = places[:, listener - 1]
    channel = Channel(ChannelConfig(agents=7, **medium))
    line = Air(channel)
    others = []
    for i, (sender, start, length) in enumerate(frames):
        line.begin(i, sender, start, length)
        others.append(OnAir.of(channel.config.airtime, sender, start, length))
    probe = channel.medium(0).resolve(0, OnAir(7, when, when, when + 1), others, places)
    assert line.busy(listener, when, places) != probe.received[listener - 1]


def test_a_frame_is_not_sensed_before_its_first_bit_and_not_after_its_last():
    line = arbiter()
    line.begin(0, 1, 1 * MS, 24)
    times = [1 * MS - 1, 1 * MS, 1_129_999, 1_130_000, 1_270_499, 1_270_500]
    assert [line.busy(2, when) for when in times] == [False, False, False, True, True, False]
    assert [line.busy(1, when) for when in times] == [False, True, True, True, True, False]
    line.resolve(2 * MS)
    with pytest.raises(LocalProtocolError):
        line.busy(2, 1 * MS)


def test_late_frames_are_dropped_and_counted():
    line = arbiter()
    line.begin(0, 1, 0, 24)
    (first,) = line.resolve(1 * MS)
    assert first.received.sum() == 5
    assert not line.begin(1, 2, 100_000, 24)
    assert line.begin(2, 3, 1 * MS, 24)
    (third,) = line.resolve(2 * MS)
    assert third.frame_id == 2
    assert third.collided == 0
    assert line.late == 1
    assert line.pending == 0


def test_memory_does_not_grow():
    line = arbiter()
    for slot in range(500):
        line.begin(slot, slot % 6 + 1, slot * MS, 60)
        line.resolve(slot * MS)
    assert len(line._near) < 5
    assert line.pending < 5


def test_changes_in_flight_begin_with_the_next_slot():
    channel = Channel(ChannelConfig(agents=6))
    line = Air(channel)
    received = []
    for slot in range(10):
        if slot == 4:
            assert channel.set(jam=True).slot == 4
        line.begin(slot, 1, slot * 10 * MS + 1, 24)
        received += [int(v.received.sum()) for v in line.resolve((slot + 1) * 10 * MS - 1)]
    assert received == [5, 5, 5, 5, 0, 0, 0, 0, 0, 0]


@pytest.mark.parametrize("frame", [(0, 0, 0, 24), (0, 7, 0, 24), (0, 1, 0, 0), (0, 1, 0, 256), ("twice", 1, 5, 5)])
def test_impossible_frames(frame):
    line = arbiter()
    line.begin("twice", 1, 0, 24)
    with pytest.raises(LocalProtocolError):
        line.begin(*frame)


@pytest.mark.parametrize(("gap", "collided"), [(0, 0), (-1, 4), (1, 0)])
def test_frames_that_touch_do_not_collide(gap, collided):
    """The first bit of one may follow the last bit of the other at once; a nanosecond earlier both are lost."""
    channel = Channel(ChannelConfig(agents=6))
    airtime, line = channel.config.airtime, arbiter()
    first = OnAir.of(airtime, 1, 0, 24)
    second = OnAir.of(airtime, 2, first.end_ns - airtime.ramp_up_ns + gap, 24)
    assert second.air_ns == first.end_ns + gap
    assert first.overlaps(second) == second.overlaps(first) == bool(collided)
    assert second.deafens(first)  # turns to sending while the first one is on air
    assert first.deafens(second) == bool(collided)
    for frame in (second, first):
        line.begin(frame.sender, frame.sender, frame.start_ns, 24)
    verdicts = {v.sender: v for v in line.resolve(60 * MS)}
    assert verdicts[1].collided == 1 + collided
    assert verdicts[2].collided == (5 if collided else 0)


def test_a_sender_that_ends_as_another_frame_begins_hears_that_frame():
    """Its radio is back in time; one that turns to sending as the other frame ends has heard it."""
    earlier, frame, later = OnAir(1, 0, 10, 20), OnAir(2, 15, 20, 30), OnAir(3, 30, 40, 50)
    assert not earlier.deafens(frame)
    assert not later.deafens(frame)
    assert OnAir(1, 0, 10, 21).deafens(frame)
    assert OnAir(3, 29, 40, 50).deafens(frame)
