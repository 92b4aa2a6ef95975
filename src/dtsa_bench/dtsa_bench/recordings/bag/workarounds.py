"""What works around mcap's writer (1.6), each with what is wrong, and when it can go.

The writer offers no setting for either; no issue of mcap's is known for them. Both replace a private attribute, and
leave a writer alone that does not have it: its files are the same, byte for byte (`test_bag_writer.py`).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import partial
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any
from weakref import finalize

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Message, MessageIndex
from mcap.writer import Writer

from .container import PREFIX

# Of mcap's writer: a builder of chunks, and a list of objects, nearly 2 kB for each chunk of a flight.
_BUILDER, _INDEXES = "_Writer__chunk_builder", "_Writer__chunk_indices"
_NEEDED = ("message_start_time", "message_end_time", "message_indices", "num_messages", "record_writer")
# Opcode, length, channel, sequence, log time, publish time; the message's bytes follow.
_RECORD = struct.Struct("<BQHIQQ")
_COUNTED = _RECORD.size - 9  # bytes that the length counts beside the message's


def write_quickly(writer: Writer) -> None:
    """Lets a writer put messages into its chunks in one go.

    Defect: it writes a message's record number by number, which takes half as long again, and a flight has dozens of
    messages in every slot. Delete when mcap's ``Message.write`` packs a record at once.

    :param writer: mcap's writer; one that makes chunks in another way is left as it is.
    """
    builder = getattr(writer, _BUILDER, None)
    if all(hasattr(builder, name) for name in _NEEDED):
        builder.add_message = partial(_add_message, builder)


def _add_message(builder: Any, message: Message) -> None:
    """Does what the chunk builder's own method does."""
    time_ns, channel, data = message.log_time, message.channel_id, message.data
    if not builder.num_messages or time_ns < builder.message_start_time:
        builder.message_start_time = time_ns
    if time_ns > builder.message_end_time:
        builder.message_end_time = time_ns
    index = builder.message_indices.get(channel)
    if index is None:
        index = builder.message_indices[channel] = MessageIndex(channel_id=channel, records=[])
    record = builder.record_writer
    index.records.append((time_ns, record.count))
    builder.num_messages += 1
    length = _COUNTED + len(data)
    record.write(_RECORD.pack(Opcode.MESSAGE, length, channel, message.sequence, time_ns, message.publish_time))
    record.write(data)


class ChunkIndexes:
    """Takes the place of a list of indexes: keeps each as the bytes that it will be in the bag.

    :param directory: where the file is made that keeps them; it has no name, and goes with the process.
    :raises OSError: if it cannot be made.
    """

    def __init__(self, directory: Path) -> None:
        self._file = TemporaryFile(dir=directory)  # noqa: SIM115 (open as long as the bag is recorded)
        finalize(self, self._file.close)

    def append(self, index: ChunkIndex) -> None:
        """Adds the index of a chunk.

        :raises OSError: if the disk is full.
        """
        builder = RecordBuilder()
        index.write(builder)
        self._file.write(builder.end())
        self._file.flush()

    def __iter__(self) -> Iterator[ChunkIndex]:
        self._file.seek(0)
        while prefix := self._file.read(PREFIX.size):
            _, length = PREFIX.unpack(prefix)
            yield ChunkIndex.read(ReadDataStream(BytesIO(self._file.read(length))))


def keep_small(writer: Writer, directory: Path) -> None:
    """Lets a writer that has no chunk yet keep its indexes in a file.

    Defect: it keeps them in memory until the end, and two chunks a second are megabytes within an hour. Delete when
    mcap's writer keeps them as bytes, or elsewhere.

    :param writer: mcap's writer; one that keeps them elsewhere is left as it is.
    :param directory: where the bag is.
    """
    if getattr(writer, _INDEXES, None) == []:
        setattr(writer, _INDEXES, ChunkIndexes(directory))
