"""Flights in real time, agents on their own clocks; and what `verify` finds in their bags."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from metronome import flown_again_when_overloaded

from dtsa_agent.core.reference.alignment import ClockAligner
from dtsa_bench.bag.reader import Bag, Message
from dtsa_bench.bag.writer import BagWriter
from dtsa_bench.fly.clock_statistics import ClockStatistics
from dtsa_bench.verify import Result, verify_bag
from dtsa_bench.verify.frames import SentFrames
from dtsa_bench.verify.result import Mismatch
from dtsa_channel_sim import Air, Channel, ChannelConfig, ClockConfig, make_clocks

MS = 1_000_000
DRIFT_PPM = 1000.0  # much more than a crystal's, to see in seconds what else takes minutes
AGENTS = 4
# A frame is on the air for 7.8 of 10 ms, so that agents that are 2.2 ms apart disturb each other.
TIGHT = (
    "--agents", str(AGENTS), "--moving", "2", "--policy", "tdma", "--processes", "2", "--seed", "9",
    "--bitrate", "31250",
    "--mode", "realtime", "--clock-drift-ppm", str(DRIFT_PPM), "--timeout-s", "3",
)  # fmt: skip


def fly(out: Path, *words: str) -> dict[str, Any]:
    command = [sys.executable, "-m", "dtsa_bench", "fly", "--out", str(out), "--no-picture", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    return dict(json.loads((out / "summary.json").read_text()))


@pytest.fixture(scope="module")
def aligned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("aligned") / "flight"
    fly(out, *TIGHT, "--loss", "0.2")
    return out


def drifts(seconds: float) -> list[float]:
    """ms that each clock gains in a time."""
    clocks = make_clocks(ClockConfig(drift_ppm=DRIFT_PPM, seed=9), AGENTS)
    return [clock.drift_ppb * seconds * 1e-6 for clock in clocks]


@pytest.mark.ros
@flown_again_when_overloaded
def test_with_alignment_slots_stay_together_and_without_frames_collide(aligned: Path, tmp_path: Path) -> None:
    apart = fly(tmp_path / "apart", *TIGHT, "--no-align")
    together = json.loads((aligned / "summary.json").read_text())
    # Left alone the clocks drift apart, each at its own rate: 5 ms by the end, far more than the 2.2 ms between frames.
    gained = drifts(apart["flight_time_s"])
    assert apart["clock_spread_end_ms"] == pytest.approx(max(gained) - min(gained), abs=0.5)
    assert apart["clock_spread_end_ms"] > 3.0
    assert together["clock_spread_end_ms"] < 1.0
    results = {path: verify_bag(path) for path in (aligned, tmp_path / "apart")}
    for result in results.values():
        assert result.ok, result.difference
    assert results[tmp_path / "apart"].safety["frames_collided"] > 20
    # A busy machine may make a frame late now and then; clocks do not.
    assert results[aligned].safety["frames_collided"] < results[tmp_path / "apart"].safety["frames_collided"] / 4


@pytest.mark.ros
def test_frames_of_a_fast_clock_arrive_before_the_slot_of_their_report(tmp_path: Path) -> None:
    words = (
        "--agents",
        "3",
        "--moving",
        "2",
        "--policy",
        "tdma",
        "--processes",
        "1",
        "--mode",
        "realtime",
        "--no-align",
    )
    fly(tmp_path / "fast", *words, "--clock-offset-ns", "4000000", "--timeout-s", "1")
    with Bag(tmp_path / "fast" / "bag") as bag:
        times = {(m.topic, int(v.slot)): m.log_time_ns for m, v in bag.typed(["/swarm/transmission", "/swarm/slot"])}
    early = [slot for topic, slot in times if times.get(("/swarm/slot", slot), 2**63) < times[topic, slot]]
    assert early
    result = verify_bag(tmp_path / "fast")
    assert result.ok, result.difference


@pytest.mark.ros
@flown_again_when_overloaded
def test_seventy_agents_lose_no_message(tmp_path: Path) -> None:
    """All that agents report is recorded, and a frame that one of them had not taken in would show in its view."""
    out, agents = tmp_path / "flight", 70
    fly(out, "--agents", str(agents), "--policy", "tdma", "--processes", "2", "--mode", "realtime", "--timeout-s", "2")
    slots: dict[int, list[int]] = {agent: [] for agent in range(1, agents + 1)}
    views: dict[int, dict[int, int]] = {}
    frames = heard = 0
    excused = set()  # those whose frame was not ready in time, or met another: only they think that it was heard
    with Bag(out / "bag") as bag:
        for _, message in bag.typed(["/swarm/transmission", "/swarm/slot"]):
            if hasattr(message, "heard_slot"):
                heard += len(message.sender)
                bits = np.unpackbits(message.received).sum()
                excused |= set(message.sender.tolist()) if bits < agents - 1 else set()
                continue
            frames += int((message.length > 0).sum())
            excused |= set(message.agent[(message.chosen == message.agent) & (message.length == 0)].tolist())
            for agent, digest in zip(message.agent.tolist(), message.digest.tolist(), strict=True):
                slots[agent].append(int(message.slot))
                views.setdefault(int(message.slot), {})[agent] = digest
    last = min(max(reported) for reported in slots.values())
    assert last > 150
    for reported in slots.values():
        assert reported[: last + 1] == list(range(last + 1))
    assert frames - heard <= 3  # those that were still on the air at the end
    # Without loss all views become equal; who misses a frame differs from the others until its sender's next turn.
    assert len(excused) < agents / 2
    odd = dict.fromkeys(set(slots) - excused, 0)
    for slot in range(last + 1):
        digests = list(views[slot].values())
        usual = max(set(digests), key=digests.count)
        for agent in odd:
            odd[agent] = odd[agent] + 1 if views[slot][agent] != usual else 0
            assert odd[agent] < agents - 5, f"cf{agent} has missed a frame"


@pytest.mark.ros
@flown_again_when_overloaded
def test_an_agent_that_hangs_is_named_and_the_others_fly_on(tmp_path: Path) -> None:
    out = tmp_path / "flight"
    # Its vehicle hovers where it was, and somebody may fly into it: that is not what this is about.
    words = ("--agents", "3", "--policy", "lease", "--processes", "3", "--mode", "realtime", "--tail-s", "0.5",
             "--no-stop-on-crash")  # fmt: skip
    command = [sys.executable, "-m", "dtsa_bench", "fly", "--out", str(out), "--no-picture", *words]
    flight = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    victim = 0
    try:
        until(lambda: flight.poll() is not None or mark(out).exists())
        victim = process_with(flight.pid, "ids:=[2]")
        os.kill(victim, signal.SIGSTOP)
        _, said = flight.communicate(timeout=60)
    finally:
        if victim:
            with contextlib.suppress(ProcessLookupError):
                os.kill(victim, signal.SIGKILL)
        flight.kill()
        flight.communicate()
    assert flight.returncode == 0, said
    assert "cf2 has not been heard of for 2 s; the others fly on" in said
    summary = json.loads((out / "summary.json").read_text())
    assert summary["lost_agents"] == [2]
    assert summary["end"] == "completed"
    result = verify_bag(out)
    assert result.ok, result.difference


def mark(out: Path) -> Path:
    """A file that is there once slots are being flown."""
    found = out / "bag" / "bag_0.mcap"
    return found if found.exists() and found.stat().st_size > 10_000 else out / "not yet"


def until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < deadline, "nothing happened"
        time.sleep(0.02)


def process_with(supervisor: int, argument: str) -> int:
    """The child of a flight that was started with an argument."""
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
                if parent == supervisor and argument in (entry / "cmdline").read_text().split("\0"):
                    return int(entry.name)
    raise AssertionError(f"no process with {argument}")


# What verify finds.


Edit = Callable[..., "bytes | None"]


def rewritten(original: Path, copy: Path, edit: Edit, **config: Any) -> Result:
    """The verification of a bag with other messages, finished by the real writer, so that its digest is right."""
    with Bag(original / "bag") as bag:
        writer = BagWriter(copy / "bag", {**bag.config, **config})
        channels = {name: writer.add_topic(name, topic.type) for name, topic in bag.topics.items()}
        for message in bag.messages():
            data: bytes | None = message.data
            if "/swarm/" in message.topic and message.topic != "/swarm/markers":
                kind = message.type

                def pack(value: Any, kind: str = kind) -> bytes:
                    return bytes(bag.typestore.serialize_cdr(value, kind))

                data = edit(message, bag.decode(message), pack)
            if data is not None:
                writer.write(channels[message.topic], data, message.log_time_ns, message.publish_time_ns)
        writer.close()
    return verify_bag(copy)


def once(topic: str, change: Callable[[Any], bool]) -> Callable[..., bytes | None]:
    """An edit of one message of a topic: the first from slot 100 on of which ``change`` says that it has changed it."""
    done: list[bool] = []

    def edit(message: Message, value: Any, pack: Callable[[Any], bytes]) -> bytes | None:
        if done or message.topic != topic or int(np.max(value.slot, initial=0)) < 100:
            return message.data
        for name, field in vars(value).items():
            if isinstance(field, np.ndarray):
                setattr(value, name, field.copy())
        if change(value):
            done.append(True)
            return pack(value)
        return message.data

    return edit


def frame_byte(message: Any) -> bool:
    if len(message.data):
        message.data[-1] ^= 1
    return bool(len(message.data))


def sending_time(message: Any) -> bool:
    at = np.flatnonzero(message.length)
    message.offset_ns[at] += 1000
    return bool(len(at))


def frame_time(message: Any) -> bool:
    message.header.stamp.nanosec += 1000 if message.header.stamp.nanosec < 999_000_000 else -1000
    return True


def heard_early(message: Any) -> bool:
    if len(message.heard_ns):
        message.heard_ns[0] = 0
    return len(message.heard_ns) > 0


def not_heard(message: Any) -> bool:
    """A frame less was taken in than what was decided follows from."""
    there = len(message.heard_sender) > 0
    for name in ("heard_sender", "heard_slot", "heard_in", "heard_ns", "heard_by"):  # two agents here: a byte a frame
        setattr(message, name, getattr(message, name)[1:])
    return there


def heard_by_all(message: Any) -> bool:
    there = len(message.heard_by) > 0 and bool(message.heard_by[0] != 0b11)
    if there:
        message.heard_by[0] = 0b11
    return there


def own_bit(message: Any) -> bool:
    if len(message.sender):
        message.received[0] |= 1 << (int(message.sender[0]) - 1)
    return bool(len(message.sender))


def no_receiver(message: Any) -> bool:
    there = len(message.sender) > 0 and message.received[0] != 0
    if there:
        message.received[:] = 0
    return there


def other_choice(message: Any) -> bool:
    message.chosen[0] += 1
    return True


@pytest.mark.ros
@pytest.mark.parametrize(
    ("topic", "change", "what"),
    [
        ("transmission", frame_byte, "frame.|slot.data|transmission.data"),
        ("transmission", sending_time, "transmission.offset_ns"),
        ("frame", frame_byte, "frame.|transmission.data"),
        ("frame", frame_time, "transmission.offset_ns"),
        ("report", heard_early, "report.heard_ns"),
        ("report", other_choice, "report.chosen"),
        ("report", not_heard, "report."),
        ("report", heard_by_all, "report.heard_by"),
        ("slot", frame_byte, "slot.data"),
        ("slot", own_bit, "slot.received"),
        ("slot", no_receiver, "reception.received"),
        ("reception", no_receiver, "reception.received"),
        ("decision", other_choice, "decision"),
    ],
)
def test_a_changed_message_is_named(aligned: Path, tmp_path: Path, topic: str, change: Any, what: str) -> None:
    result = rewritten(aligned, tmp_path / "changed", once(f"/swarm/{topic}", change))
    assert result.difference is not None
    assert any(result.difference.what.startswith(part) for part in what.split("|")), result.difference
    assert result.difference.slot is not None


@pytest.mark.ros
@pytest.mark.parametrize("topic", ["transmission", "frame", "slot"])
def test_a_missing_message_is_found_without_the_digest(aligned: Path, tmp_path: Path, topic: str) -> None:
    dropped = []

    def edit(message: Message, value: Any, pack: Callable[[Any], bytes]) -> bytes | None:
        wanted = message.topic == f"/swarm/{topic}" and int(value.slot) >= 100 and len(value.data)
        if wanted and not dropped:
            dropped.append(message)
            return None
        return message.data

    assert not rewritten(aligned, tmp_path / "less", edit).ok
    assert dropped


@pytest.mark.ros
def test_untouched_bags_pass_and_what_is_not_checked_is_said(aligned: Path, tmp_path: Path) -> None:
    result = rewritten(aligned, tmp_path / "same", lambda message, value, pack: message.data)
    assert result.ok, result.difference
    for what in ("frames equal to their sender's state", "frames heard as they were sent", "verdicts made again",
                 "frames taken in as they were delivered", "decisions made again", "reception",
                 "decision", "odometry", "digest of all messages"):  # fmt: skip
        assert result.checked[what] > 0
    assert "motion" in result.skipped


@pytest.mark.ros
def test_a_mission_whose_slots_follow_the_station_is_checked_too(tmp_path: Path) -> None:
    """Vehicles that are not simulated: nothing can be flown again, but frames and verdicts must still be right."""
    words = ("--agents", "5", "--policy", "dtsa", "--loss", "0.2", "--processes", "1", "--timeout-s", "2")
    fly(tmp_path / "flight", *words)
    result = rewritten(tmp_path / "flight", tmp_path / "copy", lambda message, value, pack: message.data, mode="cflib")
    assert result.mode == "cflib"
    assert result.ok, result.difference
    assert result.checked["verdicts made again"] > 100
    changed = once("/swarm/reception", no_receiver)
    assert not rewritten(tmp_path / "flight", tmp_path / "bad", changed, mode="cflib").ok


# Without nodes.

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
    statistics.add(0, [1, 2], [0, 400_000], [0, 0])
    statistics.add(0, [3], [3_200_000], [24])  # late by 3 ms: not a clock that is off
    statistics.add(1, [1, 2, 3], [100_000, 0, 100_000], [0, 24, 0])
    summary = statistics.summary()
    assert summary["clock_spread_max_ms"] == pytest.approx(0.4)
    assert summary["clock_spread_mean_ms"] == pytest.approx(0.2)
    assert summary["clock_spread_end_ms"] == pytest.approx(0.4)
    assert summary["sends_on_time_share"] == 0.5
    assert summary["send_offset_ms"]["3"] == {"median": pytest.approx(3.0), "max": pytest.approx(3.0)}
    assert ClockStatistics(3).summary()["clock_spread_max_ms"] is None


@given(st.integers(0, 2**31), st.floats(0.0, 0.5))
@settings(max_examples=10, deadline=None)
def test_late_frames_do_not_move_the_common_time(seed: int, late_share: float) -> None:
    """Frames that a busy processor sends late are outliers for the median as long as they are fewer than half."""
    random = np.random.default_rng(seed)
    shift = 0
    aligner = ClockAligner()
    for _ in range(9 * 50):
        late = int(random.integers(0, 900_000)) if random.random() < late_share * 0.5 else 0
        shift += aligner.hear(late - shift)
    assert abs(shift) < 300_000
