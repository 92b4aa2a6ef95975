"""Reads bags back, without ROS: messages in order of time, decoded by the definitions in the bag itself."""

from __future__ import annotations

import json
import struct
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Chunk, ChunkIndex
from mcap.stream_reader import get_chunk_data_stream
from mcap.summary import Summary
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError
from rosbags.typesys.store import Typestore

from dtsa_bench.runs.program import program

from . import columns, metadata
from .errors import BagError, UnusableBag
from .place import find_file

PACKED_MESSAGES = "its messages are compressed one by one; `ros2 bag convert` makes a plain bag of it"
MERGED = "one agent's, recorded on a network: `{} merge` with --out makes one bag of those of all agents"
_ON_A_NETWORK = "dtsa."  # names of schemas of such bags begin with it
MAGIC = b"\x89MCAP0\r\n"  # the first bytes of a file, and the last
PREFIX = struct.Struct("<BQ")  # opcode and length of every record
_MESSAGE = struct.Struct("<BQHIQQ")  # a message record up to its data


class _Entry(NamedTuple):
    """One message inside a chunk."""

    log_time_ns: int
    chunk: int  # offset of the chunk in the file: with `start`, the order in which messages were written
    start: int  # offset of the data in the uncompressed chunk
    end: int
    channel: int
    sequence: int
    publish_time_ns: int
    buffer: bytes  # the uncompressed chunk


class Message(NamedTuple):
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


class Bag:
    """A recorded run, open for reading. A context manager.

    :param path: a bag directory, the directory of a run with one in it, or a .mcap file alone.
    :raises UnusableBag: if it is none, or is damaged; the text says what would help.
    """

    def __init__(self, path: str | Path) -> None:
        self.given = Path(path)
        self.path = find_file(self.given)
        try:
            self._stream = self.path.open("rb")
        except OSError as error:
            raise UnusableBag(path, f"cannot be read: {error.strerror or error}") from None
        try:
            self._open()
        except BaseException:
            self._stream.close()
            raise

    def _open(self) -> None:
        if self._stream.read(len(MAGIC)) != MAGIC:
            raise UnusableBag(self.given, f"{self.path.name} is not an MCAP file")
        self._stream.seek(0)
        try:
            self._reader = SeekingReader(self._stream)
            self.header = self._reader.get_header()
            self._stream.seek(-len(MAGIC), 2)
            if self._stream.read() != MAGIC:
                raise McapError("no end mark")
            summary = self._reader.get_summary()
        except Exception as error:  # the library meets damaged files with many kinds of errors
            raise self._damaged(f"it was not closed, or is damaged ({error or type(error).__name__})") from None
        if summary is None or summary.statistics is None:
            raise self._damaged("it has no index")
        if summary.statistics.message_count and not summary.chunk_indexes:
            raise self._damaged("its messages are not in indexed chunks")
        self._read_topics(summary)
        record = self._read_record()
        if metadata.has_packed_messages(record):
            raise UnusableBag(self.given, PACKED_MESSAGES)
        self.custom_data = metadata.custom_data(record)  # the recorder's own texts; empty in a foreign bag
        statistics = summary.statistics
        self.message_count: int = statistics.message_count
        self.start_ns: int = statistics.message_start_time
        self.end_ns: int = statistics.message_end_time
        self._chunks: list[ChunkIndex] = sorted(
            summary.chunk_indexes, key=lambda index: (index.message_start_time, index.chunk_start_offset)
        )

    def _damaged(self, what: str) -> UnusableBag:
        return UnusableBag(self.given, f"{what}; `{program()} recover {self.given}` saves what can be read")

    def _read_topics(self, summary: Summary) -> None:
        counts = summary.statistics.channel_message_counts if summary.statistics else {}
        self.topics: dict[str, Topic] = {}
        self._channels: dict[int, tuple[str, str]] = {}
        for identifier, channel in sorted(summary.channels.items()):
            schema = summary.schemas.get(channel.schema_id)
            if channel.message_encoding != "cdr" or schema is None or schema.encoding != "ros2msg":
                if schema is not None and schema.name.startswith(_ON_A_NETWORK):
                    raise UnusableBag(self.given, MERGED.format(program()))
                encoding = f"{channel.message_encoding}/{schema.encoding if schema else 'no schema'}"
                raise UnusableBag(
                    self.given,
                    f"topic {channel.topic} is recorded as {encoding}, not as cdr/ros2msg: not a ROS 2 bag",
                )
            before = self.topics.get(channel.topic)
            self.topics[channel.topic] = Topic(
                channel.topic,
                schema.name,
                counts.get(identifier, 0) + (before.count if before else 0),
                tuple(metadata.load_profiles(channel.metadata.get("offered_qos_profiles", ""))),
                channel.metadata.get("topic_type_hash", ""),
                schema.data.decode("utf-8", "replace"),
            )
            self._channels[identifier] = (channel.topic, schema.name)

    def _read_record(self) -> dict[str, Any]:
        """What the recorder stored beside the messages; empty where there is nothing, or it is damaged."""
        found: dict[str, Any] = {}
        with suppress(McapError, struct.error, ValueError, KeyError, OSError, StopIteration, MemoryError):
            for record in self._reader.iter_metadata():
                if record.name == metadata.RECORD_NAME:
                    found = metadata.load(record.metadata.get(metadata.RECORD_KEY, ""))
        return found

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
    ) -> Iterator[Message]:
        """Messages in order of log time, those of equal time as recorded; about two chunks are in memory.

        :param topics: names; None: all.
        :param start_ns: ns, earliest log time.
        :param end_ns: ns, latest log time.
        :raises ConfigError: if a topic is not in the bag.
        :raises UnusableBag: if a chunk is damaged.
        """
        if topics is not None:
            for name in topics:
                self.topic(name)
        wanted = {
            identifier: names for identifier, names in self._channels.items() if topics is None or names[0] in topics
        }
        waiting: list[_Entry] = []
        for entry in self._entries(wanted, start_ns, end_ns, waiting):
            topic, kind = wanted[entry.channel]
            data = entry.buffer[entry.start : entry.end]
            yield Message(topic, kind, entry.log_time_ns, entry.publish_time_ns, entry.sequence, data)

    def _entries(self, wanted: Collection[int], start_ns: int, end_ns: int, waiting: list[_Entry]) -> Iterator[_Entry]:
        chunks = [
            index
            for index in self._chunks
            if index.message_end_time >= start_ns
            and index.message_start_time <= end_ns
            and (not index.message_index_offsets or any(c in wanted for c in index.message_index_offsets))
        ]
        for index in chunks:
            # What is earlier than all that follows can go out; chunks may overlap in time.
            ready = 0
            while ready < len(waiting) and waiting[ready].log_time_ns < index.message_start_time:
                ready += 1
            yield from waiting[:ready]
            del waiting[:ready]
            waiting += [
                entry
                for entry in _messages(self._chunk(index), index.chunk_start_offset)
                if entry.channel in wanted and start_ns <= entry.log_time_ns <= end_ns
            ]
            waiting.sort(key=lambda entry: entry[:3])
        yield from waiting

    def _chunk(self, index: ChunkIndex) -> bytes:
        """The uncompressed records of a chunk."""
        try:
            self._stream.seek(index.chunk_start_offset)
            record = self._stream.read(index.chunk_length)
            if len(record) != index.chunk_length or record[0] != Opcode.CHUNK:
                raise ValueError("it is not where the index says")
            chunk = Chunk.read(ReadDataStream(BytesIO(record[PREFIX.size :])))
            stream, length = get_chunk_data_stream(chunk, validate_crc=True)
            return stream.read(length)
        except Exception as error:  # the library meets damage with many kinds of errors
            raise self._damaged(f"damaged chunk at byte {index.chunk_start_offset}: {error}") from None

    def topic(self, name: str) -> Topic:
        """One topic by name.

        :raises UnusableBag: if the bag has no such topic.
        """
        if name not in self.topics:
            raise UnusableBag(
                self.given, f"it has no topic {name!r}; it has {', '.join(sorted(self.topics)) or 'none'}"
            )
        return self.topics[name]

    @cached_property
    def typestore(self) -> Typestore:
        """Decoder of all message types in this bag, made from the definitions in it."""
        store = get_typestore(Stores.EMPTY)
        for topic in self.topics.values():
            if topic.type in store.types:
                continue
            try:
                found = get_types_from_msg(topic.definition, topic.type)
                store.register({name: fields for name, fields in found.items() if name not in store.fielddefs})
            except (TypesysError, SyntaxError) as error:
                raise UnusableBag(self.given, f"the definition of {topic.type} cannot be used: {error}") from None
        return store

    def decode(self, message: Message) -> Any:
        """The message as an object with its fields as attributes; arrays of numbers are NumPy arrays.

        :raises BagError: if the bytes do not fit the type.
        """
        try:
            return self.typestore.deserialize_cdr(message.data, message.type)
        except (SerdeError, AssertionError, IndexError, KeyError) as error:
            raise BagError(
                f"{message.topic} at {message.log_time_ns} ns: not a valid {message.type} ({error})"
            ) from None

    def typed(self, topics: Collection[str] | None = None) -> Iterator[tuple[Message, Any]]:
        """Messages in order of log time, each with what it decodes to."""
        for message in self.messages(topics):
            yield message, self.decode(message)

    def columns(self, topic: str, fields: Collection[str] | None = None) -> dict[str, np.ndarray]:
        """All messages of one topic as arrays with one row a message.

        `log_time_ns` and `publish_time_ns` come first, then the fields by their dotted names. A number is
        (M,), an array that has the same length in all messages (M, k), an array of changing length an
        object array of arrays, a string an object array of str. Lists of nested messages are left out.

        :param topic: name of the topic.
        :param fields: names of fields to keep; None: all.
        :raises BagError: if a message does not fit its type.
        """
        return self.tables([topic], fields)[topic]

    def tables(
        self, topics: Collection[str] | None = None, fields: Collection[str] | None = None
    ) -> dict[str, dict[str, np.ndarray]]:
        """Columns of several topics, in one pass over the file.

        :param topics: names; None: all.
        :param fields: names of fields to keep, of whatever topic; None: all.
        """
        found = {
            name: columns.Table(self.typestore, self.topic(name).type, fields)
            for name in (self.topics if topics is None else topics)
        }
        for message in self.messages(list(found)):
            found[message.topic].add(message.log_time_ns, message.publish_time_ns, message.data)
        return {name: table.finish() for name, table in found.items()}

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def __enter__(self) -> Bag:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _messages(buffer: bytes, chunk: int = 0) -> Iterator[_Entry]:
    """All whole messages in uncompressed records, as they were written.

    :param chunk: bytes, offset of their chunk in the file.
    """
    position, size = 0, len(buffer)
    unpack, head, kind = _MESSAGE.unpack_from, _MESSAGE.size, int(Opcode.MESSAGE)
    least = head - PREFIX.size
    while position + PREFIX.size <= size:
        if buffer[position] == kind and position + head <= size:
            _, length, channel, sequence, log_ns, publish_ns = unpack(buffer, position)
            end = position + PREFIX.size + length
            if length < least or end > size:
                return
            yield _Entry(log_ns, chunk, position + head, end, channel, sequence, publish_ns, buffer)
        else:
            opcode, length = PREFIX.unpack_from(buffer, position)
            end = position + PREFIX.size + length
            if opcode in (0, kind) or end > size:
                return
        position = end
