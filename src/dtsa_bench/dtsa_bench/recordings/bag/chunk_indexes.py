"""Indexes of a bag's chunks while it is recorded: in a file, since two chunks a second are megabytes within an hour."""

from __future__ import annotations

from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryFile
from weakref import finalize

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import Writer

from .container import PREFIX

_ATTRIBUTE = "_Writer__chunk_indices"  # of mcap's writer: a list of objects, nearly 2 kB for each chunk of a flight


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
    """Lets a writer that has no chunk yet keep its indexes out of memory.

    :param writer: mcap's writer; one that keeps them elsewhere is left as it is.
    :param directory: where the bag is.
    """
    if getattr(writer, _ATTRIBUTE, None) == []:
        setattr(writer, _ATTRIBUTE, ChunkIndexes(directory))
