"""Indexes of a bag's chunks while it is recorded, in little memory: two chunks a second are many within hours."""

from __future__ import annotations

from collections.abc import Iterator
from io import BytesIO

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import Writer

from dtsa_bench.bag.container import PREFIX

_ATTRIBUTE = "_Writer__chunk_indices"  # of mcap's writer: a list of objects, nearly 2 kB for each chunk of a flight


class ChunkIndexes:
    """Takes the place of a list of indexes: keeps each as the bytes that it will be in the file."""

    def __init__(self) -> None:
        self._records = bytearray()

    def append(self, index: ChunkIndex) -> None:
        """Adds the index of a chunk."""
        builder = RecordBuilder()
        index.write(builder)
        self._records += builder.end()

    def __iter__(self) -> Iterator[ChunkIndex]:
        position = 0
        while position < len(self._records):
            _, length = PREFIX.unpack_from(self._records, position)
            position += PREFIX.size
            yield ChunkIndex.read(ReadDataStream(BytesIO(self._records[position : position + length])))
            position += length


def keep_small(writer: Writer) -> None:
    """Lets a writer that has no chunk yet keep its indexes in little memory.

    :param writer: mcap's writer; one that keeps them elsewhere is left as it is.
    """
    if getattr(writer, _ATTRIBUTE, None) == []:
        setattr(writer, _ATTRIBUTE, ChunkIndexes())
