"""Headers and times of messages, from integer nanoseconds."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from std_msgs.msg import Header

from dtsa_agent.ros.common.graph import names

from .cdr import SECOND


def time_of(time_ns: int) -> Time:
    """A message's time.

    :param time_ns: ns.
    """
    seconds, nanoseconds = divmod(time_ns, SECOND)
    return Time(sec=seconds, nanosec=nanoseconds)


def header_of(time_ns: int) -> Header:
    """A message's header in frame ``map``.

    :param time_ns: ns.
    """
    return Header(stamp=time_of(time_ns), frame_id=names.FRAME)


def ns_of(time: Time) -> int:
    """A message's time, ns."""
    return int(time.sec) * SECOND + int(time.nanosec)
