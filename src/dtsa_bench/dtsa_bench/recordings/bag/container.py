"""The parts of an MCAP file that reading fast and mending need: records, chunks and the messages in them.

Headers, schemas, channels and indexes are read by the `mcap` library; what is here touches every message,
or works on files that the library rightly refuses.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import lz4.frame
import zstandard

MAGIC = b"\x89MCAP0\r\n"
HEADER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = 1, 3, 4, 5, 6, 7
ATTACHMENT, METADATA, DATA_END = 9, 0x0C, 0x0F
PREFIX = struct.Struct("<BQ")  # opcode and length of every record
_MESSAGE = struct.Struct("<BQHIQQ")  # a message record up to its data
_CHUNK = struct.Struct("<QQQII")  # a chunk's times, size, checksum, length of its compression's name
MESSAGE_HEAD = _MESSAGE.size - PREFIX.size
MAX_CHUNK = 1 << 31  # bytes; what claims to be larger is damaged


class Entry(NamedTuple):
    """One message inside a chunk."""

    log_time_ns: int
    chunk: int  # offset of the chunk in the file: with `start`, the order in which messages were written
    start: int  # offset of the data in the uncompressed chunk
    end: int
    channel: int
    sequence: int
    publish_time_ns: int
    buffer: bytes  # the uncompressed chunk


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """What stands before a chunk's compressed records."""

    start_ns: int  # log time of the first message
    end_ns: int
    size: int  # bytes, uncompressed
    crc: int  # of the uncompressed records; 0: none
    compression: str
    offset: int  # of the compressed records, from the record's start
    length: int  # bytes, compressed


def chunk_head(record: bytes | memoryview) -> ChunkHead:
    """Head of a chunk record that begins with its opcode; more of the record may be missing.

    :raises ValueError: if this cannot be a chunk.
    """
    try:
        start_ns, end_ns, size, crc, name = _CHUNK.unpack_from(record, PREFIX.size)
        place = PREFIX.size + _CHUNK.size
        if name > 16 or size > MAX_CHUNK:
            raise ValueError("not a chunk")
        compression = bytes(record[place : place + name]).decode("ascii")
        (length,) = struct.unpack_from("<Q", record, place + name)
    except (struct.error, UnicodeDecodeError) as error:
        raise ValueError(f"not a chunk: {error}") from None
    return ChunkHead(start_ns, end_ns, size, crc, compression, place + name + 8, length)


def decompress(head: ChunkHead, data: bytes | memoryview) -> bytes:
    """The uncompressed records of a whole chunk.

    :raises ValueError: if they are damaged.
    """
    try:
        if head.compression == "zstd":
            records = zstandard.ZstdDecompressor().decompress(data, max_output_size=head.size)
        elif head.compression == "lz4":
            records = lz4.frame.decompress(data)
        elif head.compression == "":
            records = bytes(data)
        else:
            raise ValueError(f"unknown compression {head.compression!r}")
    except (zstandard.ZstdError, RuntimeError, MemoryError) as error:
        raise ValueError(f"damaged chunk: {error}") from None
    if len(records) != head.size or (head.crc and zlib.crc32(records) != head.crc):
        raise ValueError("damaged chunk: its checksum does not fit")
    return records


def records(buffer: bytes) -> Iterator[tuple[int, int, int]]:
    """(opcode, start, end of the content) of each whole record in uncompressed records."""
    position, size = 0, len(buffer)
    while position + PREFIX.size <= size:
        opcode, length = PREFIX.unpack_from(buffer, position)
        start = position + PREFIX.size
        if not opcode or length > size - start:
            return
        position = start + length
        yield opcode, start, position


def messages(buffer: bytes, chunk: int = 0) -> Iterator[Entry]:
    """All whole messages in uncompressed records, as they were written.

    :param chunk: bytes, offset of their chunk in the file.
    """
    position, size = 0, len(buffer)
    unpack, head = _MESSAGE.unpack_from, _MESSAGE.size
    while position + PREFIX.size <= size:
        if buffer[position] == MESSAGE and position + head <= size:
            _, length, channel, sequence, log_ns, publish_ns = unpack(buffer, position)
            end = position + PREFIX.size + length
            if length < MESSAGE_HEAD or end > size:
                return
            yield Entry(log_ns, chunk, position + head, end, channel, sequence, publish_ns, buffer)
        else:
            opcode, length = PREFIX.unpack_from(buffer, position)
            end = position + PREFIX.size + length
            if opcode in (0, MESSAGE) or end > size:
                return
        position = end
