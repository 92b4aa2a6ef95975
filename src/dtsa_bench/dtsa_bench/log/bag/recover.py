"""Makes a full bag of what a killed recorder, a full disk or a damaged file left behind.

Whole records are copied from the start of the file. Where one cannot be read, copying goes on with the next chunk that
can, and what lies between is named. Chunks of a flight end with complete slots, so what is saved up to the first
damaged place is the flight up to the end of one. Messages stay as they are encoded; the original is only read.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.records import Channel, Header, Message, Metadata, Schema

from . import metadata
from .errors import NothingWritten, UnusableBag
from .file import BagFile
from .schema import Topic
from .writer import BROKEN_OFF, KEY, BagWriter


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
        files = [BagFile(part, path, stack) for part in paths]
        profile, about = _begin(files, path)
        custom_data = {**metadata.custom_data(about), metadata.RECOVERED_FROM: result.source.name}
        with _new_bag(result.directory, custom_data, profile) as writer:
            copy = _Copy(writer, metadata.has_packed_messages(about))
            for file in files:
                copy.add(file)
            result.saved, result.expected = writer.counts, dict(sum((file.counts for file in files), Counter()))
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


@contextmanager
def _new_bag(directory: Path, custom_data: Mapping[str, str], profile: str) -> Iterator[BagWriter]:
    """A bag that is gone again after Ctrl-C: what was copied until then would pass for all that could be saved."""
    writer = BagWriter(directory, None, custom_data=custom_data, profile=profile)
    try:
        with writer:
            yield writer
    except KeyboardInterrupt:
        writer.path.unlink()
        if writer.path != directory:
            (directory / metadata.FILE_NAME).unlink(missing_ok=True)
            directory.rmdir()
        raise


def _begin(files: list[BagFile], given: str | Path) -> tuple[str, dict[str, Any]]:
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


class _Copy:
    """What is copied to a new bag; `packed`: messages are compressed one by one, and are unpacked."""

    def __init__(self, writer: BagWriter, packed: bool) -> None:
        self._writer, self._unpack = writer, metadata.unpack if packed else bytes
        self._topics: dict[str, tuple[int, Topic]] = {}  # channel of the new bag, by name
        self.lost: Counter[str] = Counter()  # by why it is lost

    def add(self, file: BagFile) -> None:
        """Copy what can be read of one file."""
        schemas = dict(file.summary.schemas)
        # Channels of the new bag by those of the file; 0: none.
        targets = {number: self._channel(channel, schemas) for number, channel in file.summary.channels.items()}
        for record in file.records():
            if isinstance(record, Message):
                try:
                    data = self._unpack(record.data)
                except ValueError:
                    self.lost["messages cannot be unpacked"] += 1
                    continue
                if target := targets.get(record.channel_id, 0):
                    self._writer.write(target, data, record.log_time, record.publish_time, record.sequence)
                else:
                    self.lost["messages belong to topics that are not defined"] += 1
            elif isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                targets[record.id] = self._channel(record, schemas)
            elif isinstance(record, Metadata):
                if record.name != metadata.RECORD_NAME:
                    self._writer.add_metadata(record.name, record.metadata)
                elif KEY in (last := metadata.custom_data(metadata.load_record(record))):
                    self._writer.custom_data[f"recovered_{KEY}"] = last[KEY]  # the new bag gets one of its own

    def _channel(self, channel: Channel, schemas: Mapping[int, Schema]) -> int:
        """The new bag's channel for one of the file; 0: it is not defined, or its topic has another type already."""
        if channel.schema_id and channel.schema_id not in schemas:
            return 0
        topic = Topic.of_channel(channel, schemas.get(channel.schema_id))
        if topic.name not in self._topics:
            number = self._writer.add_topic(topic.name, topic.type, topic.profiles, topic.definition)
            self._topics[topic.name] = number, topic
        number, first = self._topics[topic.name]
        is_alike = (topic.type, topic.definition.encodings) == (first.type, first.definition.encodings)
        return number if is_alike else 0
