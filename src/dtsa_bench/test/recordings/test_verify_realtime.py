"""What `verify` finds in the bags of flights in real time."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fly_helpers import PATIENCE_S, fly, flying, pid_of
from waiting import wait_for

pytest.importorskip("dtsa_msgs.msg")

from dtsa_agent.core.frame import decode_extended
from dtsa_bench.recordings.bag.reader import Bag, Message
from dtsa_bench.recordings.bag.writer import BagWriter
from dtsa_bench.recordings.verify import Result, verify_bag
from dtsa_bench.recordings.verify.frames import SentFrames
from dtsa_bench.recordings.verify.result import Mismatch
from dtsa_channel_sim import ChannelConfig

pytestmark = pytest.mark.ros
BEGUN = 50  # a slot in which all are under way


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight of two processes in real time that lose a fifth of all frames."""
    out = tmp_path_factory.mktemp("flown") / "flight"
    words = ("--agents", "4", "--moving", "2", "--policy", "tdma", "--processes", "2", "--seed", "9", "--loss", "0.2")
    fly(out, *words, "--mode", "realtime", "--timeout-s", "1.5", "--no-picture")
    return out


@pytest.fixture(scope="module")
def waiting(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight whose radios are behind lines, in slots that lie apart: frames wait for a reception, or meet."""
    out = tmp_path_factory.mktemp("waiting") / "flight"
    words = ("--agents", "6", "--policy", "aloha", "--radio", "crazyflie", "--clock-offset-ns", "2000000", "--no-align")
    fly(out, *words, "--processes", "2", "--seed", "9", "--mode", "realtime", "--timeout-s", "3", "--no-picture")
    return out


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
    """An edit of one message of a topic: the first from slot `BEGUN` on that ``change`` says it has changed."""
    done: list[bool] = []

    def edit(message: Message, value: Any, pack: Callable[[Any], bytes]) -> bytes | None:
        if done or message.topic != topic or int(np.max(value.slot, initial=0)) < BEGUN:
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


def other_sender(message: Any) -> bool:
    """Of a frame that was delivered: an agent that has not sent."""
    there = len(message.sender) == 1
    if there:
        message.sender[0] = int(message.sender[0]) % 4 + 1
    return there


def other_choice(message: Any) -> bool:
    message.chosen[0] += 1
    return True


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
        ("slot", other_sender, "slot.sender"),
        ("reception", no_receiver, "reception.received"),
        ("decision", other_choice, "decision"),
    ],
)
def test_a_changed_message_is_named(flown: Path, tmp_path: Path, topic: str, change: Any, what: str) -> None:
    result = rewritten(flown, tmp_path / "changed", once(f"/swarm/{topic}", change))
    assert result.difference is not None
    assert any(result.difference.what.startswith(part) for part in what.split("|")), result.difference
    assert result.difference.slot is not None


@pytest.mark.parametrize("topic", ["transmission", "frame", "slot"])
def test_a_missing_message_is_found_without_the_digest(flown: Path, tmp_path: Path, topic: str) -> None:
    dropped = []

    def edit(message: Message, value: Any, pack: Callable[[Any], bytes]) -> bytes | None:
        wanted = message.topic == f"/swarm/{topic}" and int(value.slot) >= BEGUN and len(value.data)
        if wanted and not dropped:
            dropped.append(message)
            return None
        return message.data

    assert not rewritten(flown, tmp_path / "less", edit).ok
    assert dropped


def test_untouched_bags_pass_and_what_is_not_checked_is_said(flown: Path, tmp_path: Path) -> None:
    result = rewritten(flown, tmp_path / "same", lambda message, value, pack: message.data)
    assert result.ok, result.difference
    for what in ("frames equal to their sender's state", "frames heard as they were sent", "verdicts made again",
                 "frames taken in as they were delivered", "decisions made again", "reception",
                 "decision", "odometry", "digest of all messages"):  # fmt: skip
        assert result.checked[what] > 0
    assert "motion" in result.skipped
    with Bag(flown / "bag") as bag:
        sent = sum(message.topic == "/swarm/frame" for message in bag.messages())
    assert result.checked["frames that nobody heard together with another"] == sent


def test_bags_from_before_radios_had_names_are_checked_as_they_were(flown: Path, tmp_path: Path) -> None:
    with Bag(flown / "bag") as bag:
        channel = {name: value for name, value in bag.config["channel"].items() if name != "radio"}
    result = rewritten(flown, tmp_path / "old", lambda message, value, pack: message.data, channel=channel)
    assert result.ok, result.difference


def test_radios_behind_lines_are_checked_by_their_times(waiting: Path, tmp_path: Path) -> None:
    """Frames that waited began later than they were handed over, and receptions that queued arrived later."""
    result = rewritten(waiting, tmp_path / "same", lambda message, value, pack: message.data)
    assert result.ok, result.difference
    assert result.checked["frames taken in as they were delivered"] > 100
    with Bag(waiting / "bag") as bag:
        channel = bag.config["channel"]
    plain = rewritten(waiting, tmp_path / "plain", lambda m, v, pack: m.data, channel={**channel, "radio": "plain"})
    assert "slot.stamp" in str(plain.difference)


def test_a_mission_whose_slots_follow_the_station_is_checked_too(tmp_path: Path) -> None:
    """Vehicles that are not simulated: nothing can be flown again, but frames and verdicts must still be right."""
    words = ("--agents", "5", "--policy", "dtsa", "--loss", "0.2", "--processes", "1", "--timeout-s", "1.5")
    fly(tmp_path / "flight", *words, "--no-picture")
    result = rewritten(tmp_path / "flight", tmp_path / "copy", lambda message, value, pack: message.data, mode="cflib")
    assert result.mode == "cflib"
    assert result.ok, result.difference
    assert result.checked["verdicts made again"] > 100
    changed = once("/swarm/reception", no_receiver)
    assert not rewritten(tmp_path / "flight", tmp_path / "bad", changed, mode="cflib").ok


def test_a_flight_that_an_agent_has_left_is_checked_too(tmp_path: Path) -> None:
    """What made it leave came from outside; what it decided in the slot in which it said so follows from its frame."""
    words = ("--agents", "4", "--moving", "2", "--policy", "lease", "--mode", "realtime", "--slot-ms", "20")
    out = tmp_path / "flight"
    words += ("--clock-offset-ns", "200000")
    with flying(out, *words, "--timeout-s", "3600", "--respawn", "0", "--no-picture") as flight:
        leaving = pid_of(flight.pid, 3)
        os.kill(leaving, signal.SIGTERM)
        wait_for(lambda: not Path(f"/proc/{leaving}").exists())
        flight.send_signal(signal.SIGINT)
        assert flight.wait(PATIENCE_S) == 130
    result = verify_bag(out)
    assert result.ok, result.difference
    assert 0.0 < result.safety["clock_spread_mean_ms"] <= result.safety["clock_spread_max_ms"] < 10.0
    with Bag(out / "bag") as bag:
        last = [bytes(message.data) for _, message in bag.typed(["/swarm/frame"]) if message.agent == 3][-1]
    assert decode_extended(last).leaving


@pytest.mark.parametrize("earlier", [True, False])
def test_no_sender_hears_what_is_on_the_air_meanwhile(earlier: bool) -> None:
    """Neither the one that began first nor the other."""
    frames = SentFrames(ChannelConfig(agents=3), own_clocks=True)
    for sender, start_ns in ((1, 0), (2, 100_000)):
        frames.send(0, sender, start_ns, bytes(24))
    frames.deliver(0, 2 if earlier else 1, bytes(24), np.array([earlier, not earlier, False]))
    with pytest.raises(Mismatch, match="who sends does not hear"):
        frames.check_overlaps()


@pytest.mark.parametrize(("verdicts", "not_judged", "collided"), [((), 3, 0), (((0, 2), (1, 0)), 1, 1)])
def test_frames_without_a_verdict_are_counted(
    verdicts: tuple[tuple[int, int], ...], not_judged: int, collided: int
) -> None:
    frames = SentFrames(ChannelConfig(agents=3), own_clocks=True)
    for slot in range(3):
        frames.send(slot, slot + 1, slot * 10_000_000, bytes(24))
    for slot, met in verdicts:
        frames.judged(slot, slot + 1, np.zeros(3, dtype=np.bool_), 0, met)
    assert frames.safety() == {
        "frames": 3, "frames_not_judged": not_judged, "overlapping_pairs": 0, "frames_collided": collided,
    }  # fmt: skip
