"""Records a run to a bag directory that rosbag2 (Jazzy), Foxglove, PlotJuggler and plain MCAP readers open.

`<directory>/<name>_0.mcap` holds the messages in compressed chunks with all indexes,
`<directory>/metadata.yaml` describes it. A chunk is closed and handed to the operating system every half
second, so that a killed recorder loses no more than that; `dtsa_bench.log.bag.recover` makes a full bag of
what it left. A recorder that says where a step of its run is complete (`mark`) gets chunks that end there and
nowhere else: whatever byte such a file is cut at, its whole chunks are a run up to a complete step.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from hashlib import blake2b
from pathlib import Path
from time import monotonic
from typing import Any, NoReturn

from mcap.writer import CompressionType, Writer

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.ros.common.cdr import RUN_MESSAGES, without_run
from dtsa_bench import __version__
from dtsa_bench.runs.options import check_free
from dtsa_bench.runs.program import program

from . import metadata
from .errors import BagError
from .schema import Definition, Topic, installed

FLUSH_S = 0.5
BROKEN_OFF = "broken_off"  # key of custom_data of a bag of which a part is lost: log time up to which it is whole, ns
KEY = "digest"  # name of the digest in custom_data
_UNLIMITED = 1 << 62  # bytes: chunks end where `mark` ends them
_RECORD_BYTES = 31  # bytes of a message record beside its data
_TIMES = struct.Struct("<QQQ")
_MASK = (1 << 128) - 1


class BagWriter:
    """One bag directory being recorded. For one thread; a context manager.

    :param directory: where the bag is made; empty, or not there yet. Or the name of an .mcap file, for a bag of
        this file alone.
    :param config: configuration of the run, JSON types; None: the bag says nothing of its origin but `custom_data`.
    :param compression: of the chunks of the .mcap.
    :param chunk_size: bytes, size at which a chunk is closed even if its half second is not over.
    :param marked: whether chunks end at a `mark` only; the recorder calls it after each step of the run.
    :param profile: MCAP's name for the conventions that topics and messages follow.
    :raises ConfigError: if the directory is in use.
    :raises BagError: if the directory cannot be made or written to; likewise below, for a full disk or a closed bag.
    """

    def __init__(
        self,
        directory: str | Path,
        config: Mapping[str, Any] | None,
        compression: CompressionType = CompressionType.ZSTD,
        chunk_size: int = 1 << 20,
        custom_data: Mapping[str, str] | None = None,
        marked: bool = False,
        profile: str = "ros2",
    ) -> None:
        self.directory = Path(directory)
        self._is_file = self.directory.suffix == ".mcap"
        if not self._is_file:
            check_free(self.directory, "directory of the bag")
        self.custom_data = dict(custom_data or {})
        if config is not None:
            self.custom_data |= {
                "project": "dtsa", "version": __version__, "configuration": json.dumps(config, sort_keys=True),
                "seed": str({**config, **config.get("swarm", {})}.get("seed", "")),
            }  # fmt: skip
        self._marked, self._chunk_size = marked, chunk_size
        self._chunk_bytes = 0  # in the chunk that is being filled
        self.path = self.directory if self._is_file else self.directory / f"{self.directory.resolve().name}_0.mcap"
        self._topics: list[Topic] = []  # the channel's number - 1 is its index
        self._schemas: dict[Definition, int] = {}
        self._digest = BagDigest()
        self._start_ns, self._end_ns = 1 << 63, 0
        self._unsaved = 0  # messages since the last flush
        self._ended = ""  # why nothing more can be recorded
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = self.path.open("xb")
        except OSError as error:
            raise BagError(f"cannot record to {self.directory}: {error.strerror or error}") from error
        self._mcap = Writer(
            self._stream, chunk_size=_UNLIMITED, compression=compression,
            enable_data_crcs=True,
        )  # fmt: skip
        with self._failing():
            self._mcap.start(profile=profile, library=f"dtsa {__version__}")
            self._add_own_metadata()
            self._stream.flush()
        self._next_flush = monotonic() + FLUSH_S

    @property
    def counts(self) -> dict[str, int]:
        """Messages written so far, by topic."""
        return {topic.name: topic.count for topic in self._topics}

    @property
    def time_range_ns(self) -> tuple[int, int]:
        """Log times of the earliest and the latest message, ns; zeros in an empty bag."""
        return (self._start_ns, self._end_ns) if self._start_ns <= self._end_ns else (0, 0)

    def add_topic(
        self, topic: str, type_name: str, qos: str | Sequence[metadata.Profile] = "reliable",
        definition: Definition | None = None,
    ) -> int:  # fmt: skip
        """Announce a topic, at any time before its first message; return the channel for `write`.

        :param qos: name from `metadata.PROFILES`, or the profiles that its publishers offer.
        :param definition: message definition and type hash; None: those of the installed type.
        :raises ConfigError: if the topic is there already.
        """
        self._check_open()
        if any(known.name == topic for known in self._topics):
            raise ConfigError("topic", topic, "a name that is not in the bag yet")
        profiles = [metadata.PROFILES[qos]] if isinstance(qos, str) else list(qos)
        definition = definition or installed(type_name)
        schema = self._schemas.get(definition, 0)  # 0: a channel without one
        if not schema and definition.encoding:
            data = definition.text.encode("utf-8", "surrogateescape")
            schema = self._schemas[definition] = self._mcap.register_schema(type_name, definition.encoding, data)
        about = {"offered_qos_profiles": metadata.dump_profiles(profiles), "topic_type_hash": definition.type_hash}
        number = self._mcap.register_channel(topic, definition.message_encoding, schema, about)
        self._topics.append(Topic(topic, definition, profiles))
        return number

    def write(
        self, channel: int, data: bytes, log_time_ns: int, publish_time_ns: int, sequence: int | None = None
    ) -> None:
        """Record one message.

        :param data: the message as CDR, with its encapsulation header.
        :param log_time_ns: ns, simulated time of reception.
        :param publish_time_ns: ns, simulated time of transmission.
        :param sequence: number of the message on its topic; None: the next one.
        """
        self._check_open()
        if not 0 < channel <= len(self._topics):
            raise BagError(f"channel {channel} was never added to {self.directory}")
        topic = self._topics[channel - 1]
        self._unsaved += 1
        if sequence is None:
            sequence = topic.count
        try:
            self._mcap.add_message(channel, log_time_ns, data, publish_time_ns, sequence)
        except OSError as error:
            self._fail(error)
        self._digest.add(topic.name, topic.type, log_time_ns, publish_time_ns, sequence, data)
        topic.count += 1
        self._start_ns, self._end_ns = min(self._start_ns, log_time_ns), max(self._end_ns, log_time_ns)
        self._chunk_bytes += len(data) + _RECORD_BYTES
        if not self._marked:
            self.mark()

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Store a metadata record of another name than rosbag2's."""
        self.flush()  # such a record stands between chunks
        with self._failing():
            self._mcap.add_metadata(name, dict(values))

    def mark(self) -> None:
        """What has been written until now is a run up to a complete step: a chunk may end here."""
        if monotonic() >= self._next_flush or self._chunk_bytes > self._chunk_size:
            self.flush()

    def flush(self) -> None:
        """Hand everything written so far to the operating system.

        `write`, or `mark` where there are marks, does this by itself every half second of wall time; a recorder that
        may wait long for its next message calls it too.
        """
        self._check_open()
        with self._failing():
            self._mcap.flush()
        self._unsaved = self._chunk_bytes = 0
        self._next_flush = monotonic() + FLUSH_S

    def close(self) -> None:
        """Finish the file and write `metadata.yaml`. Further calls do nothing."""
        if self._ended:  # the call that met a failure has reported it
            return
        self.custom_data[KEY] = self._digest.hexdigest()
        with self._failing():
            self._mcap.flush()
            self._add_own_metadata()
            self._mcap.finish()
            self._stream.close()
            if not self._is_file:
                metadata.write(self.directory, self._metadata())
        self._ended = f"the bag {self.directory} is closed: nothing more can be recorded to it"

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *unused: object) -> None:
        self.close()

    def _metadata(self) -> dict[str, Any]:
        """What `metadata.yaml` says below its root."""
        start_ns, end_ns = self.time_range_ns
        extent = {
            "starting_time": {"nanoseconds_since_epoch": start_ns}, "duration": {"nanoseconds": end_ns - start_ns},
            "message_count": sum(self.counts.values()),
        }  # fmt: skip
        topics = [
            {
                "topic_metadata": {
                    "name": topic.name, "type": topic.type, "serialization_format": topic.definition.message_encoding,
                    "offered_qos_profiles": list(topic.profiles), "type_description_hash": topic.definition.type_hash,
                },
                "message_count": topic.count,
            }
            for topic in self._topics
        ]  # fmt: skip
        return {
            "version": metadata.VERSION, "storage_identifier": "mcap", **extent, "topics_with_message_count": topics,
            "compression_format": "", "compression_mode": "", "relative_file_paths": [self.path.name],
            "files": [{"path": self.path.name, **extent}], "custom_data": self.custom_data, "ros_distro": "jazzy",
        }  # fmt: skip

    def _add_own_metadata(self) -> None:
        self._mcap.add_metadata(metadata.RECORD_NAME, {metadata.RECORD_KEY: metadata.dump(self._metadata())})

    def _check_open(self) -> None:
        if self._ended:
            raise BagError(self._ended)

    @contextmanager
    def _failing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> NoReturn:
        lost = f", up to {self._unsaved} messages are not saved" if self._unsaved else ""
        self._ended = (
            f"recording to {self.path} stopped: {error.strerror or error}{lost}; "
            f"`{program()} recover {self.directory}` makes a full bag of the rest"
        )
        with suppress(OSError):
            self._stream.close()
        raise BagError(self._ended) from error


class BagDigest:
    """Running digest of a bag: a dropped, swapped or altered message shows even where nothing else does.

    It is the sum, modulo 2^128, of one BLAKE2b hash a message over topic, times, number on the topic and bytes; so it
    does not depend on the order of reading. It guards against mishaps and careless edits, not against somebody who
    writes a new digest as well. A run's random id is left out. Fast CDR leaves the bytes between aligned fields as they
    happen to be: two recordings of one flight may differ in their digests although no field does.
    """

    __slots__ = ("_sum",)

    def __init__(self) -> None:
        self._sum = 0

    def add(self, topic: str, kind: str, log_time_ns: int, publish_time_ns: int, sequence: int, data: bytes) -> None:
        """Take in one message; `kind`: its type."""
        state = blake2b(topic.encode("utf-8", "replace"), digest_size=16)
        state.update(_TIMES.pack(log_time_ns, publish_time_ns, sequence))
        state.update(without_run(data) if kind in RUN_MESSAGES else data)
        self._sum = (self._sum + int.from_bytes(state.digest(), "little")) & _MASK

    def hexdigest(self) -> str:
        """The digest so far."""
        return f"{self._sum:032x}"
