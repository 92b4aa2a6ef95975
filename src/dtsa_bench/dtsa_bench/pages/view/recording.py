"""A bag as a source of moments: one that is closed, or one that somebody still writes."""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Channel, Metadata, Schema
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError

from dtsa_agent.core.errors import DtsaError
from dtsa_bench.recordings.bag import container, metadata
from dtsa_bench.recordings.bag.errors import UnusableBag
from dtsa_bench.recordings.bag.place import find_file
from dtsa_bench.recordings.bag.reader import Bag

from .follower import Follower
from .track import MOST_MOMENTS, Track

KINDS = frozenset({"Transmission", "Reception", "RunStatus", "Configuration", "ParameterEvent"})
_POLL_S = 0.25  # how often a bag that grows is looked at
_SILENCE_S = 5.0  # who writes a bag closes a chunk every half second


class GrowingBag:
    """Reads a bag from its start in the order of the file, as far as it has been written.

    :param path: see :func:`dtsa_bench.recordings.bag.place.bag_of`.
    :raises UnusableBag: if it is none.
    """

    def __init__(self, path: str | Path) -> None:
        self._given = path
        self.path = find_file(path)
        try:
            self._stream = self.path.open("rb")
        except OSError as error:
            raise UnusableBag(path, f"cannot be read: {error.strerror or error}") from None
        if self._stream.read(len(container.MAGIC)) != container.MAGIC:
            self._stream.close()
            raise UnusableBag(path, f"{self.path.name} is not an MCAP file")
        self._at = len(container.MAGIC)
        self._schemas: dict[int, Schema] = {}
        self._kinds: dict[int, tuple[str, str]] = {}  # by channel: whole type, its name
        self._store = get_typestore(Stores.EMPTY)
        self.config: dict[str, Any] | None = None
        self.closed = False

    def messages(self) -> Iterator[tuple[str, Any]]:
        """Kind and fields of all messages of a run that have been written since the last call.

        :raises UnusableBag: where the file is damaged.
        """
        while not self.closed:
            self._stream.seek(self._at)
            head = self._stream.read(container.PREFIX.size)
            if len(head) < container.PREFIX.size:
                return
            opcode, length = container.PREFIX.unpack(head)
            if not opcode or opcode > container.DATA_END or length > container.MAX_CHUNK:
                raise UnusableBag(self._given, f"it is damaged at byte {self._at}")
            content = self._stream.read(length)
            if len(content) < length:
                return
            yield from self._record(opcode, head + content)
            self._at += len(head) + length

    def _record(self, opcode: int, record: bytes) -> Iterator[tuple[str, Any]]:
        content = record[container.PREFIX.size :]
        if opcode == container.DATA_END:
            self.closed = True
        elif opcode == container.CHUNK:
            try:
                head = container.chunk_head(record)
                records = container.decompress(head, record[head.offset : head.offset + head.length])
            except ValueError as error:
                raise UnusableBag(self._given, f"{error} (at byte {self._at})") from None
            for inner, start, end in container.records(records):
                if inner in (container.SCHEMA, container.CHANNEL):
                    self._define(inner, records[start:end])
            yield from self._decoded(records)
        elif opcode == container.MESSAGE:
            yield from self._decoded(record)
        elif opcode in (container.SCHEMA, container.CHANNEL, container.METADATA):
            self._define(opcode, content)

    def _decoded(self, records: bytes) -> Iterator[tuple[str, Any]]:
        for entry in container.messages(records):
            whole, kind = self._kinds.get(entry.channel, ("", ""))
            if kind:
                with suppress(SerdeError, AssertionError, IndexError, KeyError, ValueError):
                    yield kind, self._store.deserialize_cdr(entry.buffer[entry.start : entry.end], whole)

    def _define(self, opcode: int, content: bytes) -> None:
        stream = ReadDataStream(BytesIO(content))
        with suppress(McapError, struct.error, UnicodeDecodeError, MemoryError, TypesysError, SyntaxError, ValueError):
            if opcode == container.SCHEMA:
                schema = Schema.read(stream)
                self._schemas[schema.id] = schema
            elif opcode == container.CHANNEL:
                channel = Channel.read(stream)
                found = self._schemas.get(channel.schema_id)
                if found is not None and found.name.rpartition("/")[2] in KINDS:
                    types = get_types_from_msg(found.data.decode("utf-8"), found.name)
                    self._store.register({k: v for k, v in types.items() if k not in self._store.fielddefs})
                    self._kinds[channel.id] = found.name, found.name.rpartition("/")[2]
            elif opcode == container.METADATA:
                record = Metadata.read(stream)
                if record.name == metadata.RECORD_NAME and self.config is None:
                    texts = metadata.custom_data(metadata.load(record.metadata.get(metadata.RECORD_KEY, "")))
                    told = json.loads(texts.get("configuration", "null"))
                    self.config = told if isinstance(told, dict) else None

    def close(self) -> None:
        """Closes the file."""
        self._stream.close()


def moment_slots(path: str | Path, slot_ns: int, usual: int) -> int:
    """Slots from one moment of a closed bag to the next, so that the whole of it is remembered.

    :param path: the bag.
    :param slot_ns: ns, length of a slot.
    :param usual: slots from one moment to the next where the bag is short.
    """
    try:
        with Bag(path) as bag:
            slots = (bag.end_ns - bag.start_ns) // slot_ns
    except DtsaError:
        return usual
    return max(usual, -(-int(slots) // (MOST_MOMENTS - 10)))


class BagSource:
    """Tells a bag moment by moment, and goes on while it grows.

    :param path: the bag.
    :param track: where the moments go.
    :raises UnusableBag: if it is none.
    """

    def __init__(self, path: str | Path, track: Track) -> None:
        self._bag, self._track, self._path = GrowingBag(path), track, path
        self._live = not _is_closed(self._bag.path)
        self.stopped = False

    def run(self) -> None:
        """Reads until the bag is closed, or nobody writes it any more, or ``stopped`` is set."""
        follower = Follower(self._track, {"live": self._live, "control": False})
        try:
            self._follow(follower)
        except DtsaError as error:
            follower.finish(str(error))
        finally:
            self._bag.close()

    def _follow(self, follower: Follower) -> None:
        last, silent = time.monotonic(), False
        while not self.stopped:
            for kind, message in self._bag.messages():
                if self.stopped:
                    return
                last = time.monotonic()
                if not follower.begun and self._bag.config is not None:
                    self._begin(follower, self._bag.config)
                follower.take(kind, message)
            if self._bag.closed or not self._live:
                break
            if silent != (time.monotonic() - last > _SILENCE_S):
                silent = not silent
                self._track.end("waiting: nobody writes this bag at the moment" if silent else "")
            time.sleep(_POLL_S)
        if not follower.begun:
            self._track.end("it holds no run of a swarm")
        elif not self.stopped:
            follower.finish("recorded")

    def _begin(self, follower: Follower, config: dict[str, Any]) -> None:
        if not self._live:
            swarm = config.get("swarm", config)
            with suppress(TypeError, ValueError, ZeroDivisionError, KeyError):
                slot_ns = round(float(swarm["slot_ms"]) * 1e6)
                follower.set_pace(moment_slots(self._path, slot_ns, max(1, round(5e7 / slot_ns))))
        follower.begin(config)


def _is_closed(path: Path) -> bool:
    """Whether a file ends as a finished MCAP file does."""
    size = len(container.MAGIC)
    with path.open("rb") as stream, suppress(OSError):
        stream.seek(-size, 2)
        return stream.read() == container.MAGIC and stream.tell() > size
    return False
