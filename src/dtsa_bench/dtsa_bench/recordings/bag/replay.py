"""Plays a bag: publishes the recorded bytes with the recorded QoS, in time, together with `/clock`.

A thread reads ahead, no more than `AHEAD` messages, so that neither the length of the bag nor the opening
of a chunk matters to the timing. The player itself knows no ROS; `RosOutput` does.
"""

from __future__ import annotations

import gc
import queue
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Protocol

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.ros.common.wire.cdr import REPRESENTATION, SECOND

from . import qos, schema
from .cdr import STAMP, CdrBuilder
from .errors import BagError
from .reader import Bag, Message, Topic

AHEAD = 64  # batches in memory
BATCH = 256  # messages
SPIN_NS = 150_000  # ns, the last part of each wait is waited out awake: sleeping is not exact enough
CLOCK_NS = 10_000_000  # ns of wall time, longest time without a /clock message
POLL_NS = 20_000_000  # ns of wall time between two looks at the keyboard


class Output(Protocol):
    """Where a player's messages go."""

    def publish(self, message: Message) -> None:
        """One recorded message, now."""

    def clock(self, time_ns: int) -> None:
        """The simulated time, now."""


@dataclass(slots=True)
class Progress:
    """How far a player is."""

    time_ns: int = 0  # ns, simulated time now
    messages: int = 0
    rounds: int = 0  # of a loop, that are complete
    paused: bool = False
    late_max_ns: int = 0  # ns of wall time, the most that a message came after its time
    late_sum_ns: int = 0

    @property
    def late_mean_ns(self) -> float:
        """Mean of what the messages were late, ns."""
        return self.late_sum_ns / max(1, self.messages)


class Player:
    """Plays one bag to one output.

    :param bag: open bag; used by this player alone while it plays.
    :param output: takes the messages.
    :param rate: simulated seconds in one second of wall time, above 0.
    :param start_s: s from the bag's start, where to begin.
    :param loop: begin again at the end.
    :param topics: names; None: all.
    :raises ConfigError: if the rate or the start is out of range.
    :raises UnusableBag: if a topic is not in the bag.
    """

    def __init__(
        self,
        bag: Bag,
        output: Output,
        rate: float = 1.0,
        start_s: float = 0.0,
        loop: bool = False,
        topics: Collection[str] | None = None,
    ) -> None:
        if not 0 < rate <= 1000:
            raise ConfigError("rate", rate, "above 0, at most 1000")
        duration = (bag.end_ns - bag.start_ns) / 1e9
        if not 0 <= start_s <= duration:
            raise ConfigError("start", start_s, f"0 to {duration:.3f} s, the length of the bag")
        for name in topics or ():
            bag.topic(name)
        self._bag, self._output, self._topics = bag, output, topics
        self._rate, self._loop = rate, loop
        self._from_ns = bag.start_ns + round(start_s * 1e9)
        self._stop = False
        self.progress = Progress(self._from_ns)
        self._wall_ns = 0  # wall time at which ...
        self._sim_ns = 0  # ... this simulated time is due
        self._next_clock_ns = 0
        self._next_poll_ns = 0
        self._clock_sent = -1

    def stop(self) -> None:
        """End `play` soon; may be called from signal handlers and other threads."""
        self._stop = True

    @property
    def stopped(self) -> bool:
        """Whether `stop` was called."""
        return self._stop

    def toggle_pause(self) -> None:
        """Pause or go on. For the `poll` function of `play`."""
        self.progress.paused = not self.progress.paused

    def play(self, poll: Callable[[Player], None] | None = None) -> Progress:
        """Play to the end; blocks.

        :param poll: called some fifty times a second: may pause, stop or show the progress.
        """
        while not self._stop:
            self._wall_ns, self._sim_ns = 0, self._from_ns
            for message in self._read_ahead():
                if not self._wall_ns:  # time starts when there is something to play
                    self._wall_ns = time.monotonic_ns()
                self._wait(message.log_time_ns, poll)
                if self._stop:
                    break
                self._send(message)
            if not self._loop:
                break
            if not self._stop:
                self.progress.rounds += 1
        return self.progress

    def _send(self, message: Message) -> None:
        due = self._wall_ns + (message.log_time_ns - self._sim_ns) / self._rate
        if message.log_time_ns != self._clock_sent:
            self._send_clock(message.log_time_ns)
        self._output.publish(message)
        late = max(0, int(time.monotonic_ns() - due))
        progress = self.progress
        progress.messages += 1
        progress.late_sum_ns += late
        progress.late_max_ns = max(progress.late_max_ns, late)

    def _send_clock(self, time_ns: int) -> None:
        self._output.clock(time_ns)
        self._clock_sent = self.progress.time_ns = time_ns
        self._next_clock_ns = time.monotonic_ns() + CLOCK_NS

    def _wait(self, time_ns: int, poll: Callable[[Player], None] | None) -> None:
        """Wait until a simulated time is due; keeps /clock going and looks at the keyboard meanwhile."""
        while not self._stop:
            now = time.monotonic_ns()
            if poll is not None and now >= self._next_poll_ns:
                self._next_poll_ns = now + POLL_NS
                poll(self)
                if self.progress.paused:
                    self._pause(poll)
                    continue
            due = self._wall_ns + int((time_ns - self._sim_ns) / self._rate)
            left = due - now
            if left <= 0:
                return
            if left > SPIN_NS:
                until = min(due - SPIN_NS, max(self._next_clock_ns, now + SPIN_NS), now + POLL_NS)
                time.sleep((until - now) / 1e9)
                now = time.monotonic_ns()
                if now >= self._next_clock_ns and due - now > SPIN_NS:
                    self._send_clock(self._sim_ns + int((now - self._wall_ns) * self._rate))

    def _pause(self, poll: Callable[[Player], None]) -> None:
        began = time.monotonic_ns()
        while self.progress.paused and not self._stop:
            self._output.clock(self.progress.time_ns)  # time stands still, but who joins now learns it
            time.sleep(POLL_NS / 1e9)
            poll(self)
        self._wall_ns += time.monotonic_ns() - began

    def _read_ahead(self) -> Iterator[Message]:
        """Messages from the bag, read by a thread."""
        batches: queue.Queue[list[Message] | BaseException | None] = queue.Queue(AHEAD)
        end = threading.Event()

        def put(item: list[Message] | BaseException | None) -> bool:
            while not end.is_set():
                with suppress(queue.Full):
                    batches.put(item, timeout=0.1)
                    return True
            return False

        def read() -> None:
            try:
                batch: list[Message] = []
                for message in self._bag.messages(self._topics, self._from_ns):
                    batch.append(message)
                    if len(batch) >= BATCH:
                        if not put(batch):
                            return
                        batch = []
                put(batch)
                put(None)
            except BaseException as error:  # handed to the thread that plays
                put(error)

        thread = threading.Thread(target=read, name="read-ahead", daemon=True)
        thread.start()
        try:
            while (item := batches.get()) is not None:
                if isinstance(item, BaseException):
                    raise item
                yield from item
        finally:
            end.set()
            thread.join()


@contextmanager
def steady_timing() -> Iterator[None]:
    """Keep the interpreter from holding the player up: short turns of threads, no garbage collection."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-4)
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        sys.setswitchinterval(interval)
        gc.enable()


class RosOutput:
    """Publishes on the ROS graph with the recorded QoS.

    :param node: rclpy node that owns the publishers.
    :param topics: the topics to play.
    :raises BagError: if a message type is not installed, or is another than the recorded one.
    """

    def __init__(self, node: Any, topics: Collection[Topic]) -> None:
        from rosgraph_msgs.msg import Clock

        self._publishers: dict[str, Callable[[bytes], None]] = {}
        self._all: list[Any] = []
        for topic in topics:
            installed = schema.installed(topic.type)
            if topic.type_hash and topic.type_hash != installed.type_hash:
                raise BagError(
                    f"{topic.name}: the bag's {topic.type} differs from the installed one "
                    f"({topic.type_hash} / {installed.type_hash}); leave it out with --topics"
                )
            package, _, name = topic.type.split("/")
            kind = getattr(import_module(f"{package}.msg"), name)
            publisher = node.create_publisher(kind, topic.name, ros_profile(topic.profiles))
            self._all.append(publisher)
            self._publishers[topic.name] = publisher.publish
        self._clock = node.create_publisher(Clock, "/clock", ros_profile([qos.NAMED["best_effort"]]))
        self._time = CdrBuilder()  # a Clock is a stamp, and bytes are published faster than a message
        self._time.number("i", 0)
        self._time.number("I", 0)

    def subscribers(self) -> int:
        """Subscriptions to the recorded topics that have been found so far."""
        return sum(publisher.get_subscription_count() for publisher in self._all)

    def publish(self, message: Message) -> None:
        """Publish the recorded bytes as they are."""
        self._publishers[message.topic](message.data)

    def clock(self, time_ns: int) -> None:
        """Publish `/clock`."""
        STAMP.pack_into(self._time.data, 0, *divmod(time_ns, SECOND))
        self._clock.publish(REPRESENTATION + bytes(self._time.data))


def ros_profile(profiles: Collection[qos.Profile]) -> Any:
    """rclpy's QoSProfile for recorded profiles: what every one of them offers.

    :param profiles: as recorded; none: the default profile.
    """
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    reliable = all(entry.get("reliability") != "best_effort" for entry in profiles)
    latched = bool(profiles) and all(entry.get("durability") == "transient_local" for entry in profiles)
    depth = max((int(entry.get("depth", 10)) for entry in profiles), default=10)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=max(1, depth),
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
