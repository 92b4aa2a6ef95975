"""Frames of agents with clocks of their own, without nodes: verdicts are checked, spread and lateness told."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_agent.ros.common.graph import names
from dtsa_bench.flights.statistics import ClockStatistics
from dtsa_bench.recordings.verify.frames import SentFrames
from dtsa_bench.recordings.verify.odometry import odometry_fault
from dtsa_bench.recordings.verify.result import Mismatch
from dtsa_channel_sim import Air, Channel, ChannelConfig

MS = 1_000_000
FRAME = st.tuples(st.integers(1, 5), st.integers(0, 12 * MS), st.integers(1, 60))  # sender, ns, bytes
FRAMES = st.lists(FRAME, min_size=2, max_size=12, unique_by=lambda frame: frame[:2])


def check_on_air(config: ChannelConfig, frames: list[tuple[int, int, int]], flip: tuple[int, int] | None = None) -> int:
    """Check frames with the channel's verdicts, one receiver's bit turned round in deliveries and verdicts alike."""
    line, sent = Air(Channel(config)), SentFrames(config, own_clocks=True)
    for number, (sender, start, length) in enumerate(sorted(frames, key=lambda f: f[1])):
        line.begin((number, sender), sender, start, length)
        sent.send(number, sender, start, bytes(length))
    verdicts = sorted(line.settle(100 * MS), key=lambda v: v.frame_id)
    sent.lay({v.frame_id: v.received for v in verdicts})
    for number, v in enumerate(verdicts):
        found = sent.get(*v.frame_id)
        assert (found.on_air.start_ns, found.arrival_ns) == (v.start_ns, v.arrival_ns)
        received = v.received.copy()
        if flip and number == flip[0] % len(frames):
            received[flip[1]] ^= True
        if received.any():
            sent.deliver(*v.frame_id, found.data, received)
        sent.judged(*v.frame_id, received, v.lost, v.collided)
    sent.check_overlaps()
    return sent.check_verdicts([])


@given(FRAMES, st.floats(0.0, 0.5), st.integers(0, 9), st.sampled_from(("plain", "crazyflie")))
@settings(max_examples=120, deadline=None)
def test_the_channels_own_verdicts_always_pass(frames, loss, seed, radio):
    assert check_on_air(ChannelConfig(agents=5, loss=loss, seed=seed, radio=radio), frames) == len(frames)


@given(FRAMES, st.integers(0, 99), st.integers(0, 4))
@settings(max_examples=60, deadline=None)
def test_one_wrong_receiver_never_passes(frames: list[tuple[int, int, int]], frame: int, receiver: int) -> None:
    with pytest.raises(Mismatch):
        check_on_air(ChannelConfig(agents=5), frames, flip=(frame, receiver))


def test_two_frames_at_one_time_are_never_both_heard_but_a_dropped_one_disturbs_nobody() -> None:
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
    length_ns = ChannelConfig(agents=3).airtime.total_ns(24)
    with pytest.raises(Mismatch, match="both at cf3"):
        both_heard(length_ns // 2, second=1).check_overlaps()
    both_heard(length_ns, second=1).check_overlaps()
    sent = both_heard(length_ns // 2, second=0)
    sent.check_overlaps()
    assert sent.safety()["overlapping_pairs"] == 1


def both_heard(gap_ns: int, second: int) -> SentFrames:
    """A frame of agent 1 and one of agent 2 that starts ``gap_ns`` later; agent 3 has heard both or not."""
    sent = SentFrames(ChannelConfig(agents=3), own_clocks=True)
    for sender, start, heard in ((1, 0, True), (2, gap_ns, second > 0)):
        sent.send(0, sender, start, bytes(24))
        received = np.array([False, False, heard])
        sent.deliver(0, sender, bytes(24), received)
        sent.judged(0, sender, received, 0, 0)
    return sent


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


@pytest.mark.parametrize(("verdicts", "not_judged", "collided"), [((), 3, 0), (((0, 2), (1, 0)), 1, 1)])
def test_frames_without_a_verdict_are_counted(verdicts, not_judged, collided):
    frames = SentFrames(ChannelConfig(agents=3), own_clocks=True)
    for slot in range(3):
        frames.send(slot, slot + 1, slot * 10_000_000, bytes(24))
    for slot, met in verdicts:
        frames.judged(slot, slot + 1, np.zeros(3, dtype=np.bool_), 0, met)
    assert frames.safety() == {
        "frames": 3, "frames_not_judged": not_judged, "overlapping_pairs": 0, "frames_collided": collided,
    }  # fmt: skip


SLOT_NS = 20_000_000
SLOTS = 10
FIRST = 6  # slot of the first report
SPEED = 1.0  # m/s


def rows() -> tuple[np.ndarray, np.ndarray, list]:
    """Ten slots of an agent that flies along x, whose first reports have missed their slots' accounts."""
    times = names.TIME_ZERO_NS + np.arange(SLOTS) * SLOT_NS
    found = np.zeros((SLOTS, 3))
    found[FIRST:, 0] = 0.9 + np.arange(SLOTS - FIRST) * SPEED * SLOT_NS / 1e9
    reports = [(slot, found[slot].copy(), SPEED) for slot in range(FIRST, SLOTS)]
    return times, found, reports


def fault(found: np.ndarray, carried: np.ndarray | None = None) -> tuple[int, float, float] | None:
    times, _, reports = rows()
    return odometry_fault(times, found, np.zeros(SLOTS, bool) if carried is None else carried, reports, SLOT_NS)


def test_an_agent_stays_where_it_was_until_its_first_report_and_where_one_is_late() -> None:
    _, found, _ = rows()
    assert fault(found) is None
    _, found, _ = rows()
    late = np.arange(SLOTS) == FIRST + 1
    found[late] = found[FIRST]
    assert fault(found) is not None
    assert fault(found, late) is None


@pytest.mark.parametrize("slot", [2, FIRST - 1, FIRST, FIRST + 2])
def test_a_place_that_was_not_reported_is_found(slot: int) -> None:
    _, found, _ = rows()
    found[slot, 1] += 0.01
    assert fault(found) == (slot, pytest.approx(0.01, abs=0.02), pytest.approx(1e-6, abs=1e-9))
