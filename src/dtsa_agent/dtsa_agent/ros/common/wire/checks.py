"""Checks of what comes in over the graph: one function a message type, used by all who take that type in.

A check raises :class:`Unusable` with one of the reasons below; nothing else about the message may be believed then.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterable, Sequence
from typing import Any

from dtsa_msgs.msg import Process, Slot
from nav_msgs.msg import Odometry

from dtsa_agent.core.errors import RemoteProtocolError
from dtsa_agent.core.swarm import FRAME_MAX
from dtsa_agent.ros.common.graph import names

UNREADABLE = "unreadable"  # not a message of its topic's type
OTHER_RUN = "other run"
OTHER_SENDER = "other sender"  # not of the publisher, or the process, that has sent so far
UNKNOWN = "unknown agent"
SIZES = "sizes"  # arrays that do not fit together
RANGE = "range"  # numbers that cannot be
SLOT = "slot"  # of a slot that cannot be under way
FORGED_END = "forged end"
REASONS = (UNREADABLE, OTHER_RUN, OTHER_SENDER, UNKNOWN, SIZES, RANGE, SLOT, FORGED_END)

LARGEST_SLOT = names.FIRST_CALL - 1  # 248 days of 10 ms slots
FARTHEST_M = 1e6  # no vehicle is farther from the room's centre, or faster, than this many m or m/s
FARTHEST_ODOMETRY_M, FASTEST_ODOMETRY_MPS = 1000.0, 100.0  # of vehicles that really fly
_WINDOW = 1000  # messages of one publisher that may have been missed
_SILENT_S = 0.3  # after such a silence the numbers may begin elsewhere
_LONGEST_TEXT = 65536
_LONGEST_NAME = 200
_MOST_REASONS = 64


class Unusable(RemoteProtocolError):
    """A message that is not taken in.

    :param reason: one of :data:`REASONS`.
    :param detail: what is wrong with it.
    """

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(detail)
        self.reason = reason


def check_slot(message: Slot, agents: int) -> None:
    """A slot message whose fields fit together.

    :param message: the message.
    :param agents: number of agents N.
    :raises Unusable: if they do not.
    """
    phase, senders, lengths, received = message.phase, message.sender, message.length, message.received
    count = len(senders)
    if phase > Slot.REFUSE:
        raise Unusable(RANGE, f"slot message of phase {phase}")
    if (message.slot > LARGEST_SLOT and phase != Slot.PREPARE) or message.heard_slot > LARGEST_SLOT:
        raise Unusable(SLOT, f"slot message for slot {message.slot}")
    if phase != Slot.RUN:
        if count or len(lengths) or len(received):
            raise Unusable(SIZES, f"slot message of phase {phase} with frames")
        return
    if count == 0:
        if len(lengths) or len(message.data) or len(received):
            raise Unusable(SIZES, "slot message with frames of nobody")
        return
    if len(lengths) != count or len(received) != count * ((agents + 7) // 8):
        raise Unusable(
            SIZES, f"slot message: {count} senders, {len(lengths)} lengths, {len(received)} bytes of receivers"
        )
    check_frames(lengths, message.data)
    if not all(lengths):
        raise Unusable(SIZES, "slot message with an empty frame")
    check_ids(senders, agents, ascending=False)


def check_frames(lengths: Sequence[int], data: Any) -> None:
    """Frames that are as long as the air carries, and as the bytes that are there.

    :param lengths: bytes, one a frame.
    :param data: the frames one after the other.
    :raises Unusable: if they are not.
    """
    if sum(lengths) != len(data):
        raise Unusable(SIZES, f"{len(data)} bytes of frames, {sum(lengths)} in their lengths")
    if len(lengths) and max(lengths) > FRAME_MAX:
        raise Unusable(SIZES, f"a frame of {max(lengths)} bytes; the air carries {FRAME_MAX}")


def check_ids(ids: Sequence[int], agents: int, ascending: bool = True) -> None:
    """Different ids of agents that exist.

    :param ids: the ids.
    :param agents: number of agents N.
    :param ascending: whether they have to be in order.
    :raises Unusable: if they are not, or there are none.
    """
    count = len(ids)
    if not count or count > agents or min(ids) < 1 or max(ids) > agents:
        raise Unusable(UNKNOWN, f"a message for agents {list(ids[:8])}; allowed: 1 to {agents}")
    if count > 1 and (len(set(ids)) != count or (ascending and any(a >= b for a, b in itertools.pairwise(ids)))):
        raise Unusable(UNKNOWN, f"a message for agents {list(ids[:8])}, twice or out of order")


def check_numbers(name: str, values: Iterable[float], largest: float = FARTHEST_M) -> None:
    """Finite numbers of a size that can be.

    :param name: what they are.
    :param values: numbers of any unit.
    :param largest: largest magnitude, of the same unit.
    :raises Unusable: if there are others.
    """
    for value in values:
        if not math.isfinite(value):
            raise Unusable(RANGE, f"{name} that are no numbers")
        if abs(value) > largest:
            raise Unusable(RANGE, f"{name} beyond {largest:g}")


def check_start(start_ns: int, now_ns: int, early_ns: int = 10_000_000_000, late_ns: int = 60_000_000_000) -> None:
    """The start of a transmission that can be under way: clocks are off, but not by that much.

    :param start_ns: ns, time of the start on the channel's time line.
    :param now_ns: ns, now on that time line.
    :param early_ns: ns by which it may lie ahead.
    :param late_ns: ns by which it may have passed.
    :raises Unusable: if it lies elsewhere.
    """
    if not now_ns - late_ns <= start_ns <= now_ns + early_ns:
        raise Unusable(SLOT, f"a transmission that starts {(start_ns - now_ns) / 1e9:.3g} s from now")


def check_process(message: Process, agents: int) -> None:
    """A message of a process that can be.

    :param message: the message.
    :param agents: number of agents N.
    :raises Unusable: if it cannot.
    """
    check_ids(message.agent, agents)
    if len(message.dropped_reason) != len(message.dropped) or len(message.dropped) > _MOST_REASONS:
        raise Unusable(SIZES, f"{len(message.dropped)} counts for {len(message.dropped_reason)} reasons")
    if len(message.settings) > _LONGEST_TEXT or any(len(reason) > 64 for reason in message.dropped_reason):
        raise Unusable(SIZES, f"{len(message.settings)} characters of settings")


def check_odometry(message: Odometry) -> None:
    """A measured place, attitude and velocity that a vehicle of a swarm can have.

    :param message: the message.
    :raises Unusable: for others.
    """
    place, q, speed = message.pose.pose.position, message.pose.pose.orientation, message.twist.twist.linear
    check_numbers("places", (place.x, place.y, place.z), FARTHEST_ODOMETRY_M)
    check_numbers("velocities", (speed.x, speed.y, speed.z), FASTEST_ODOMETRY_MPS)
    check_numbers("attitudes", (q.x, q.y, q.z, q.w))
    if not 0.9 < math.hypot(q.x, q.y, q.z, q.w) < 1.1:
        raise Unusable(RANGE, "attitudes that are no unit quaternions")


def parse_json(data: bytes | str) -> Any:
    """What a text of JSON holds.

    :raises ValueError: for any other text, one too deep included.
    """
    try:
        return json.loads(data)
    except RecursionError:
        raise ValueError("a text that is nested too deeply") from None


def plain(text: str) -> str:
    """A text from outside as it can stand in one line."""
    return "".join(letter if letter.isprintable() else "?" for letter in text[:_LONGEST_NAME])


class OnePublisher:
    """Tells the messages of one publisher from others', by who sent them.

    Where a middleware does not say that, by their numbers, which each publisher counts for itself: another publisher's
    lie elsewhere unless both have sent about as much. After a silence any number is taken, and any sender where none
    was given: nobody can take the place of the right one for long. Without senders and numbers this is off.

    :param sender: the only one whose messages are ever taken; None: whoever is heard first.
    """

    __slots__ = ("_last", "_only", "_sender", "_time_s")

    def __init__(self, sender: bytes | None = None) -> None:
        self._only = self._sender = sender
        self._last, self._time_s = 0, 0.0

    def admits(self, number: int | None, now_s: float, sender: bytes | None = None) -> bool:
        """Whether a message can be the next of the same publisher; it is taken for that then.

        :param number: the message's number; 0 or None: not known.
        :param now_s: s, monotonic.
        :param sender: who sent it; None: not known.
        """
        if sender is not None:
            if sender != self._sender and (self._only is not None or now_s - self._time_s < _SILENT_S):
                return False
            self._sender, self._time_s = sender, now_s
            return True
        if not number:
            return True
        if not 0 < number - self._last <= _WINDOW and now_s - self._time_s < _SILENT_S:
            return False
        self._last, self._time_s = number, now_s
        return True
