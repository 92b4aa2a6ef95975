"""Integration: what `verify` finds in the bags of flights in real time."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fly_helpers import fly, start_flight
from waiting import wait_for

pytest.importorskip("dtsa_msgs.msg")

from dtsa_agent.core.frame import decode_extended
from dtsa_bench.log.bag.reader import Bag, BagMessage
from dtsa_bench.log.bag.writer import BagWriter
from dtsa_bench.log.record import SLOT_RECORD, TYPE
from dtsa_bench.log.verify.check import verify_bag
from dtsa_bench.log.verify.result import Result

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
            if message.topic == SLOT_RECORD:
                data = edit(
                    message,
                    bag.decode(message),
                    lambda value: bytes(bag.typestore(SLOT_RECORD).serialize_cdr(value, TYPE)),
                )
            if data is not None:
                writer.write(channels[message.topic], data, message.log_time_ns, message.publish_time_ns)
        writer.close()
    return verify_bag(copy)


def untouched(message: BagMessage, value: Any, pack: Callable[[Any], bytes]) -> bytes:
    return message.data


def once(change: Callable[[Any], bool]) -> Callable[..., bytes | None]:
    """An edit of one record: the first from slot `BEGUN` on that ``change`` says it has changed."""
    done: list[bool] = []

    def edit(message: BagMessage, value: Any, pack: Callable[[Any], bytes]) -> bytes | None:
        if done or value.slot < BEGUN:
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
    at = np.isin(message.agent, message.sender)
    message.offset_ns[at] += 1000
    return bool(at.any())


def frame_time(message: Any) -> bool:
    message.sent_ns += 1000
    return bool(len(message.sent_ns))


def not_heard(message: Any) -> bool:
    there = len(message.heard_sender) > 0
    for name in ("heard_sender", "heard_slot", "heard_ns", "heard_by"):  # four agents: a byte a frame
        setattr(message, name, getattr(message, name)[1:])
    return there


def first_of(field: str, value: Callable[[Any, int], int]) -> Callable[[Any], bool]:
    """A change of the first entry of a field, from the message and what the entry was, if that makes a difference."""

    def change(message: Any) -> bool:
        entries = getattr(message, field)
        if not len(entries) or value(message, int(entries[0])) == entries[0]:
            return False
        entries[0] = value(message, int(entries[0]))
        return True

    return change


heard_early = first_of("heard_ns", lambda _, was: -(10**9))
heard_by_all = first_of("heard_by", lambda _, was: 0b1111)
no_receiver = first_of("received", lambda _, was: 0)
own_bit = first_of("received", lambda message, was: was | 1 << (int(message.sender[0]) - 1))
# Of a frame that was delivered: an agent that has not sent.
other_sender = first_of("sender", lambda message, was: was % 4 + 1 if len(message.sender) == 1 else was)
other_choice = first_of("chosen", lambda _, was: was + 1)


def lost_position(message: Any) -> bool:
    message.track *= np.nan
    return len(message.sender) > 0


def long_frame(message: Any) -> bool:
    if len(message.sender) != 1:
        return False
    message.length, message.data = np.array([255], np.uint8), np.zeros(255, np.uint8)
    return True


other_outcome = first_of("lost", lambda _, was: was + 1)


@pytest.mark.parametrize(("change", "what"), [
    (frame_byte, "frame"), (sending_time, "offset_ns"), (frame_time, "offset_ns"), (heard_early, "heard_ns"),
    (other_choice, "chosen"), (not_heard, "digest|chosen|score|reason"), (heard_by_all, "heard_by"),
    (own_bit, "received"), (no_receiver, "heard_by|received"), (other_sender, "frame.sender|heard"),
    (other_outcome, "lost|received, lost"), (lost_position, "frame"),
])  # fmt: skip
def test_a_changed_record_is_named(flown: Path, tmp_path: Path, change: Any, what: str) -> None:
    result = rewritten(flown, tmp_path / "changed", once(change))
    assert any(result.difference.what.startswith(part) for part in what.split("|")), result.difference
    assert result.difference.slot is not None


def test_a_missing_record_is_found_without_the_digest(flown: Path, tmp_path: Path) -> None:
    dropped = []

    def edit(message: BagMessage, value: Any, pack: Callable[[Any], bytes]) -> bytes | None:
        if dropped or value.slot < BEGUN:
            return message.data
        return dropped.append(message)

    assert rewritten(flown, tmp_path / "less", edit).difference.slot == BEGUN
    assert dropped


def test_untouched_bags_pass_also_those_from_before_radios_had_names(flown: Path, tmp_path: Path) -> None:
    result = rewritten(flown, tmp_path / "same", untouched)
    assert result.ok, result.difference
    for what in ("frames equal to their sender's state", "verdicts made again", "decisions made again",
                 "frames taken in as they were delivered", "slot records", "odometry",
                 "digest of all messages"):  # fmt: skip
        assert result.checked[what] > 0
    assert "motion" in result.skipped
    with Bag(flown / "bag") as bag:
        sent = sum(len(record.sender) for _, record in bag.typed([SLOT_RECORD]))
    assert result.checked["verdicts made again"] == sent
    with Bag(flown / "bag") as bag:
        channel = {name: value for name, value in bag.config["channel"].items() if name != "radio"}
    result = rewritten(flown, tmp_path / "old", untouched, channel=channel)
    assert result.ok, result.difference


def test_radios_behind_lines_are_checked_by_their_times(waiting: Path, tmp_path: Path) -> None:
    """Frames that waited began later than they were handed over, and receptions that queued arrived later."""
    result = rewritten(waiting, tmp_path / "same", untouched)
    assert result.ok, result.difference
    assert result.checked["frames taken in as they were delivered"] > 100
    with Bag(waiting / "bag") as bag:
        channel = bag.config["channel"]
    plain = rewritten(waiting, tmp_path / "plain", untouched, channel={**channel, "radio": "plain"})
    assert not plain.ok
    assert rewritten(waiting, tmp_path / "long", once(long_frame)).difference.what == "length"


def test_a_flight_that_an_agent_has_left_is_checked_too(tmp_path: Path) -> None:
    """What made it leave came from outside; what it decided in the slot in which it said so follows from its frame."""
    words = ("--agents", "4", "--moving", "2", "--policy", "lease", "--mode", "realtime", "--slot-ms", "20")
    words += ("--clock-offset-ns", "200000", "--timeout-s", "3600", "--respawn", "0", "--no-picture")
    with start_flight(tmp_path, *words) as flight:
        leaving = flight.pid_of(3)
        os.kill(leaving, signal.SIGTERM)
        wait_for(lambda: not Path(f"/proc/{leaving}").exists())
        flight.interrupt()
    assert flight.safety["frames"] > 0
    with Bag(flight.out / "bag") as bag:
        records = [record for _, record in bag.typed([SLOT_RECORD]) if record.sender.tolist() == [3]]
        last = records[-1].data.tobytes()
    assert decode_extended(last).leaving
