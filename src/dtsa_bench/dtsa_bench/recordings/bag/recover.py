"""Makes a full bag of what a killed recorder, a full disk or a damaged disk left.

The file is read record by record, without its index. Chunks that are whole are kept if their checksum
fits. A chunk that was cut off is left out where the recorder closed chunks after complete steps of the run only:
what is saved is a run up to such a step. From other bags all messages of it that are whole are kept. Where the
records make no sense, the next chunk is searched for. The original is only read.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Metadata, Schema

from . import container, metadata, qos
from .digest import KEY
from .errors import UnusableBag
from .place import bag_of, find_file
from .reader import PACKED_MESSAGES
from .schema import Definition
from .writer import BROKEN_OFF, COMPLETE, MARKED, BagWriter

_LAST_OPCODE = container.DATA_END
_INDEX = struct.Struct("<HI")
_SIGNATURES = (b"\x04\x00\x00\x00zstd", b"\x03\x00\x00\x00lz4")  # stand 37 bytes after a chunk's opcode
_SIGNATURE_PLACE = 37


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
    closed: bool = False  # whether the old file was finished

    @property
    def count(self) -> int:
        """All messages that were saved."""
        return sum(self.saved.values())


class _Salvage:
    """Reads what can be read of one file."""

    def __init__(self, data: mmap.mmap | bytes, keep_damaged: bool) -> None:
        self._data, self._size = data, len(data)
        self._keep_damaged = keep_damaged
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.custom_data: dict[str, str] = {}
        self.ros_distro = ""
        self.packed = False  # each message is compressed by itself
        self.expected: dict[int, int] = {}
        self.chunk_offsets: list[int] = []
        self.closed = False
        self.notes: list[str] = []
        self._checked: set[tuple[int, int]] = set()  # schemas and channels from chunks whose checksum fits
        self._read_summary()

    def _read_summary(self) -> None:
        with suppress(Exception):  # of a damaged file: whatever the library meets, there is no summary then
            summary = SeekingReader(BytesIO(self._data[:])).get_summary() if self._size < 1 << 28 else None
            if summary is not None and summary.statistics is not None:
                self.schemas.update(summary.schemas)
                self.channels.update(summary.channels)
                self.expected = dict(summary.statistics.channel_message_counts)
                self.chunk_offsets = sorted(index.chunk_start_offset for index in summary.chunk_indexes)
                self.closed = True

    def entries(self) -> Iterator[container.Entry]:
        """All readable messages in the order of the file; collects schemas, channels and notes on the way."""
        self.notes.clear()
        chunked = bool(self.chunk_offsets)
        position = len(container.MAGIC)
        if self._data[:position] != container.MAGIC:
            self.notes.append("the start mark is missing")
            position = self._next_chunk(0)
        while position < self._size - len(container.MAGIC):
            end = self._end(position)
            if end is None:
                yield from self._cut_off(position)
                found = self._next_chunk(position + 1)
                if found < self._size or self.closed:  # else it is the end that is missing
                    self.notes.append(f"{found - position} bytes at {position} make no sense")
                position = found
                continue
            opcode = self._data[position]
            if opcode == container.CHUNK:
                chunked = True
                yield from self._chunk(position, end)
            elif opcode == container.MESSAGE:
                if not chunked or self._keep_damaged:
                    yield from container.messages(self._data[position:end], position)
                else:  # it has no checksum: as likely an index whose first byte has changed
                    self.notes.append(
                        f"{end - position} bytes at {position} look like a message between chunks; left out"
                    )
            elif opcode <= container.CHANNEL or opcode == container.METADATA:
                self._define(opcode, self._data[position + container.PREFIX.size : end])
            position = end

    def _end(self, position: int) -> int | None:
        """End of the record at a position; None if there is no whole and sensible record."""
        if position + container.PREFIX.size > self._size:
            return None
        opcode, length = container.PREFIX.unpack_from(self._data, position)
        start = position + container.PREFIX.size
        end = start + length
        if not 1 <= opcode <= _LAST_OPCODE or end > self._size:
            return None
        if opcode == container.CHUNK:
            try:
                head = container.chunk_head(self._data[position : position + 80])
            except ValueError:
                return None
            if position + head.offset + head.length != end:
                return None
        if opcode == container.MESSAGE_INDEX and (
            length < _INDEX.size or _INDEX.unpack_from(self._data, start)[1] != length - _INDEX.size
        ):
            return None
        return int(end)

    def _cut_off(self, position: int) -> Iterator[container.Entry]:
        """Messages of a chunk or of a record that ends with the file."""
        if self._data[position] != container.CHUNK:
            return
        try:
            head = container.chunk_head(self._data[position : position + 80])
        except ValueError:
            return
        if position + head.offset + head.length <= self._size:
            return  # its own length is damaged, not its end missing
        part = container.decompress_part(head, self._data[position + head.offset :])
        entries = self._open(part[: head.size], position)
        if self.custom_data.get(MARKED) == COMPLETE and not self._keep_damaged:
            self.notes.append(f"the last chunk is cut off; {len(entries)} messages of an unfinished step are left out")
            return
        self.notes.append(f"the last chunk is cut off; {len(entries)} messages of it are whole")
        yield from entries

    def _chunk(self, position: int, end: int) -> Iterator[container.Entry]:
        head = container.chunk_head(self._data[position : position + 80])
        data = self._data[position + head.offset : end]
        try:
            yield from self._open(container.decompress(head, data), position, checked=True)
        except ValueError:
            entries = self._open(container.decompress_part(head, data), position)
            what = "kept unchecked" if self._keep_damaged else "left out"
            self.notes.append(
                f"the chunk at byte {position} is damaged; {len(entries)} messages that can be read in it are {what}"
            )
            if self._keep_damaged:
                yield from entries

    def _open(self, records: bytes, position: int, checked: bool = False) -> list[container.Entry]:
        """Messages of uncompressed records; takes schemas and channels that stand among them."""
        if records:
            for opcode, start, end in container.records(records):
                if opcode in (container.SCHEMA, container.CHANNEL):
                    self._define(opcode, records[start:end], checked)
        return list(container.messages(records, position))

    def _define(self, opcode: int, content: bytes, checked: bool = False) -> None:
        stream = ReadDataStream(BytesIO(content))
        with suppress(McapError, struct.error, UnicodeDecodeError, MemoryError):
            if opcode == container.METADATA:
                record = Metadata.read(stream)
                if record.name == metadata.RECORD_NAME:
                    found = metadata.load(record.metadata.get(metadata.RECORD_KEY, ""))
                    self.custom_data = metadata.custom_data(found) or self.custom_data
                    self.ros_distro = str(found.get("ros_distro", self.ros_distro))
                    self.packed |= metadata.has_packed_messages(found)
            elif opcode in (container.SCHEMA, container.CHANNEL):
                kind: Any = Schema if opcode == container.SCHEMA else Channel
                known: dict[int, Any] = self.schemas if opcode == container.SCHEMA else self.channels
                entry = kind.read(stream)
                if checked:
                    self._checked.add((opcode, entry.id))
                if checked or (opcode, entry.id) not in self._checked:
                    known[entry.id] = entry

    def _next_chunk(self, position: int) -> int:
        """Offset of the next thing that looks like a whole chunk; the size of the file if there is none."""
        known = [offset for offset in self.chunk_offsets if offset >= position]
        best = known[0] if known else self._size
        for signature in _SIGNATURES:
            place = position + _SIGNATURE_PLACE
            while 0 <= (place := self._data.find(signature, place)) < best + _SIGNATURE_PLACE:
                start = place - _SIGNATURE_PLACE
                if self._data[start] == container.CHUNK and self._plausible(start):
                    best = start
                    break
                place += 1
        return best

    def _plausible(self, start: int) -> bool:
        try:
            head = container.chunk_head(self._data[start : start + 80])
        except ValueError:
            return False
        return head.start_ns <= head.end_ns and 0 < head.size <= container.MAX_CHUNK


def recover(
    path: str | Path,
    directory: str | Path | None = None,
    keep_damaged: bool = False,
    progress: Callable[[int], None] | None = None,
) -> Recovery:
    """Save all readable messages of a bag to a new one.

    :param path: the damaged bag: run directory, bag directory or .mcap file. It is only read.
    :param directory: where the new bag is made; None: beside the old one, with `_recovered` appended to
        its name.
    :param keep_damaged: keep what can be read of chunks whose checksum does not fit, too.
    :param progress: called now and then with the number of messages saved so far.
    :raises ConfigError: if the new directory is in use, or nothing at all can be read.
    :raises BagError: if the new bag cannot be written.
    """
    source = find_file(path)
    target = Path(directory) if directory is not None else _beside(bag_of(path))
    try:
        with source.open("rb") as stream:
            size = source.stat().st_size
            data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) if size else b""
    except OSError as error:
        raise UnusableBag(path, f"cannot be read: {error.strerror or error}") from None
    if container.MAGIC not in data[:8] and not any(data[:].find(mark) >= 0 for mark in _SIGNATURES):
        raise UnusableBag(path, f"{source.name} is not an MCAP file, or nothing is left of it")
    salvage = _Salvage(data, keep_damaged)
    # The first pass finds all channels: their first definition may be lost, and a later one good.
    readable = sum(1 for entry in salvage.entries() if entry.channel in salvage.channels)
    if salvage.packed:
        raise UnusableBag(path, PACKED_MESSAGES)
    if not readable:
        raise UnusableBag(path, "no message in it can be read: there is nothing to save")
    result = Recovery(source, target, closed=salvage.closed)
    _copy(salvage, result, progress)
    result.damaged = list(salvage.notes)
    if not salvage.closed:
        result.damaged.append("the recorder did not close the file")
    for identifier, count in salvage.expected.items():
        if identifier in salvage.channels:
            topic = salvage.channels[identifier].topic
            result.expected[topic] = result.expected.get(topic, 0) + count
    had = sum(salvage.expected.values())
    if had > result.count:
        result.damaged.append(f"{had - result.count} of the {had} messages that the file had are lost")
    return result


def _beside(path: Path) -> Path:
    whole = path.resolve()
    return whole.with_name(f"{whole.name if whole.is_dir() else whole.stem}_recovered")


def _copy(salvage: _Salvage, result: Recovery, progress: Callable[[int], None] | None) -> None:
    """Second pass: write the new bag."""
    custom_data = {**salvage.custom_data, metadata.RECOVERED_FROM: result.source.name}
    if KEY in custom_data:  # the new bag gets a digest of its own
        custom_data[f"recovered_{KEY}"] = custom_data.pop(KEY)
    unknown = 0
    with BagWriter(
        result.directory,
        None,
        custom_data=custom_data,
        ros_distro=salvage.ros_distro or "jazzy",
        min_time_ns=0,
    ) as writer:
        channels: dict[int, int] = {}
        topics: dict[str, int] = {}
        for identifier, channel in sorted(salvage.channels.items()):
            schema = salvage.schemas.get(channel.schema_id)
            if schema is None:
                continue
            if channel.topic not in topics:
                text = schema.data.decode("utf-8", "replace")
                definition = Definition(schema.name, text, channel.metadata.get("topic_type_hash", ""))
                profiles = qos.load(channel.metadata.get("offered_qos_profiles", ""))
                topics[channel.topic] = writer.add_topic(channel.topic, schema.name, profiles, definition)
            channels[identifier] = topics[channel.topic]
        for number, entry in enumerate(salvage.entries()):
            target = channels.get(entry.channel)
            if target is None:
                unknown += 1
                continue
            data = entry.buffer[entry.start : entry.end]
            writer.write(target, data, entry.log_time_ns, entry.publish_time_ns, entry.sequence)
            if progress and number % 65536 == 0:
                progress(number)
        result.saved = writer.counts
        result.start_ns, result.end_ns = writer.time_range_ns
        if not result.closed:
            writer.custom_data[BROKEN_OFF] = str(result.end_ns)
    if unknown:
        salvage.notes.append(f"{unknown} messages belong to topics whose definition is lost")
