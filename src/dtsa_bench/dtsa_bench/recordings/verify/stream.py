"""The messages of a bag, one topic at a time, in one pass over the file."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from dtsa_agent.ros.common.wire.packing import RUN_MESSAGES
from dtsa_bench.recordings.bag.reader import Bag, Message
from dtsa_bench.recordings.bag.writer import KEY, BagDigest

from .result import Difference, Mismatch, Result


class Streams:
    """Queues of messages by topic, filled from the bag as far as needed."""

    def __init__(self, bag: Bag, wanted: Callable[[str], bool]) -> None:
        self._messages = bag.messages()
        self._queues: dict[str, deque[Message]] = {name: deque() for name in bag.topics if wanted(name)}
        self._digest = BagDigest()
        self._recorded = bag.custom_data.get(KEY)
        self._names = {name: name.encode() for name in bag.topics}
        self._runs = {name for name, info in bag.topics.items() if info.type in RUN_MESSAGES}
        self._ended = False

    def _pull(self) -> bool:
        """Reads one more message; False at the end of the bag."""
        message = next(self._messages, None)
        if message is None:
            self._ended = True
            return False
        self._digest.add(
            self._names[message.topic],
            message.log_time_ns,
            message.publish_time_ns,
            message.sequence,
            message.data,
            message.topic in self._runs,
        )
        queue = self._queues.get(message.topic)
        if queue is not None:
            queue.append(message)
        return True

    def take(self, topic: str) -> Message | None:
        """The next message of a topic; None if there is no more."""
        queue = self._queues.get(topic)
        if queue is None:
            return None
        while not queue:
            if self._ended or not self._pull():
                return None
        return queue.popleft()

    def at_hand(self, topic: str, until_ns: int) -> list[Message]:
        """Messages of a topic that have been read already, up to a time."""
        queue, found = self._queues.get(topic, deque()), []
        while queue and queue[0].log_time_ns <= until_ns:
            found.append(queue.popleft())
        return found

    def first(self, topic: str, time_ns: int) -> list[Message]:
        """All messages of a topic at one time, left in their queue."""
        while not self._ended and self._pull():
            queue = self._queues.get(topic)
            if queue and queue[-1].log_time_ns > time_ns:
                break
        return [m for m in self._queues.get(topic, ()) if m.log_time_ns <= time_ns]

    def rest(self) -> Message | None:
        """Some message that nobody has taken, None if there is none."""
        while not self._ended and self._pull():
            pass
        return min((q[0] for q in self._queues.values() if q), key=lambda m: m.log_time_ns, default=None)

    def check_digest(self, result: Result) -> None:
        """Compares the digest of all messages with the one that the recorder wrote when it closed the bag.

        :raises Mismatch: if they differ.
        """
        while not self._ended and self._pull():
            pass
        if self._recorded is None:
            result.skipped["digest of all messages"] = "the bag holds none: it was not closed by its recorder"
            return
        found = self._digest.hexdigest()
        if found != self._recorded:
            raise Mismatch(
                Difference(
                    "digest of all messages",
                    self._recorded,
                    found,
                    "a message was changed, left out, added or moved after the recording",
                )
            )
        result.count("digest of all messages")
