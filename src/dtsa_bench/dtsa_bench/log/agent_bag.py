"""The bag that an agent on a network makes of its own flight: a file of slot records, written and read. Needs no ROS.

Times are those of the agent's own clock, moved so that its first is one second. Frames are whole datagrams here, those
of others that it heard among them. A file that was not finished is read as far as it is whole.
"""

from __future__ import annotations

import dataclasses
import json
import re
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic, monotonic_ns
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from rosbags.serde import SerdeError
from zstandard import ZstdError

from dtsa_agent.air.port import flight_ns, frame_in
from dtsa_agent.air.port import PortProperties, PortSettings
from dtsa_agent.air.record import ReceivedFrame, SlotRecord
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.frame import TAG_LENGTH
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.cdr import pack_received
from dtsa_bench import __version__
from dtsa_bench.log.arrays import NEW
from dtsa_bench.log.record import (
    AGENT,
    FORMAT,
    FORMAT_KEY,
    SLOT_RECORD,
    TYPE,
    cut_frames,
    frame_fields,
    pack_record,
    record_codec,
)
from dtsa_bench.log.bag import metadata, schema
from dtsa_bench.log.bag.errors import BagError, UnusableBag
from dtsa_bench.log.bag.writer import BROKEN_OFF
from dtsa_bench.runs.config import REALTIME
from dtsa_bench.runs.options import new_directory
from dtsa_bench.runs.program import program

from .merge.joined import AgentBag

if TYPE_CHECKING:
    from dtsa_agent.air.driver import LiveAgent

SUMMARY = "summary"  # name in custom data
_FLUSH_S = 0.5
_CHUNK = 1 << 18  # bytes
_AT_A_TIME = 8  # slots: several at a time take half as long
_LONGEST_RECORD = 1 << 24  # bytes
_NAME = re.compile(r"cf\d+\.mcap")
_DAMAGE = (McapError, ZstdError, SerdeError, struct.error, EOFError, ValueError, KeyError, TypeError, AttributeError)
_DAMAGE += (AssertionError, IndexError)  # of rosbags, in a message that is none


# -- writing ---------------------------------------------------------------------------------------------------------
class RecordFile:
    """One file of slot records.

    When it cannot be written any more it keeps still, and ``failure`` says why: a full disk does not end a flight.

    :param custom: texts of its metadata.
    :raises BagError: if the file cannot be made.
    """

    def __init__(self, path: Path, swarm: SwarmConfig, custom: dict[str, str]) -> None:
        self.path, self.failure, self._count, self._times = path, "", 0, (0, 0)
        settings = {"swarm": swarm.to_dict(), "mode": REALTIME}
        self.custom = {
            "project": "dtsa", "version": __version__, FORMAT_KEY: FORMAT, "seed": str(swarm.seed),
            "configuration": json.dumps(settings, sort_keys=True), **custom,
        }  # fmt: skip
        self._definition = schema.installed(TYPE)
        try:
            self._stream = path.open("xb")
            self._mcap = Writer(self._stream, chunk_size=_CHUNK, compression=CompressionType.ZSTD)
            self._mcap.start(profile="ros2", library=f"dtsa {__version__}")
            self._add_metadata()
        except OSError as error:
            raise BagError(f"cannot record to {path}: {error.strerror or error}") from error
        channel = {
            "offered_qos_profiles": metadata.dump_profiles([metadata.PROFILES["reliable"]]),
            "topic_type_hash": self._definition.type_hash,
        }
        number = self._mcap.register_schema(TYPE, "ros2msg", self._definition.text.encode())
        self._channel = self._mcap.register_channel(SLOT_RECORD, "cdr", number, channel)
        self._next_flush = monotonic() + _FLUSH_S

    def _add_metadata(self) -> None:
        start_ns, end_ns = self._times
        content = {
            "version": metadata.VERSION, "storage_identifier": "mcap", "message_count": self._count,
            "starting_time": {"nanoseconds_since_epoch": start_ns}, "duration": {"nanoseconds": end_ns - start_ns},
            "compression_format": "", "compression_mode": "", "relative_file_paths": [self.path.name],
            "custom_data": self.custom, "ros_distro": "jazzy",
        }  # fmt: skip
        self._mcap.add_metadata(metadata.RECORD_NAME, {metadata.RECORD_KEY: metadata.dump(content)})

    def write(self, time_ns: int, data: bytes) -> None:
        """Record a message."""
        at = max(names.TIME_ZERO_NS, time_ns)
        self._times = (self._times[0] or at, at)
        self._try(lambda: self._mcap.add_message(self._channel, at, data, at, self._count))
        self._count += 1
        if monotonic() >= self._next_flush:
            self._next_flush = monotonic() + _FLUSH_S
            self._try(self._mcap.flush)

    def _try(self, act: Callable[[], object]) -> None:
        """Write, unless writing has failed before."""
        if self.failure:
            return
        try:
            act()
        except OSError as error:
            self.failure = f"recording to {self.path} stopped: {error.strerror or error}"

    def close(self) -> None:
        """Finish the file."""
        self._try(self._add_metadata)
        self._try(self._mcap.finish)
        self._try(self._stream.close)


class AgentRecorder:
    """The bag of one agent, written while it flies: a watcher of the agent.

    :param goals_told: the agent is told goals in flight, beside those of the scenario: none is known to be its last.
    :raises BagError: if the file cannot be made.
    """

    def __init__(
        self, path: Path, own: AgentSettings, config: SwarmConfig, port: PortSettings, goals_told: bool = False
    ) -> None:
        started = monotonic_ns() + own.clock_offset_ns  # own clock
        about = {
            "id": own.id, "started_ns": started, "zero_ns": started - names.TIME_ZERO_NS, "goals_told": goals_told,
            "own": own.to_dict(), "port": dataclasses.asdict(port.properties), "port_settings": port.to_dict(),
        }  # fmt: skip
        self._zero_ns: int = about["zero_ns"]
        self._id, self._config = own.id, config
        self._by = np.zeros((1, config.agents), np.bool_)
        self._by[0, own.id - 1] = True
        self._file = RecordFile(path, config, {AGENT: json.dumps(about, sort_keys=True)})
        self._slots: list[SlotRecord] = []  # not written yet
        self.summary: dict[str, Any] = {}  # of the agent; known at the end

    @property
    def failure(self) -> str:
        """Why nothing is recorded any more; empty: all is."""
        return self._file.failure

    def slot(self, record: SlotRecord) -> None:
        """A slot of the agent is over."""
        self._slots.append(record)
        if len(self._slots) >= _AT_A_TIME:
            self._write_slots()

    def refused(self, reason: str, data: bytes, arrival_ns: int) -> None:
        """A datagram has not been accepted: the agent's summary counts these."""

    def _write_slots(self) -> None:
        for record in self._slots:
            self._file.write(record.start_ns - self._zero_ns + names.TIME_ZERO_NS, self._pack(record))
        self._slots.clear()

    def _pack(self, record: SlotRecord) -> bytes:
        heard, zero_ns = [*record.before, *record.heard], record.start_ns
        is_sent = bool(record.datagram)
        sent = {self._id: record.datagram} if is_sent else {}
        return pack_record(
            self._config.auth_session or 1, record.slot, zero_ns - self._zero_ns + names.TIME_ZERO_NS,
            len(record.track), agent=[self._id], presence=[record.present | (NEW if record.is_first else 0)],
            chosen=[record.chosen], reason=[record.reason], digest=[record.digest], score=[record.score],
            offset_ns=[record.sent_ns - zero_ns if is_sent else 0], track=record.track, velocity=record.velocity,
            command=record.command, goal=record.goal, **frame_fields(sent, None),
            sent_ns=[record.sent_ns - zero_ns] * is_sent, lost=[0] * is_sent, collided=[0] * is_sent,
            heard_sender=[one.sender for one in heard], heard_slot=[one.slot for one in heard],
            heard_ns=[one.arrival_ns - zero_ns for one in heard],
            heard_by=np.frombuffer(pack_received(self._by) * len(heard), np.uint8),
            heard_before=[1] * len(record.before) + [0] * len(record.heard) if record.before else [],
            heard_length=[len(one.datagram) for one in heard],
            heard_data=np.frombuffer(b"".join(one.datagram for one in heard), np.uint8),
        )  # fmt: skip

    def finish(self, summary: dict[str, Any]) -> None:
        """The flight is over.

        :param summary: the agent's own.
        """
        self.summary = summary
        self._file.custom[SUMMARY] = json.dumps(summary)

    def __enter__(self) -> AgentRecorder:
        return self

    def __exit__(self, *unused: object) -> None:
        self._write_slots()
        self._file.close()


@contextmanager
def recorded(out: str, agent: LiveAgent, port: PortSettings) -> Iterator[AgentRecorder]:
    """The directory of an agent that flies within the context: its bag, and at the end ``summary.json``.

    It is an entry point, so that the agent's node finds it (``dtsa.recorders``).

    :param out: the directory; it is empty or does not exist yet.
    :raises ConfigError: for a directory that cannot be used.
    :raises BagError: if the bag cannot be made.
    """
    directory = new_directory(out)
    with AgentRecorder(directory / f"cf{agent.own.id}.mcap", agent.own, agent.config, port) as recorder:
        agent.watcher = recorder
        yield recorder
        recorder.finish(agent.summary())
    (directory / "summary.json").write_text(json.dumps(recorder.summary, indent=2) + "\n", encoding="utf-8")


# -- reading ---------------------------------------------------------------------------------------------------------
class NothingWritten(UnusableBag):
    """A process was started, and ended before it wrote anything."""


def find_bag(path: str | Path) -> Path:
    """The file of what was given as an agent's bag.

    :raises UnusableBag: if there is none, or several.
    :raises NothingWritten: for a directory without one.
    """
    given = Path(path)
    if not given.is_dir():
        if not given.is_file():
            raise UnusableBag(given, "there is no such file or directory")
        return given
    found = sorted(given.glob("*.mcap"))
    if not found:
        raise NothingWritten(given, "holds no .mcap file")
    if len(found) != 1:
        raise UnusableBag(given, f"holds {len(found)} .mcap files; name one")
    return found[0]


def read(path: str | Path) -> AgentBag:
    """The bag of an agent; of a file that was not finished, what is whole.

    :raises UnusableBag: if it is no bag of an agent on a network.
    :raises NothingWritten: if its process ended before it wrote anything.
    """
    file = find_bag(path)
    bag: AgentBag | None = None
    topics: dict[int, str] = {}
    unpack: Callable[[bytes], Any] | None = None
    is_finished = False
    try:
        if not file.stat().st_size:
            raise NothingWritten(file, "is empty")
        with file.open("rb") as stream:
            try:
                for record in StreamReader(stream, validate_crcs=True, record_size_limit=_LONGEST_RECORD).records:
                    if isinstance(record, Channel):
                        topics[record.id] = record.topic
                    elif isinstance(record, Schema) and record.name == TYPE:
                        unpack = record_codec(record.data.decode())
                    elif isinstance(record, Metadata) and record.name == metadata.RECORD_NAME:
                        bag = _read_about(file, record, bag)
                    elif isinstance(record, Message) and bag is not None and unpack is not None:
                        if topics.get(record.channel_id) == SLOT_RECORD:
                            _add_slot(bag, unpack(record.data))
                is_finished = True
            except UnusableBag:
                raise
            except _DAMAGE as error:
                if bag is None:
                    raise UnusableBag(file, f"not readable ({error})") from None
    except OSError as error:
        raise UnusableBag(file, error.strerror or str(error)) from None
    if bag is None:
        raise UnusableBag(file, f"no bag of an agent on a network, as `{program()} agent --out` makes them")
    bag.broken_off = bag.broken_off or not is_finished
    return bag


def find_bags(path: str | Path) -> list[Path]:
    """The agents' bags of a flight in a directory: `cf1.mcap`, ... in it, or each in a directory of its own.

    :returns: none if it is a flight's own directory, or something else.
    """
    given = Path(path)
    if not given.is_dir() or (given / "bag").is_dir() or (given / metadata.FILE_NAME).exists():
        return []
    found = [*given.glob("cf*.mcap"), *given.glob("*/cf*.mcap")]
    return sorted(file for file in found if _NAME.fullmatch(file.name))


def read_all(paths: Sequence[str | Path]) -> tuple[list[AgentBag], list[str]]:
    """The bags of a flight's agents, and, by path, the processes that wrote nothing.

    :raises UnusableBag: if one is no bag of an agent on a network, or the only one given is not written.
    """
    if len(paths) == 1:
        return [read(paths[0])], []
    bags: list[AgentBag] = []
    nothing: list[str] = []
    for path in paths:
        try:
            bags.append(read(path))
        except NothingWritten:
            nothing.append(str(path))
    return bags, nothing


def _read_about(file: Path, record: Metadata, bag: AgentBag | None) -> AgentBag | None:
    custom = metadata.custom_data(metadata.load(record.metadata.get(metadata.RECORD_KEY, "")))
    if AGENT not in custom:
        return bag
    try:
        about = json.loads(custom[AGENT])
        if bag is None:
            swarm = SwarmConfig.from_dict(json.loads(custom["configuration"])["swarm"])
            port = PortProperties(**about["port"])
            bag = AgentBag(
                file, int(about["id"]), swarm, port, int(about["started_ns"]),
                goals_told=bool(about["goals_told"]), zero_ns=int(about["zero_ns"]),
            )  # fmt: skip
        bag.broken_off = BROKEN_OFF in custom  # `recover` has made this file of one that was not finished
        bag.summary = json.loads(custom.get(SUMMARY, "{}"))
        bag.refused = Counter({str(why): int(count) for why, count in bag.summary.get("not_taken_in", {}).items()})
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        if isinstance(error, ConfigError):
            raise UnusableBag(file, f"its settings cannot be read ({error})") from None
        raise UnusableBag(file, f"what it says of its agent cannot be read ({error})") from None
    return bag


def _add_slot(bag: AgentBag, said: Any) -> None:
    """A record of the agent's own clock."""
    stamp = said.header.stamp
    start_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec) - names.TIME_ZERO_NS + bag.zero_ns
    (presence,), is_sent = said.presence.tolist(), len(said.sender) > 0
    frames = cut_frames(said.heard_data, said.heard_length, len(said.heard_sender))
    is_before = said.heard_before.tolist() or [0] * len(frames)
    columns = zip(said.heard_sender.tolist(), said.heard_slot.tolist(), said.heard_ns.tolist(), frames, strict=True)
    heard = [ReceivedFrame(sender, slot, start_ns + at_ns, data, True) for sender, slot, at_ns, data in columns]
    datagram = said.data.tobytes() if is_sent else b""
    frame = frame_in(datagram, bag.swarm)
    record = SlotRecord(
        int(said.slot), start_ns, start_ns, bool(presence & NEW), presence & ~NEW, int(said.chosen[0]),
        int(said.reason[0]), int(said.digest[0]), float(said.score[0]), said.track.reshape(-1, 3), said.velocity,
        said.command, said.goal, frame=frame[: len(frame) - (TAG_LENGTH if bag.swarm.auth else 0)],
        sent_ns=start_ns + int(said.sent_ns[0]) if is_sent else -1, datagram=datagram,
        before=[one for one, early in zip(heard, is_before, strict=True) if early],
        heard=[one for one, early in zip(heard, is_before, strict=True) if not early],
    )  # fmt: skip
    if bag.slots and record.slot <= bag.slots[-1].slot and not record.is_first:
        raise UnusableBag(bag.path, f"slot {record.slot} comes after slot {bag.slots[-1].slot}")
    bag.slots.append(record)
