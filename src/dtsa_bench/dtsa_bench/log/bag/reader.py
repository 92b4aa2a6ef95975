"""Reads bags back, without ROS: messages in order of time, decoded by the definitions in the bag itself.

A bag may be several files, or files that are compressed as a whole, or hold messages that are compressed one by one:
all that rosbag2 writes to MCAP, as long as it has an index.
"""

from __future__ import annotations

import heapq
import json
import struct
import zlib
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import IO, Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, DataEnd, Schema
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from mcap.summary import Summary
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from dtsa_bench.runs.program import program

from . import metadata
from .errors import BagError, UnusableBag
from .schema import Definition

MAGIC = b"\x89MCAP0\r\n"  # the first bytes of a file, and the last
PREFIX = struct.Struct("<BQ")  # opcode and length of every record
_END = struct.Struct("<QQI8s")  # end of a file: where its index begins, and its second part; checksum; magic
_ROS = "cdr/ros2msg"
NOT_OF_ITS_TYPE = (SerdeError, AssertionError, IndexError, KeyError, ValueError, struct.error)  # of rosbags


class BagMessage(NamedTuple):
    """One recorded message."""

    topic: str
    type: str  # "package/msg/Type"
    log_time_ns: int  # ns, simulated time of reception
    publish_time_ns: int  # ns, simulated time of transmission
    sequence: int  # number of the message on its topic, from 0
    data: bytes  # CDR, exactly as recorded


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a bag."""

    name: str
    type: str  # "package/msg/Type"
    count: int  # messages
    profiles: tuple[metadata.Profile, ...]  # offered QoS
    type_hash: str  # "RIHS01_...", or empty
    definition: str  # message definition with all that it needs
    encoding: str  # of messages and definition; "cdr/ros2msg" alone can be decoded


class Bag:
    """A recorded run, open for reading. A context manager.

    :param path: a bag directory, the directory of a run with one in it, or a .mcap file alone.
    :raises UnusableBag: if it is none, or is damaged; the text says what would help.
    """

    def __init__(self, path: str | Path) -> None:
        self.given = Path(path)
        self._paths = metadata.find_files(self.given)
        self.path = self._paths[0]
        self.topics: dict[str, Topic] = {}
        self._readers: list[SeekingReader] = []  # a file each
        self.message_count = self.start_ns = self.end_ns = 0
        records = [metadata.read_beside(self.path, self.given)]
        with ExitStack() as stack:
            for part in self._paths:
                reader = self._add_file(part, stack.enter_context(metadata.open_file(part)))
                with suppress(Exception):  # of a damaged record: whatever the library meets, there is none then
                    for record in reader.iter_metadata():
                        if record.name == metadata.RECORD_NAME:
                            records.insert(0, metadata.load_record(record))
            if self.topics and all(topic.encoding != _ROS for topic in self.topics.values()):
                topic = next(iter(self.topics.values()))
                why = f"topic {topic.name} is recorded as {topic.encoding}, not as {_ROS}: not a ROS 2 bag"
                raise UnusableBag(self.given, why)
            self._files = stack.pop_all()
        self._has_packed_messages = any(map(metadata.has_packed_messages, records))
        # Of the types that were decoded.
        kinds = frozenset((topic.type, topic.definition, topic.encoding) for topic in self.topics.values())
        self.typestore = shared_typestore(kinds)
        #: The recorder's own texts; empty in a foreign bag.
        self.custom_data = next(filter(None, map(metadata.custom_data, records)), {})

    def _add_file(self, path: Path, stream: IO[bytes]) -> SeekingReader:
        """Add what the index of a file says."""
        if stream.read(len(MAGIC)) != MAGIC:
            raise UnusableBag(self.given, f"{path.name} is not an MCAP file")
        try:
            stream.seek(-len(MAGIC), 2)
            if stream.read() != MAGIC:
                raise McapError("no end mark")
            reader, summary = read_index(stream)
            reader.get_header()
            if summary is None or summary.statistics is None:
                raise McapError("it has no index")
            statistics = summary.statistics
            if statistics.message_count and not summary.chunk_indexes:
                raise McapError("its messages are not in indexed chunks")
            counts = {number: count for number, count in statistics.channel_message_counts.items() if count}
            _complete_channels(summary, counts, stream)
        except Exception as error:  # the libraries meet damaged files with many kinds of errors
            raise self._damaged(f"it was not closed, or is damaged ({error or type(error).__name__})") from None
        for number, channel in sorted(summary.channels.items()):
            self._add_topic(channel, summary.schemas.get(channel.schema_id), counts.get(number, 0))
        if statistics.message_count:
            start_ns = statistics.message_start_time
            self.start_ns = min(self.start_ns, start_ns) if self.message_count else start_ns
            self.end_ns = max(self.end_ns, statistics.message_end_time)
        self.message_count += statistics.message_count
        self._readers.append(reader)
        return reader

    def _add_topic(self, channel: Channel, schema: Schema | None, count: int) -> None:
        definition, before = definition_of(channel, schema), self.topics.get(channel.topic)
        profiles = metadata.load_profiles(channel.metadata.get("offered_qos_profiles", ""))
        self.topics[channel.topic] = Topic(
            channel.topic, definition.name, count + (before.count if before else 0),
            profiles or (before.profiles if before else ()), definition.type_hash, definition.text,
            f"{definition.message_encoding}/{definition.encoding or 'no schema'}",
        )  # fmt: skip

    def _damaged(self, what: str) -> UnusableBag:
        return UnusableBag(self.given, f"{what}; `{program()} recover {self.given}` saves what can be read")

    @cached_property
    def config(self) -> dict[str, Any]:
        """Configuration of the run, as given to the recorder.

        :raises UnusableBag: if the bag holds none.
        """
        try:
            loaded = json.loads(self.custom_data["configuration"])
        except (KeyError, ValueError):
            raise UnusableBag(self.given, "it holds no configuration: not recorded by this project") from None
        if not isinstance(loaded, dict):
            raise UnusableBag(self.given, "its configuration is not a map")
        return loaded

    def messages(
        self, topics: Collection[str] | None = None, start_ns: int = 0, end_ns: int = (1 << 63) - 1
    ) -> Iterator[BagMessage]:
        """Messages in order of log time, those of equal time as recorded; about two chunks of a file are in memory.

        :param topics: names; None: all.
        :param start_ns: ns, earliest log time.
        :param end_ns: ns, latest log time.
        :raises UnusableBag: if a topic is not in the bag, or a chunk is damaged.
        """
        for name in topics or ():
            self.topic(name)
        wanted = None if topics is None else set(topics)
        parts = [self._messages(reader, wanted, start_ns, end_ns) for reader in self._readers]
        return heapq.merge(*parts, key=lambda message: message.log_time_ns) if len(parts) > 1 else parts[0]

    def _messages(
        self, reader: SeekingReader, wanted: set[str] | None, start_ns: int, end_ns: int
    ) -> Iterator[BagMessage]:
        unpack = metadata.unpack_message if self._has_packed_messages else bytes
        try:
            for schema, channel, message in reader.iter_messages(wanted, starting_at=start_ns, ending_at=end_ns):
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

    def register(self, topic: Topic) -> None:
        """Make the type of a topic's messages known.

        :raises UnusableBag: if its definition cannot be used.
        """
        try:
            if topic.encoding != _ROS:
                raise ValueError(f"it is recorded as {topic.encoding}, not as {_ROS}")
            register_type(self.typestore, topic.type, topic.definition)
        except ValueError as error:
            raise UnusableBag(self.given, f"topic {topic.name}, {topic.type}: {error}") from None

    def decode(self, message: BagMessage) -> Any:
        """The message as an object with its fields as attributes; arrays of numbers are NumPy arrays.

        :raises UnusableBag: if its definition cannot be used.
        :raises BagError: if the bytes do not fit the type.
        """
        if message.type not in self.typestore.fielddefs:
            self.register(self.topic(message.topic))
        try:
            return self.typestore.deserialize_cdr(message.data, message.type)
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
        for path in self._paths:
            if fault := checksum_fault(path):
                raise self._damaged(f"{path.name}: {fault}")

    def close(self) -> None:
        """Close the files."""
        self._files.close()

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *unused: object) -> None:
        self.close()


def _complete_channels(summary: Summary, counts: Mapping[int, int], stream: IO[bytes]) -> None:
    """Complete a summary that repeats no channels or schemas by those that stand before the messages."""
    for index in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset):
        channels = [summary.channels.get(number) for number in counts]
        if all(channel and channel.schema_id in (0, *summary.schemas) for channel in channels):
            return
        stream.seek(index.chunk_start_offset + PREFIX.size)
        for record in breakup_chunk(Chunk.read(ReadDataStream(stream)), validate_crc=True):
            if isinstance(record, Schema):
                summary.schemas.setdefault(record.id, record)
            elif isinstance(record, Channel):
                summary.channels.setdefault(record.id, record)
    if not counts.keys() <= summary.channels.keys():
        raise McapError("the channels of some messages are not defined")


@lru_cache(maxsize=16)
def shared_typestore(definitions: frozenset[tuple[str, ...]]) -> Typestore:
    """The types of bags with these definitions and encodings, empty at first: compiling them takes longer than reading.

    Bags that differ in any of them share nothing: what is wrong with one says nothing of another.
    """
    return get_typestore(Stores.EMPTY)


def register_type(store: Typestore, kind: str, definition: str) -> None:
    """Make a type of messages known, by the definition of it and of all that it needs; not again if it is.

    :raises ValueError: if the definition cannot be used.
    """
    if kind in store.fielddefs:
        return
    try:
        types = get_types_from_msg(definition, kind)
        store.register({name: fields for name, fields in types.items() if name not in store.fielddefs})
        if kind not in store.fielddefs:
            raise ValueError("it is not of the form package/msg/Type")
    except Exception as error:  # the parser meets texts from outside with many kinds of errors
        raise ValueError(f"its definition cannot be used: {error}".partition("\n")[0]) from None


def checksum_fault(path: Path) -> str:
    """What the checksums of a finished file say against it; empty: nothing. A change of any of its bytes shows."""
    try:
        with metadata.open_file(path) as stream:
            read_index(stream)
            stream.seek(-_END.size, 2)
            index_start, *_ = _END.unpack(stream.read())
            stream.seek(0)
            records = StreamReader(stream, emit_chunks=True, validate_crcs=True).records
            if not any(isinstance(record, DataEnd) for record in records) or stream.tell() != index_start:
                return "the end of its messages is damaged"
    except CRCValidationError:
        return "its contents do not fit their checksum"
    except Exception as error:  # the library meets damaged files with many kinds of errors
        return f"it is damaged ({error or type(error).__name__})"
    return ""


def read_index(stream: IO[bytes]) -> tuple[SeekingReader, Summary | None]:
    """A reader and the index at the end of a file, None if it has none; raises errors of any kind for a damaged one."""
    stream.seek(-_END.size, 2)
    start, _, checksum, _ = _END.unpack(stream.read())
    stream.seek(start)
    if start and checksum and zlib.crc32(stream.read()[:-12]) != checksum:  # it covers all that stands before it
        raise McapError("its index does not fit its checksum")
    stream.seek(0)
    reader = SeekingReader(stream, validate_crcs=True)
    return reader, reader.get_summary()


def definition_of(channel: Channel, schema: Schema | None) -> Definition:
    """What a file says of the type of a channel's messages."""
    type_hash, encoding = channel.metadata.get("topic_type_hash", ""), channel.message_encoding
    if schema is None:
        return Definition("", "", type_hash, "", encoding)
    return Definition(schema.name, schema.data.decode("utf-8", "surrogateescape"), type_hash, schema.encoding, encoding)
