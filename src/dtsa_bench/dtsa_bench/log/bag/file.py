"""One file of a bag: its index, its checksums and its records, whether its recorder finished it or not."""

from __future__ import annotations

import heapq
import mmap
import re
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import ExitStack, suppress
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, DataEnd, Header, Message, Metadata, Schema
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from mcap.summary import Summary

from . import metadata
from .errors import UnusableBag

MAGIC = b"\x89MCAP0\r\n"  # the first bytes of a file, and the last
PREFIX = struct.Struct("<BQ")  # opcode and length of every record
MOST_TRIED = 64  # times the size of a file: bytes of what looks like chunks that are tried
MAX_FILE_BYTES = 1 << 36  # of a file that is compressed as a whole, on the disk
MAX_WAITING_BYTES = 1 << 30  # of messages in memory, of chunks that overlap in time
_END = struct.Struct("<QQI8s")  # end of a file: where its index begins, and its second part; checksum; magic
_INDEX = struct.Struct("<HI")  # of a message index: channel, bytes of the entries that follow
# A chunk up to its compressed records: length, below 2^40; times, size, checksum; compression; length of the records.
_CHUNK = re.compile(rb"\x06(.{5}\0{3}).{28}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd)(.{8})", re.DOTALL)
_KINDS: dict[int, Any] = {
    Opcode.HEADER: Header, Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.CHUNK: Chunk,
    Opcode.METADATA: Metadata,
}  # fmt: skip


class BagFile:
    """One file of a bag, open as long as the stack.

    :param given: what the bag was named by, for errors.
    :raises UnusableBag: if it cannot be read, or is no MCAP file.
    """

    def __init__(self, path: Path, given: str | Path, stack: ExitStack) -> None:
        self.path = path
        self._stream = stack.enter_context(_open(path))
        if self._stream.read(len(MAGIC)) != MAGIC:
            raise UnusableBag(given, f"{path.name} is not an MCAP file, or its beginning is lost")
        self._stream.seek(0)
        self._reader = SeekingReader(self._stream, validate_crcs=True)
        self.is_closed = False  # whether it has an end
        self.index_fault = ""  # why its index cannot be used; empty: it can
        self.summary = Summary()  # as its index has it; empty if there is none
        self.counts: Counter[str] = Counter()  # messages by topic, likewise
        self.about: dict[str, Any] = {}  # what the recorder says of the bag, likewise
        self.faults: list[str] = []  # where and why its records cannot be read
        self.whole_ns = 1 << 63  # log time of the last message before the first of them
        self._size = 0  # bytes
        self._tried = 0  # bytes of what looked like chunks
        try:
            self._read_index()
        except Exception as error:  # the library meets damaged files with many kinds of errors
            self.index_fault = str(error) or type(error).__name__
        for number, count in self._channel_counts().items():
            self.counts[self.summary.channels[number].topic if number in self.summary.channels else "?"] += count

    def _read_index(self) -> None:
        """Read what stands behind the messages; raises errors of any kind for a damaged file."""
        self._size = self._stream.seek(0, 2)
        self._stream.seek(-len(MAGIC), 2)
        self.is_closed = self._stream.tell() > 0 and self._stream.read() == MAGIC
        if not self.is_closed:
            raise McapError("no end mark")
        start, checksum = self._read_end()
        self._stream.seek(start)
        if start and checksum and zlib.crc32(self._stream.read()[:-12]) != checksum:  # of all that stands before it
            raise McapError("its index does not fit its checksum")
        summary = self._reader.get_summary()
        if summary is None or summary.statistics is None:
            raise McapError("it has no index")
        self.summary = summary
        with suppress(Exception):  # of a damaged record: whatever the library meets, there is none then
            for record in self._reader.iter_metadata():
                if record.name == metadata.RECORD_NAME:
                    self.about |= metadata.load_record(record)
        self._reader.get_header()
        if summary.statistics.message_count and not summary.chunk_indexes:
            raise McapError("its messages are not in indexed chunks")
        self._complete_channels()

    def _read_end(self) -> tuple[int, int]:
        """Where the index begins, and its checksum."""
        self._stream.seek(-_END.size, 2)
        start, _, checksum, _ = _END.unpack(self._stream.read())
        return start, checksum

    def _channel_counts(self) -> dict[int, int]:
        statistics = self.summary.statistics
        return {n: count for n, count in statistics.channel_message_counts.items() if count} if statistics else {}

    def _complete_channels(self) -> None:
        """Complete an index that repeats no channels or schemas by those that stand before the messages."""
        channels, schemas, counts = self.summary.channels, self.summary.schemas, self._channel_counts()

        def is_complete() -> bool:
            found = [channels.get(number) for number in counts]
            return all(channel and channel.schema_id in (0, *schemas) for channel in found)

        if is_complete():
            return
        for record in self.records():
            if isinstance(record, Schema):
                schemas.setdefault(record.id, record)
            elif isinstance(record, Channel):
                channels.setdefault(record.id, record)
            else:
                continue
            if is_complete():
                return
        if not counts.keys() <= channels.keys():
            raise McapError("the channels of some messages are not defined")

    def checksum_fault(self) -> str:
        """What the checksums of a finished file say against it; empty: nothing. A change of any of its bytes shows."""
        if self.index_fault:
            return f"it is damaged ({self.index_fault})"
        try:
            index_start, _ = self._read_end()
            self._stream.seek(0)
            records = StreamReader(self._stream, emit_chunks=True, validate_crcs=True).records
            if not any(isinstance(record, DataEnd) for record in records) or self._stream.tell() != index_start:
                return "the end of its messages is damaged"
        except CRCValidationError:
            return "its contents do not fit their checksum"
        except Exception as error:  # the library meets damaged files with many kinds of errors
            return f"it is damaged ({error or type(error).__name__})"
        return ""

    def messages(
        self, topics: Collection[str] | None, start_ns: int
    ) -> Iterator[tuple[Schema | None, Channel, Message]]:
        """Messages of a file with an index, in order of log time, those of equal time as recorded.

        :param topics: names; None: all.
        :param start_ns: ns, earliest log time.
        :raises Exception: of any kind, for a damaged chunk.
        """
        channels, schemas = self.summary.channels, self.summary.schemas
        wanted = {number for number, one in channels.items() if topics is None or one.topic in topics}
        waiting: list[tuple[int, int, int, Message | None]] = [  # log time, chunk, number in it; None: a whole chunk
            (index.message_start_time, index.chunk_start_offset, -1, None)
            for index in self.summary.chunk_indexes
            if index.message_end_time >= start_ns
            and (not index.message_index_offsets or wanted & index.message_index_offsets.keys())
        ]
        heapq.heapify(waiting)
        size = 0
        while waiting:
            _, offset, _, message = heapq.heappop(waiting)
            if message is not None:
                size -= len(message.data)
                channel = channels[message.channel_id]
                yield (schemas[channel.schema_id] if channel.schema_id else None), channel, message
                continue
            for number, record in enumerate(self._chunk(offset)):
                if isinstance(record, Message) and record.log_time >= start_ns:
                    if record.channel_id not in channels:
                        raise ValueError(f"a message of channel {record.channel_id}, which is not defined")
                    if record.channel_id in wanted:
                        heapq.heappush(waiting, (record.log_time, offset, number, record))
                        size += len(record.data)
            if size > MAX_WAITING_BYTES:
                raise ValueError(f"more than {MAX_WAITING_BYTES >> 20} MiB of its chunks overlap in time")

    def _chunk(self, offset: int) -> list[Any]:
        """The records of the chunk that begins there."""
        self._stream.seek(offset)
        opcode, length = PREFIX.unpack(self._stream.read(PREFIX.size))
        if opcode != Opcode.CHUNK or length > self._size:
            raise ValueError("no chunk is where the index says")
        return _parsed(opcode, self._stream.read(length))

    def records(self) -> Iterator[Any]:
        """The records that can be read, in their order; a chunk's stand in its place."""
        self.faults, self.whole_ns = [], 1 << 63
        with mmap.mmap(self._stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            position, size, last_ns = len(MAGIC), len(data), 0
            chunked = self._next_chunk(data, position) < size
            while position < size:
                try:
                    begin = position + PREFIX.size
                    opcode, length = PREFIX.unpack(data[position:begin].ljust(PREFIX.size, b"\xff"))
                    if length > size - begin:
                        raise ValueError("it is cut off")
                    if opcode == Opcode.DATA_END and length == 4:
                        return
                    if opcode == Opcode.MESSAGE and chunked:  # it has no checksum: as likely a damaged index
                        raise ValueError("a message outside of chunks")
                    records = _parsed(opcode, data[begin : begin + length])
                except Exception as error:  # the library meets damage with many kinds of errors
                    goes_on = self._next_chunk(data, position + 1)
                    time = f", after {last_ns / 1e9:.3f} s," if last_ns else ""
                    self.faults.append(f"bytes {position} to {goes_on}{time} cannot be read ({error}) and are left out")
                    self.whole_ns, position = min(self.whole_ns, last_ns), goes_on
                    continue
                yield from records
                last_ns = max((record.log_time for record in records if isinstance(record, Message)), default=last_ns)
                position = begin + length

    def _next_chunk(self, data: mmap.mmap, position: int) -> int:
        """Where the next whole chunk begins; the end of the file if there is none."""
        while match := _CHUNK.search(data, position):
            position, end = match.start(), match.start() + PREFIX.size + int.from_bytes(match[1], "little")
            if match.end() + int.from_bytes(match[2], "little") == end <= len(data):
                self._tried += end - position
                if self._tried > MOST_TRIED * len(data):  # made so: chance has no such chunks within chunks
                    break
                with suppress(Exception):  # whatever the library meets: then it is none
                    _parsed(Opcode.CHUNK, data[position + PREFIX.size : end])
                    return position
            position += 1
        return len(data)


def _open(path: Path) -> IO[bytes]:
    """A bag's file, open for reading; one that is compressed as a whole is unpacked, as far as that is possible.

    :raises UnusableBag: if it cannot be read, or is too large.
    """
    try:
        if path.suffix != ".zstd":
            return path.open("rb")
        with ExitStack() as stack:
            unpacked = stack.enter_context(TemporaryFile())
            # Of a damaged file the beginning is unpacked.
            with path.open("rb") as packed, suppress(zstandard.ZstdError):
                reader = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
                while block := reader.read(1 << 20):
                    unpacked.write(block)
                    if unpacked.tell() > MAX_FILE_BYTES:
                        raise UnusableBag(path, f"it is larger than {MAX_FILE_BYTES >> 30} GiB when unpacked")
            unpacked.seek(0)
            stack.pop_all()
            return unpacked
    except OSError as error:
        raise UnusableBag(path, f"cannot be read: {error.strerror or error}") from None


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
    if not isinstance(record, Chunk):
        return [record]
    if record.compression:
        record.data, record.compression = metadata.unpack(record.data, record.compression, record.uncompressed_size), ""
    return breakup_chunk(record, validate_crc=True)
