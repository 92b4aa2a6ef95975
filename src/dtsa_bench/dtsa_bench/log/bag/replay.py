"""Plays a bag: publishes the recorded bytes with the recorded QoS, in time, together with `/clock`.

The player itself knows no ROS; `RosOutput` does.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.ros.common.cdr import SECOND
from dtsa_agent.ros.common.names import message_class

from . import schema
from .errors import BagError
from .metadata import PROFILES, Profile
from .reader import Bag, BagMessage
from .schema import Topic

CLOCK = "/clock"
CLOCK_NS = 10_000_000  # ns of wall time, longest time without a /clock message
POLL_NS = 20_000_000  # ns of wall time between two calls of `poll`
MAX_DEPTH = 1000  # messages that a publisher keeps for late subscribers at most


class Player:
    """Plays one bag to one output.

    :param output: takes the messages and the time: a `RosOutput`, or what has its `publish` and `clock`.
    :param rate: simulated seconds in one second of wall time, above 0.
    :param start_s: s from the bag's start, where to begin.
    :param loop: begin again at the end.
    :param topics: names; None: all.
    :raises ConfigError: if the rate or the start is out of range.
    :raises UnusableBag: if a topic is not in the bag.
    """

    def __init__(
        self, bag: Bag, output: Any, rate: float = 1.0, start_s: float = 0.0, loop: bool = False,
        topics: Collection[str] | None = None,
    ) -> None:  # fmt: skip
        duration = (bag.end_ns - bag.start_ns) / 1e9
        if not 0 < rate <= 1000:
            raise ConfigError("rate", rate, "above 0, at most 1000")
        if not 0 <= start_s <= duration:
            raise ConfigError("start", start_s, f"0 to {duration:.3f} s, the length of the bag")
        for name in topics or ():
            bag.topic(name)
        self._bag, self._output, self._topics, self._rate, self._loop = bag, output, topics, rate, loop
        self._from_ns = bag.start_ns + round(start_s * 1e9)
        self.time_ns = self._from_ns  # simulated time that was published last
        self.message_count = self.round_count = 0
        self.paused = self.stopped = False  # `poll` and signal handlers set them
        self._begin_ns = self._next_clock_ns = self._next_poll_ns = 0  # wall time

    def play(self, poll: Callable[[Player], None] | None = None) -> None:
        """Play to the end; `poll` is called some fifty times a second: may pause, stop or show the progress."""
        while not self.stopped:
            self._begin_ns = self._next_clock_ns = 0
            for message in self._bag.messages(self._topics, self._from_ns):
                if not self._begin_ns:  # time starts when there is something to play
                    self._begin_ns = time.monotonic_ns()
                self._wait(message.log_time_ns, poll)
                if self.stopped:
                    return
                if message.log_time_ns != self.time_ns or not self._next_clock_ns:
                    self._publish_clock(message.log_time_ns)
                self._output.publish(message)
                self.message_count += 1
            if not self._loop:
                return
            self.round_count += 1

    def _publish_clock(self, time_ns: int) -> None:
        self._output.clock(time_ns)
        self.time_ns, self._next_clock_ns = time_ns, time.monotonic_ns() + CLOCK_NS

    def _wait(self, time_ns: int, poll: Callable[[Player], None] | None) -> None:
        """Wait until a simulated time is due; `/clock` and `poll` go on meanwhile."""
        while not self.stopped:
            now = time.monotonic_ns()
            if poll is not None and now >= self._next_poll_ns:
                self._next_poll_ns = now + POLL_NS
                poll(self)
            if self.paused:
                self._output.clock(self.time_ns)  # time stands still, but a new subscriber learns it
                time.sleep(POLL_NS / 1e9)
                self._begin_ns += time.monotonic_ns() - now
                continue
            left_ns = self._begin_ns + int((time_ns - self._from_ns) / self._rate) - now
            if left_ns <= 0:
                return
            if now >= self._next_clock_ns:
                self._publish_clock(time_ns - int(left_ns * self._rate))
            time.sleep(min(left_ns, CLOCK_NS) / 1e9)


class RosOutput:
    """Publishes on the ROS graph with the recorded QoS. A recorded `/clock` replaces the player's.

    :param node: rclpy node that owns the publishers.
    :param topics: the topics to play; those whose type is not installed are left out.
    :param warn: called with a line for each of them.
    :raises ConfigError: if ROS 2 forbids the name of a topic.
    :raises BagError: if a message type is another than the recorded one, or no topic can be played.
    """

    def __init__(self, node: Any, topics: Collection[Topic], warn: Callable[[str], None]) -> None:
        from rclpy.exceptions import NameValidationException
        from rosgraph_msgs.msg import Clock

        self._publishers: dict[str, Any] = {}
        for topic in topics:
            try:
                if topic.definition.message_encoding != "cdr":
                    raise BagError(f"recorded as {topic.definition.encodings}, not as cdr")
                installed = schema.installed(topic.type)
                message_type = message_class(topic.type)
            except (BagError, ConfigError) as error:
                warn(f"{topic.name} is left out: {error}")
                continue
            recorded_hash = topic.definition.type_hash
            if recorded_hash not in ("", installed.type_hash):
                hashes = f"({recorded_hash} / {installed.type_hash}); leave it out with --topics"
                raise BagError(f"{topic.name}: the bag's {topic.type} differs from the installed one {hashes}")
            try:
                profile = ros_profile(topic.profiles, topic.count)
                self._publishers[topic.name] = node.create_publisher(message_type, topic.name, profile)
            except NameValidationException:
                allowed = "a name of ROS 2: letters, digits, _ and / alone; leave it out with --topics"
                raise ConfigError("topic", topic.name, allowed) from None
        if not self._publishers:
            raise BagError("none of the topics can be played")
        self._time, best_effort = Clock(), ros_profile([PROFILES["best_effort"]])
        self._clock = None if CLOCK in self._publishers else node.create_publisher(Clock, CLOCK, best_effort)

    @property
    def topics(self) -> list[str]:
        """Names of the topics that can be played."""
        return list(self._publishers)

    def subscribers(self) -> int:
        """Subscriptions to the recorded topics that have been found so far."""
        return sum(publisher.get_subscription_count() for publisher in self._publishers.values())

    def publish(self, message: BagMessage) -> None:
        """Publish the recorded bytes as they are."""
        self._publishers[message.topic].publish(message.data)

    def clock(self, time_ns: int) -> None:
        """Publish `/clock`, unless it is recorded."""
        if self._clock is not None:
            self._time.clock.sec, self._time.clock.nanosec = divmod(time_ns, SECOND)
            self._clock.publish(self._time)


def ros_profile(profiles: Collection[Profile], count: int = 0) -> Any:
    """rclpy's QoSProfile of one publisher in place of those that were recorded.

    It is reliable if all of them were, and keeps messages for late subscribers if one of them did: as many as they did
    together, or all `count` of the topic where the recording does not know how many that were, as the middleware does
    not tell a recorder.
    """
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    reliable = all(entry.get("reliability") != "best_effort" for entry in profiles)
    latched = [entry for entry in profiles if entry.get("durability") == "transient_local"]
    depths = [
        depth if entry.get("history") == "keep_last" and isinstance(depth := entry.get("depth"), int) else 0
        for entry in latched or profiles
    ]
    depth = max(depths, default=0) or 10
    if latched:
        depth = sum(depths) if min(depths) > 0 else count
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=min(max(1, depth), MAX_DEPTH),
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
