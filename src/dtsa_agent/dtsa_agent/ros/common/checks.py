"""Checks of what comes in over the graph: one function a message type; what is not received is counted by reason.

A check raises :class:`BadMessage` with one of the reasons below; nothing else about the message may be believed then.
"""

from __future__ import annotations

import json
import math
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from dtsa_msgs.msg import Process, Slot
from nav_msgs.msg import Odometry

from dtsa_agent.core.errors import RemoteProtocolError
from dtsa_agent.core.frame import FRAME_MAX

from . import names

UNREADABLE = "unreadable"  # not a message of its topic's type
OTHER_RUN = "other run"
OTHER_SENDER = "other sender"  # not of the publisher, or the process, that has sent so far
UNKNOWN = "unknown agent"
SIZES = "sizes"  # arrays that do not fit together
RANGE = "range"  # numbers that cannot be
SLOT = "slot"  # of a slot that cannot be under way
FORGED_END = "forged end"
NOT_CALLED = ""  # of a run under way that has not called this process yet: no fault, and not counted

LARGEST_SLOT = names.FIRST_CALL - 1  # 248 days of 10 ms slots
FARTHEST_M = 1e6  # no vehicle is farther from the room's centre, or faster, than this many m or m/s
FARTHEST_ODOMETRY_M, FASTEST_ODOMETRY_MPS = 1000.0, 100.0  # of vehicles that really fly
_LONGEST_TEXT, _LONGEST_NAME, _LONGEST_LINE = 65536, 200, 300  # characters
_MOST_REASONS = 64
_LOG_S = 5.0  # from one line in the log to the next


class BadMessage(RemoteProtocolError):
    """A message that is not received, for one of the reasons above; the text says what is wrong with it."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(detail)
        self.reason = reason


class Intake:
    """Counts messages that were not received, by reason, and logs it now and then if there is a logger."""

    def __init__(self, logger: Any = None) -> None:
        self._logger = logger
        self._next_line_s = 0.0
        self.counts: Counter[str] = Counter()  # by reason

    def drop(self, reason: str, detail: str) -> None:
        """Count a message."""
        self.counts[reason] += 1
        now = time.monotonic()
        if self._logger is not None and now >= self._next_line_s:
            self._next_line_s = now + _LOG_S
            self._logger.warning(f"not taken in ({reason}): {detail}; {self.counts.total()} so far"[:_LONGEST_LINE])

    @contextmanager
    def guard(self) -> Iterator[None]:
        """Drop and count what is :class:`BadMessage` within."""
        try:
            yield
        except BadMessage as error:
            if error.reason != NOT_CALLED:
                self.drop(error.reason, str(error))


def check_slot(message: Any, agents: int) -> None:
    """Check that the fields of a dtsa_msgs/Slot fit together, for N agents."""
    phase, count, lengths, received = message.phase, len(message.sender), message.length, len(message.received)
    if phase > Slot.REFUSE:
        raise BadMessage(RANGE, f"slot message of phase {phase}")
    if (message.slot > LARGEST_SLOT and phase != Slot.PREPARE) or message.heard_slot > LARGEST_SLOT:
        raise BadMessage(SLOT, f"slot message for slot {message.slot}")
    if phase != Slot.RUN and (count or len(lengths) or received):
        raise BadMessage(SIZES, f"slot message of phase {phase} with frames")
    if len(lengths) != count or received != count * ((agents + 7) // 8):
        raise BadMessage(SIZES, f"slot message: {count} senders, {len(lengths)} lengths, {received} bytes of receivers")
    if phase == Slot.RUN and not count and len(message.data):
        raise BadMessage(SIZES, "slot message with frames of no agent")
    if count:
        check_frames(lengths, message.data)
        if not all(lengths):
            raise BadMessage(SIZES, "slot message with an empty frame")
        check_ids(message.sender, agents, ascending=False)


def check_frames(lengths: Sequence[int], data: Any) -> None:
    """Check that frames are as long as the air carries, and as the bytes that are there."""
    if sum(lengths) != len(data):
        raise BadMessage(SIZES, f"{len(data)} bytes of frames, {sum(lengths)} in their lengths")
    if len(lengths) and max(lengths) > FRAME_MAX:
        raise BadMessage(SIZES, f"a frame of {max(lengths)} bytes; the air carries {FRAME_MAX}")


def check_ids(ids: Sequence[int], agents: int, ascending: bool = True) -> None:
    """Check that ids are those of different agents of N, one at least, and in order if they have to be."""
    given, distinct = list(ids), sorted(set(ids))
    if not given or distinct[0] < 1 or distinct[-1] > agents:
        raise BadMessage(UNKNOWN, f"a message for agents {given[:8]}; allowed: 1 to {agents}")
    if distinct != (given if ascending else sorted(given)):
        raise BadMessage(UNKNOWN, f"a message for agents {given[:8]}, twice or out of order")


def check_numbers(name: str, values: Iterable[float], largest: float = FARTHEST_M) -> None:
    """Check that numbers are finite and not beyond a magnitude."""
    for value in values:
        if not math.isfinite(value):
            raise BadMessage(RANGE, f"{name} that are no numbers")
        if abs(value) > largest:
            raise BadMessage(RANGE, f"{name} beyond {largest:g}")


def check_start(start_ns: int, now_ns: int, early_ns: int = 10_000_000_000, late_ns: int = 60_000_000_000) -> None:
    """Check that a transmission that starts then can be under way: clocks are off, but not by more than these limits.

    Times are ns on the channel's time line.
    """
    if not now_ns - late_ns <= start_ns <= now_ns + early_ns:
        raise BadMessage(SLOT, f"a transmission that starts {(start_ns - now_ns) / 1e9:.3g} s from now")


def check_process(message: Process, agents: int) -> None:
    """Check what a process says about itself, in a swarm of N agents."""
    check_ids(message.agent, agents)
    if len(message.dropped_reason) != len(message.dropped) or len(message.dropped) > _MOST_REASONS:
        raise BadMessage(SIZES, f"{len(message.dropped)} counts for {len(message.dropped_reason)} reasons")
    if len(message.settings) > _LONGEST_TEXT or any(len(reason) > 64 for reason in message.dropped_reason):
        raise BadMessage(SIZES, f"{len(message.settings)} characters of settings")


def check_odometry(message: Odometry) -> None:
    """Check that a vehicle of a swarm can have the position, attitude and velocity of a message."""
    place, q, speed = message.pose.pose.position, message.pose.pose.orientation, message.twist.twist.linear
    check_numbers("places", (place.x, place.y, place.z), FARTHEST_ODOMETRY_M)
    check_numbers("velocities", (speed.x, speed.y, speed.z), FASTEST_ODOMETRY_MPS)
    check_numbers("attitudes", (q.x, q.y, q.z, q.w))
    if not 0.9 < math.hypot(q.x, q.y, q.z, q.w) < 1.1:
        raise BadMessage(RANGE, "attitudes that are no unit quaternions")


def parse_json(data: bytes | str) -> Any:
    """Return what a text of JSON holds; ValueError: it is another text, or too deep."""
    try:
        return json.loads(data)
    except RecursionError:
        raise ValueError("a text that is nested too deeply") from None


def plain(text: str) -> str:
    """Return a text from outside as it can stand in one line."""
    return "".join(letter if letter.isprintable() else "?" for letter in text[:_LONGEST_NAME])
