"""Makes a full bag of what a killed recorder, a full disk or a damaged file left behind.

Whole records are copied from the start of the file. Where one cannot be read, copying goes on with the next chunk that
can, and what lies between is named. Chunks of a flight end with complete slots, so what is saved up to the first
damaged place is the flight up to the end of one. Messages stay as they are encoded; the original is only read.
"""

from __future__ import annotations

import mmap
import re
import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Header, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.summary import Summary
from zstandard import ZstdError

from . import metadata
from .errors import NothingWritten, UnusableBag
from .reader import MAGIC, PREFIX, definition_of, read_index
from .schema import Definition
from .writer import BROKEN_OFF, KEY, BagWriter

_KINDS: dict[int, Any] = {
    Opcode.HEADER: Header, Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.CHUNK: Chunk,
    Opcode.METADATA: Metadata,
}  # fmt: skip
MOST_TRIED = 64  # times the size of a file: bytes of what looks like chunks that are tried
_INDEX = struct.Struct("<HI")  # of a message index: channel, bytes of the entries that follow
# A chunk up to its compressed records: length, below 2^40; times, size, checksum; compression; length of the records.
_CHUNK = re.compile(rb"\x06(.{5}\0{3}).{28}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd)(.{8})", re.DOTALL)


@dataclass(slots=True)
class Recovery:
    """What was found in a damaged bag, and what was saved of it."""

    source: Path  # its first file
    directory: Path  # the new bag
    saved: dict[str, int] = field(default_factory=dict)  # messages by topic
    expected: dict[str, int] = field(default_factory=dict)  # by topic, where the old index still says it
    start_ns: int = 0
    end_ns: int = 0
    whole_ns: int = 0  # log time up to which nothing is missing
    damaged: list[str] = field(default_factory=list)  # what is wrong, in words
    closed: bool = False  # whether the recorder finished the old file, and all of it could be read
    has_end: bool = False  # whether the recorder finished the old file: what is damaged in it was damaged later

    @property
    def count(self) -> int:
        """All messages that were saved."""
        return sum(self.saved.values())


def recover(path: str | Path, directory: str | Path | None = None) -> Recovery:
    """Save all messages of a damaged bag that can be read to a new one.

    :param path: the damaged bag: run directory, bag directory or .mcap file. It is only read.
    :param directory: where the new bag is made; None: beside the old one, with `_recovered` appended to its name.
    :raises ConfigError: if the new directory is in use, or nothing at all can be read.
    :raises BagError: if the new bag cannot be written.
    """
    paths, bag = metadata.find_files(path), metadata.bag_of(path).resolve()
    beside = bag.with_name(f"{bag.name if bag.is_dir() else bag.name.partition('.mcap')[0]}_recovered")
    result = Recovery(paths[0], beside if directory is None else Path(directory))
    with ExitStack() as stack:
        files = [RecordScan(part, path, stack) for part in paths]
        profile, about = _begin(files, path)
        custom_data = {**metadata.custom_data(about), metadata.RECOVERED_FROM: result.source.name}
        with BagWriter(result.directory, None, custom_data=custom_data, min_time_ns=0, profile=profile) as writer:
            copy = _Copy(writer, metadata.has_packed_messages(about))
            for file in files:
                copy.add(file)
            result.saved, result.expected = writer.counts, dict(copy.expected)
            result.start_ns, result.end_ns = writer.time_range_ns
            result.whole_ns = min(result.end_ns, *(file.whole_ns for file in files))
            expected = sum(result.expected.values())
            result.has_end = all(file.is_closed for file in files)
            result.closed = 0 < expected <= result.count and all(file.counts for file in files)
            if not result.closed:
                writer.custom_data[BROKEN_OFF] = str(result.whole_ns)
    for file in files:
        result.damaged += file.faults
        if not file.counts:
            result.damaged.append(f"{file.path.name} was not closed, or its index is damaged")
    result.damaged += [f"{count} {what}" for what, count in copy.lost.items()]
    if expected > result.count:
        result.damaged.append(f"{expected - result.count} of the {expected} messages that the bag had are lost")
    return result


def _begin(files: list[RecordScan], given: str | Path) -> tuple[str, dict[str, Any]]:
    """MCAP's profile, and what the recorder says of the bag before its first message.

    :raises UnusableBag: if there is no message that can be read; NothingWritten: and there was none yet.
    """
    profile, about = "", metadata.read_beside(files[0].path, given)
    for file in files:
        about, channels = about | file.about, set(file.summary.channels)
        for record in file.records():
            if isinstance(record, Header):
                profile = record.profile
            elif isinstance(record, Metadata) and record.name == metadata.RECORD_NAME:
                about |= metadata.load_record(record)
            elif isinstance(record, Channel):
                channels.add(record.id)
            elif isinstance(record, Message) and record.channel_id in channels:
                return profile, about
    is_begun = metadata.custom_data(about) and not any(file.is_closed for file in files)
    raise (NothingWritten if is_begun else UnusableBag)(given, "no message in it can be read: there is nothing to save")


class RecordScan:
    """The records of one file of a bag, finished and whole or not; open as long as the stack."""

    def __init__(self, path: Path, given: str | Path, stack: ExitStack) -> None:
        self.path = path
        self.faults: list[str] = []  # where and why it cannot be read
        self.whole_ns = 1 << 63  # log time of the last message before the first of them
        self.summary = Summary()  # as the file's own index has it; empty if there is none
        self.counts: dict[int, int] = {}  # messages by channel, likewise
        self.about: dict[str, Any] = {}  # what the recorder says of the bag, likewise
        self.is_closed = False  # whether the file has an end
        self._tried = 0  # bytes of what looked like chunks
        stream = stack.enter_context(metadata.open_file(path))
        if stream.read(len(MAGIC)) != MAGIC:
            raise UnusableBag(given, f"{path.name} is not an MCAP file, or its beginning is lost")
        self._data = stack.enter_context(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))
        self.is_closed = self._data[-len(MAGIC) :] == MAGIC and len(self._data) > len(MAGIC)
        with suppress(Exception):  # of a damaged file: whatever the library meets, there is no index then
            reader, summary = read_index(stream)
            self.summary = summary or self.summary
            self.counts = self.summary.statistics.channel_message_counts if self.summary.statistics else {}
            for record in reader.iter_metadata():
                if record.name == metadata.RECORD_NAME:
                    self.about = metadata.load_record(record)

    def records(self) -> Iterator[Any]:
        """The records that can be read, in their order; a chunk's stand in its place."""
        self.faults, self.whole_ns = [], 1 << 63
        position, size, last_ns = len(MAGIC), len(self._data), 0
        chunked = self._next_chunk(position) < size
        while position < size:
            try:
                begin = position + PREFIX.size
                opcode, length = PREFIX.unpack(self._data[position:begin].ljust(PREFIX.size, b"\xff"))
                if length > size - begin:
                    raise ValueError("it is cut off")
                if opcode == Opcode.DATA_END and length == 4:
                    return
                if opcode == Opcode.MESSAGE and chunked:  # it has no checksum: as likely a damaged index
                    raise ValueError("a message outside of chunks")
                records = _parsed(opcode, self._data[begin : begin + length])
            except Exception as error:  # the library meets damage with many kinds of errors
                goes_on = self._next_chunk(position + 1)
                time = f", after {last_ns / 1e9:.3f} s," if last_ns else ""
                self.faults.append(f"bytes {position} to {goes_on}{time} cannot be read ({error}) and are left out")
                self.whole_ns, position = min(self.whole_ns, last_ns), goes_on
                continue
            yield from records
            last_ns = max((record.log_time for record in records if isinstance(record, Message)), default=last_ns)
            position = begin + length

    def _next_chunk(self, position: int) -> int:
        """Where the next whole chunk begins; the end of the file if there is none."""
        while match := _CHUNK.search(self._data, position):
            position, end = match.start(), match.start() + PREFIX.size + int.from_bytes(match[1], "little")
            if match.end() + int.from_bytes(match[2], "little") == end <= len(self._data):
                self._tried += end - position
                if self._tried > MOST_TRIED * len(self._data):  # made so: chance has no such chunks within chunks
                    break
                with suppress(Exception):  # whatever the library meets: then it is none
                    _parsed(Opcode.CHUNK, self._data[position + PREFIX.size : end])
                    return position
            position += 1
        return len(self._data)


def _parsed(opcode: int, content: bytes) -> list[Any]:
    """One record as the library's objects, a chunk as those in it; raises errors of any kind for a damaged one."""
    if opcode == Opcode.ATTACHMENT or (
        opcode == Opcode.MESSAGE_INDEX and _INDEX.unpack_from(content)[1] == len(content) - _INDEX.size
    ):
        return []
    stream = ReadDataStream(BytesIO(content))
    if opcode == Opcode.MESSAGE:
        return [Message.read(stream, len(content))]
    if opcode not in _KINDS:
        raise ValueError(f"opcode {opcode} is out of place")
    record = _KINDS[opcode].read(stream)
    if stream.count != len(content):
        raise ValueError("its length is wrong")
    return breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else [record]


class _Copy:
    """What is copied to a new bag; `packed`: messages are compressed one by one, and are unpacked."""

    def __init__(self, writer: BagWriter, packed: bool) -> None:
        self._writer, self._unpack = writer, metadata.unpack_message if packed else bytes
        self._topics: dict[str, tuple[int, Definition]] = {}  # channel of the new bag, what it is
        self.lost: Counter[str] = Counter()  # by why it is lost
        self.expected: Counter[str] = Counter()  # messages by topic, as the files' own indexes say

    def add(self, file: RecordScan) -> None:
        """Copy what can be read of one file."""
        schemas, channels = dict(file.summary.schemas), dict(file.summary.channels)
        targets: dict[int, int] = {}  # channels of the new bag by those of the file; 0: none
        for record in file.records():
            if isinstance(record, Message):
                number = record.channel_id
                if number not in targets:  # its channel stands where the file is damaged
                    targets[number] = self._channel(channels.get(number), schemas)
                try:
                    data = self._unpack(record.data)
                except (ZstdError, MemoryError):
                    self.lost["messages cannot be unpacked"] += 1
                    continue
                if targets[number]:
                    self._writer.write(targets[number], data, record.log_time, record.publish_time, record.sequence)
                else:
                    self.lost["messages belong to topics that are not defined"] += 1
            elif isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
                targets[record.id] = self._channel(record, schemas)
            elif isinstance(record, Metadata):
                if record.name != metadata.RECORD_NAME:
                    self._writer.add_metadata(record.name, record.metadata)
                elif KEY in (last := metadata.custom_data(metadata.load_record(record))):
                    self._writer.custom_data[f"recovered_{KEY}"] = last[KEY]  # the new bag gets one of its own
        for number, count in file.counts.items():
            self.expected[channels[number].topic if number in channels else "?"] += count

    def _channel(self, channel: Channel | None, schemas: Mapping[int, Schema]) -> int:
        """The new bag's channel for one of the file; 0: it is not defined, or its topic has another type already."""
        if channel is None or (channel.schema_id and channel.schema_id not in schemas):
            return 0
        definition = definition_of(channel, schemas.get(channel.schema_id))
        if channel.topic not in self._topics:
            profiles = metadata.load_profiles(channel.metadata.get("offered_qos_profiles", ""))
            number = self._writer.add_topic(channel.topic, definition.name, profiles, definition)
            self._topics[channel.topic] = number, definition
        number, first = self._topics[channel.topic]
        kind = (definition.name, definition.encoding, definition.message_encoding)
        return number if kind == (first.name, first.encoding, first.message_encoding) else 0
