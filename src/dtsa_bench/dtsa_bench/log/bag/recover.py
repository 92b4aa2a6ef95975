"""Makes a full bag of what a killed recorder, a full disk or a damaged file left behind.

Whole chunks are copied from the start of the file to the first place that cannot be read; what lies behind it is given
up, and named. Chunks of a flight end with complete slots, so what is saved is the flight up to the end of one. The
original is only read.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, Any

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk

from . import metadata
from .errors import UnusableBag
from .place import bag_of, find_file
from .reader import MAGIC, PACKED_MESSAGES, PREFIX
from .schema import Definition
from .writer import BROKEN_OFF, KEY, BagWriter

_KINDS: dict[int, Any] = {
    Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.CHUNK: Chunk, Opcode.METADATA: Metadata,
}  # fmt: skip
_INDEX = struct.Struct("<HI")  # of a message index: channel, bytes of the entries that follow


@dataclass(slots=True)
class Recovery:
    """What was found in a damaged bag, and what was saved of it."""

    source: Path
    directory: Path  # the new bag
    saved: dict[str, int] = field(default_factory=dict)  # messages by topic
    expected: dict[str, int] = field(default_factory=dict)  # by topic, where the old index still says it
    start_ns: int = 0
    end_ns: int = 0
    damaged: list[str] = field(default_factory=list)  # what is wrong, in words
    closed: bool = False  # whether the recorder finished the old file, and all of it could be read

    @property
    def count(self) -> int:
        """All messages that were saved."""
        return sum(self.saved.values())


class _WholeRecords:
    """The records of a file in their order, up to the first that is damaged; a chunk's stand in its place."""

    def __init__(self, stream: IO[bytes], size: int) -> None:
        self._stream, self._size = stream, size
        self.fault = ""  # where and why the file cannot be read any further; empty: it was read to the end of its data

    def __iter__(self) -> Iterator[Any]:
        position, chunked = len(MAGIC), False
        while True:
            self._stream.seek(position)
            try:
                prefix = self._stream.read(PREFIX.size)
                opcode, length = PREFIX.unpack(prefix)
                begin = position + PREFIX.size
                if length > self._size - begin:
                    raise ValueError("it is cut off")
                if opcode == Opcode.DATA_END and length == 4:
                    return
                if opcode == Opcode.MESSAGE and chunked:  # it has no checksum: as likely a damaged index
                    raise ValueError("a message outside of chunks")
                records = _parsed(opcode, self._stream.read(length))
            except Exception as error:  # the library meets damage with many kinds of errors
                lost = self._size - position
                self.fault = f"what stands at byte {position} cannot be read ({error}): {lost} bytes are left out"
                return
            yield from records
            position, chunked = begin + length, chunked or opcode == Opcode.CHUNK


def _parsed(opcode: int, content: bytes) -> list[Any]:
    """One record as the library's objects, a chunk as those in it; raises errors of any kind for a damaged one."""
    if opcode in (Opcode.HEADER, Opcode.ATTACHMENT):
        return []
    if opcode == Opcode.MESSAGE_INDEX and _INDEX.unpack_from(content)[1] == len(content) - _INDEX.size:
        return []
    stream = ReadDataStream(BytesIO(content))
    if opcode == Opcode.MESSAGE:
        return [Message.read(stream, len(content))]
    if opcode not in _KINDS:
        raise ValueError(f"opcode {opcode} is out of place")
    record = _KINDS[opcode].read(stream)
    return breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else [record]


def recover(path: str | Path, directory: str | Path | None = None) -> Recovery:
    """Saves all messages of a bag up to its first damaged place to a new one.

    :param path: the damaged bag: run directory, bag directory or .mcap file. It is only read.
    :param directory: where the new bag is made; None: beside the old one, with `_recovered` appended to
        its name.
    :raises ConfigError: if the new directory is in use, or nothing at all can be read.
    :raises BagError: if the new bag cannot be written.
    """
    source, whole = find_file(path), bag_of(path).resolve()
    beside = whole.with_name(f"{whole.name if whole.is_dir() else whole.stem}_recovered")
    result = Recovery(source, beside if directory is None else Path(directory))
    try:
        stream = source.open("rb")
    except OSError as error:
        raise UnusableBag(path, f"cannot be read: {error.strerror or error}") from None
    with stream:
        if stream.read(len(MAGIC)) != MAGIC:
            raise UnusableBag(path, f"{source.name} is not an MCAP file, or its beginning is lost")
        result.expected = _indexed_counts(stream)
        records = _WholeRecords(stream, source.stat().st_size)
        about = _about(records, path)
        result.closed = _copy(records, about, result)
    expected = sum(result.expected.values())
    if records.fault:
        result.damaged.append(records.fault)
    if not expected:
        result.damaged.append("the recorder did not close the file")
    elif expected > result.count:
        result.damaged.append(f"{expected - result.count} of the {expected} messages that the file had are lost")
    return result


def _indexed_counts(stream: IO[bytes]) -> dict[str, int]:
    """Messages by topic as the file's own index has them; empty if there is none."""
    counts: dict[str, int] = {}
    with suppress(Exception):  # of a damaged file: whatever the library meets, there is no index then
        stream.seek(0)
        summary = SeekingReader(stream).get_summary()
        if summary is not None and summary.statistics is not None:
            for identifier, channel in summary.channels.items():
                count = summary.statistics.channel_message_counts.get(identifier, 0)
                counts[channel.topic] = counts.get(channel.topic, 0) + count
    return counts


def _about(records: _WholeRecords, given: str | Path) -> dict[str, Any]:
    """What the recorder says of the bag before its first message.

    :raises UnusableBag: if there is no message that can be read.
    """
    about: dict[str, Any] = {}
    for record in records:
        if isinstance(record, Metadata) and record.name == metadata.RECORD_NAME:
            about = metadata.load(record.metadata.get(metadata.RECORD_KEY, ""))
            if metadata.has_packed_messages(about):
                raise UnusableBag(given, PACKED_MESSAGES)
        if isinstance(record, Message):
            return about
    raise UnusableBag(given, "no message in it can be read: there is nothing to save")


def _copy(records: _WholeRecords, about: dict[str, Any], result: Recovery) -> bool:
    """Writes the new bag; whether the old file was finished and could be read to its end."""
    custom_data = {**metadata.custom_data(about), metadata.RECOVERED_FROM: result.source.name}
    distro = str(about.get("ros_distro") or "jazzy")
    schemas: dict[int, Schema] = {}
    topics: dict[str, int] = {}
    targets: dict[int, int] = {}  # channels of the new bag by those of the old one
    unknown = 0
    with BagWriter(result.directory, None, custom_data=custom_data, ros_distro=distro, min_time_ns=0) as writer:
        for record in records:
            if isinstance(record, Message):
                if record.channel_id not in targets:
                    unknown += 1
                    continue
                target = targets[record.channel_id]
                writer.write(target, record.data, record.log_time, record.publish_time, record.sequence)
            elif isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel) and record.schema_id in schemas:
                if record.topic not in topics:
                    schema = schemas[record.schema_id]
                    text, type_hash = schema.data.decode("utf-8", "replace"), record.metadata.get("topic_type_hash", "")
                    profiles = metadata.load_profiles(record.metadata.get("offered_qos_profiles", ""))
                    definition = Definition(schema.name, text, type_hash)
                    topics[record.topic] = writer.add_topic(record.topic, schema.name, profiles, definition)
                targets[record.id] = topics[record.topic]
            elif isinstance(record, Metadata) and record.name == metadata.RECORD_NAME:
                last = metadata.custom_data(metadata.load(record.metadata.get(metadata.RECORD_KEY, "")))
                if KEY in last:  # the new bag gets a digest of its own
                    writer.custom_data[f"recovered_{KEY}"] = last[KEY]
        result.saved = writer.counts
        result.start_ns, result.end_ns = writer.time_range_ns
        whole = not records.fault and bool(result.expected)
        if not whole:
            writer.custom_data[BROKEN_OFF] = str(result.end_ns)
    if unknown:
        result.damaged.append(f"{unknown} messages belong to topics that are not defined")
    return whole
