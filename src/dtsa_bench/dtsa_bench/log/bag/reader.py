"""Reads bags back, without ROS: messages in order of time, decoded by the definitions in the bag itself.

A bag may be several files, or files that are compressed as a whole, or hold messages that are compressed one by one:
all that rosbag2 writes to MCAP, as long as it has an index.
"""

from __future__ import annotations

import heapq
import struct
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

from dtsa_bench.runs.program import program

from . import metadata
from .errors import BagError, UnusableBag
from .file import BagFile
from .schema import READABLE, Topic, typestore_of

NOT_OF_ITS_TYPE = (SerdeError, AssertionError, IndexError, KeyError, ValueError, struct.error)  # of rosbags


class BagMessage(NamedTuple):
    """One recorded message."""

    topic: str
    type: str  # "package/msg/Type"
    log_time_ns: int  # ns, simulated time of reception
    publish_time_ns: int  # ns, simulated time of transmission
    sequence: int  # number of the message on its topic, from 0
    data: bytes  # CDR, exactly as recorded


class Bag:
    """A recorded run, open for reading. A context manager.

    :param path: a bag directory, the directory of a run with one in it, or a .mcap file alone.
    :raises UnusableBag: if it is none, or is damaged; the text says what would help.
    """

    def __init__(self, path: str | Path) -> None:
        self.given = Path(path)
        paths = metadata.find_files(self.given)
        self.path = paths[0]
        self.topics: dict[str, Topic] = {}
        about = metadata.read_beside(self.path, self.given)
        with ExitStack() as stack:
            self._files = [BagFile(part, self.given, stack) for part in paths]
            for file in self._files:
                self._add_file(file)
                about |= file.about
            if self.topics and all(topic.definition.encodings != READABLE for topic in self.topics.values()):
                topic = next(iter(self.topics.values()))
                why = f"recorded as {topic.definition.encodings}, not as {READABLE}: not a ROS 2 bag"
                raise UnusableBag(self.given, f"topic {topic.name} is {why}")
            self._stack = stack.pop_all()
        statistics = [one for file in self._files if (one := file.summary.statistics) and one.message_count]
        self.start_ns = min((one.message_start_time for one in statistics), default=0)
        self.end_ns = max((one.message_end_time for one in statistics), default=0)
        self._has_packed_messages = metadata.has_packed_messages(about)
        self._typestores: dict[str, Typestore] = {}  # by topic
        #: The recorder's own texts; empty in a foreign bag.
        self.custom_data = metadata.custom_data(about)

    def _add_file(self, file: BagFile) -> None:
        """Add what the index of a file says."""
        if file.index_fault:
            raise self._damaged(f"it was not closed, or is damaged ({file.index_fault})")
        summary = file.summary
        for _, channel in sorted(summary.channels.items()):
            topic = Topic.of_channel(channel, summary.schemas.get(channel.schema_id))
            if before := self.topics.get(topic.name):
                topic.profiles, topic.count = topic.profiles or before.profiles, before.count
            self.topics[topic.name] = topic
        for topic in self.topics.values():
            topic.count += file.counts[topic.name]

    def _damaged(self, what: str) -> UnusableBag:
        return UnusableBag(self.given, f"{what}; `{program()} recover {self.given}` saves what can be read")

    @cached_property
    def config(self) -> dict[str, Any]:
        """Configuration of the run, as given to the recorder.

        :raises UnusableBag: if the bag holds none.
        """
        try:
            loaded = metadata.load_json(self.custom_data["configuration"])
        except (KeyError, ValueError):
            raise UnusableBag(self.given, "it holds no configuration: not recorded by this project") from None
        if not isinstance(loaded, dict):
            raise UnusableBag(self.given, "its configuration is not a map")
        return loaded

    def messages(self, topics: Collection[str] | None = None, start_ns: int = 0) -> Iterator[BagMessage]:
        """Messages in order of log time, those of equal time as recorded; about two chunks of a file are in memory.

        :param topics: names; None: all.
        :param start_ns: ns, earliest log time.
        :raises UnusableBag: if a topic is not in the bag, or a chunk is damaged.
        """
        for name in topics or ():
            self.topic(name)
        parts = [self._messages(file, topics, start_ns) for file in self._files]
        return heapq.merge(*parts, key=lambda message: message.log_time_ns) if len(parts) > 1 else parts[0]

    def _messages(self, file: BagFile, topics: Collection[str] | None, start_ns: int) -> Iterator[BagMessage]:
        unpack = metadata.unpack if self._has_packed_messages else bytes
        try:
            for schema, channel, message in file.messages(topics, start_ns):
                kind, data = schema.name if schema else "", unpack(message.data)
                yield BagMessage(channel.topic, kind, message.log_time, message.publish_time, message.sequence, data)
        except Exception as error:  # the libraries meet damage with many kinds of errors
            raise self._damaged(f"damaged chunk: {error or type(error).__name__}") from None

    def topic(self, name: str) -> Topic:
        """One topic by name.

        :raises UnusableBag: if the bag has no such topic.
        """
        if name not in self.topics:
            names = ", ".join(sorted(self.topics)) or "none"
            raise UnusableBag(self.given, f"it has no topic {name!r}; it has {names}")
        return self.topics[name]

    def typestore(self, name: str) -> Typestore:
        """The type of a topic's messages, and all that it needs.

        :raises UnusableBag: if the bag has no such topic, or its definition cannot be used.
        """
        if name not in self._typestores:
            topic = self.topic(name)
            try:
                self._typestores[name] = typestore_of(topic.definition)
            except ValueError as error:
                raise UnusableBag(self.given, f"topic {name}, {topic.type}: {error}") from None
        return self._typestores[name]

    def decode(self, message: BagMessage) -> Any:
        """The message as an object with its fields as attributes; arrays of numbers are NumPy arrays.

        :raises UnusableBag: if its definition cannot be used.
        :raises BagError: if the bytes do not fit the type.
        """
        store = self.typestore(message.topic)
        try:
            return store.deserialize_cdr(message.data, message.type)
        except NOT_OF_ITS_TYPE as error:
            what = f"{message.topic} at {message.log_time_ns} ns"
            raise BagError(f"{what}: not a valid {message.type} ({error})") from None

    def typed(self, topics: Collection[str] | None = None) -> Iterator[tuple[BagMessage, Any]]:
        """Messages in order of log time, each with what it decodes to."""
        for message in self.messages(topics):
            yield message, self.decode(message)

    def check_files(self) -> None:
        """Whether the files are as they were finished, by their checksums; it takes a pass over them.

        :raises UnusableBag: if one is not.
        """
        for file in self._files:
            if fault := file.checksum_fault():
                raise self._damaged(f"{file.path.name}: {fault}")

    def close(self) -> None:
        """Close the files."""
        self._stack.close()

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *unused: object) -> None:
        self.close()
