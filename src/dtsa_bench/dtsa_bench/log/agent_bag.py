"""The bag that an agent on a network makes of its own flight: a file of slot records, written and read. Needs no ROS.

Times are those of the agent's own clock, moved so that its first is one second. Frames are whole datagrams here, those
of others that it heard among them. A file that was not finished is read as far as it is whole.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic_ns
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.records import Channel, Message, Metadata, Schema
from rosbags.typesys import Stores, get_typestore

from dtsa_agent.air.port import PortProperties, PortSettings, flight_ns, frame_in
from dtsa_agent.air.record import ReceivedFrame, SlotRecord
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.frame import TAG_LENGTH
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.cdr import pack_received, split_frames
from dtsa_bench.log.arrays import NEW
from dtsa_bench.log.bag import metadata
from dtsa_bench.log.bag.errors import BagError, UnusableBag
from dtsa_bench.log.bag.reader import NOT_OF_ITS_TYPE, checksum_fault, register_type, shared_typestore
from dtsa_bench.log.bag.recover import RecordScan
from dtsa_bench.log.bag.writer import BROKEN_OFF, KEY, BagDigest, BagWriter
from dtsa_bench.log.record import (
    AGENT,
    FORMAT,
    FORMAT_KEY,
    SLOT_RECORD,
    TYPE,
    frame_fields,
    pack_record,
)
from dtsa_bench.runs.config import REALTIME
from dtsa_bench.runs.options import new_directory
from dtsa_bench.runs.program import program

if TYPE_CHECKING:
    from dtsa_agent.air.driver import LiveAgent

SUMMARY = "summary"  # name in custom data
_CHUNK = 1 << 18  # bytes
_AT_A_TIME = 8  # slots: several at a time take half as long
_NAME = re.compile(r"cf\d+\.mcap")


@dataclass(slots=True)
class AgentBag:
    """What one agent recorded of itself."""

    path: Path
    agent: int  # id
    swarm: SwarmConfig
    port: PortProperties
    started_ns: int  # own clock, when its process began
    slots: list[SlotRecord] = field(default_factory=list)  # ascending, but where it took over another time
    refused: Counter[str] = field(default_factory=Counter)  # datagrams not accepted, by reason
    summary: dict[str, Any] = field(default_factory=dict)  # its own; empty: it was killed
    broken_off: bool = False  # the file was not finished, or is damaged
    damage: str = ""  # why a finished file is not as it was finished; empty: it is
    goals_told: bool = False  # it was told goals in flight: none was known to be its last
    zero_ns: int = 0  # what its clock showed at time 0 of the bag

    @property
    def flight_ns(self) -> int:
        """From the order to send a frame to its arrival as the agents take it to be, ns."""
        return flight_ns(self.swarm, self.port)


# -- writing ---------------------------------------------------------------------------------------------------------
class RecordFile:
    """One file of slot records.

    When it cannot be written any more it keeps still, and ``failure`` says why: a full disk does not end a flight.

    :param custom: texts of its metadata.
    :raises BagError: if the file cannot be made.
    """

    def __init__(self, path: Path, swarm: SwarmConfig, custom: dict[str, str]) -> None:
        settings = {"swarm": swarm.to_dict(), "mode": REALTIME}
        self.path, self.failure = path, ""
        self._bag = BagWriter(path, settings, chunk_size=_CHUNK, custom_data={FORMAT_KEY: FORMAT, **custom})
        self._channel = self._bag.add_topic(SLOT_RECORD, TYPE)
        self.custom = self._bag.custom_data

    def write(self, time_ns: int, data: bytes) -> None:
        """Record a message."""
        at_ns = max(names.TIME_ZERO_NS, time_ns)
        self._try(lambda: self._bag.write(self._channel, data, at_ns, at_ns))

    def _try(self, act: Callable[[], object]) -> None:
        """Write, unless writing has failed before."""
        if self.failure:
            return
        try:
            act()
        except BagError as error:
            self.failure = str(error)

    def close(self) -> None:
        """Finish the file."""
        self._try(self._bag.close)


class AgentRecorder:
    """The bag of one agent, written while it flies: a watcher of the agent.

    :param goals_told: the agent is told goals in flight, beside those of the scenario: none is known to be its last.
    :param started_ns: when the agent began, by its own clock; None: now.
    :raises BagError: if the file cannot be made.
    """

    def __init__(
        self, path: Path, own: AgentSettings, config: SwarmConfig, port: PortSettings, goals_told: bool = False,
        started_ns: int | None = None,
    ) -> None:  # fmt: skip
        started = monotonic_ns() + own.clock_offset_ns if started_ns is None else started_ns
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
    """The bag of an agent; of a file that was not finished, or is damaged, what is whole.

    :raises UnusableBag: if it is no bag of an agent on a network, or its messages are not those that were recorded.
    :raises NothingWritten: if its process ended before it wrote anything.
    """
    file = find_bag(path)
    try:
        if not file.stat().st_size:
            raise NothingWritten(file, "is empty")
    except OSError as error:
        raise UnusableBag(file, error.strerror or str(error)) from None
    reader = _Reader(file)
    with ExitStack() as stack:
        scan = RecordScan(file, path, stack)
        for record in scan.records():
            if scan.faults or not reader.add(record):
                break
    if reader.bag is None:
        why = f"not readable ({scan.faults[0]})" if scan.faults else (
            f"no bag of an agent on a network, as `{program()} agent --out` makes them")  # fmt: skip
        raise UnusableBag(file, why)
    bag = reader.finish(scan.is_finished and not scan.faults)
    if scan.is_finished or scan.is_closed:
        bag.damage = scan.faults[0] if scan.faults else checksum_fault(file)
    return bag


class _Reader:
    """Makes the bag of an agent of the records of its file."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self.bag: AgentBag | None = None
        self._channel = 0  # of the slot records
        self._store = get_typestore(Stores.EMPTY)
        self._custom: dict[str, str] = {}
        self._digest = BagDigest()

    def add(self, record: Any) -> bool:
        """Add a record of the file; return whether it can be used: what follows one that cannot is left out."""
        try:
            self._add(record)
        except UnusableBag:
            raise
        except NOT_OF_ITS_TYPE:
            return False
        return True

    def _add(self, record: Any) -> None:
        if isinstance(record, Channel) and record.topic == SLOT_RECORD:
            self._channel = record.id
        elif isinstance(record, Schema) and record.name == TYPE:
            definition = record.data.decode()
            self._store = shared_typestore(frozenset({(TYPE, definition)}))
            register_type(self._store, TYPE, definition)
        elif isinstance(record, Metadata) and record.name == metadata.RECORD_NAME:
            custom = metadata.custom_data(metadata.load_record(record))
            self._custom |= custom if AGENT in custom else {}
            self.bag = self.bag or (_make_bag(self._file, custom) if AGENT in custom else None)
        elif isinstance(record, Message) and record.channel_id == self._channel and self.bag:
            times = record.log_time, record.publish_time, record.sequence
            self._digest.add(SLOT_RECORD.encode(), *times, record.data, True)
            _add_slot(self.bag, self._store.deserialize_cdr(record.data, TYPE))

    def finish(self, is_finished: bool) -> AgentBag:
        """The bag, when all that is whole has been added."""
        bag, custom = self.bag, self._custom
        assert bag is not None
        if is_finished and KEY in custom and custom[KEY] != self._digest.hexdigest():
            raise UnusableBag(self._file, "a message was changed, left out, added or moved after the recording")
        bag.broken_off = not is_finished
        try:
            if BROKEN_OFF in custom:  # `recover` has made this file of one that was not finished, or is damaged
                bag.broken_off, whole_ns = True, int(custom[BROKEN_OFF])
                bag.slots = [one for one in bag.slots if one.start_ns - bag.zero_ns + names.TIME_ZERO_NS <= whole_ns]
            bag.summary = json.loads(custom.get(SUMMARY, "{}"))
            refused = bag.summary.get("not_taken_in", {}).items()
            bag.refused = Counter({str(why): int(count) for why, count in refused})
        except (ValueError, TypeError, AttributeError) as error:
            raise UnusableBag(self._file, f"what it says of its agent cannot be read ({error})") from None
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


def _make_bag(file: Path, custom: dict[str, str]) -> AgentBag:
    """The bag of the agent that a file's metadata describes."""
    try:
        about = json.loads(custom[AGENT])
        return AgentBag(
            file, int(about["id"]), SwarmConfig.from_dict(json.loads(custom["configuration"])["swarm"]),
            PortProperties(**about["port"]), int(about["started_ns"]), goals_told=bool(about["goals_told"]),
            zero_ns=int(about["zero_ns"]),
        )  # fmt: skip
    except ConfigError as error:
        raise UnusableBag(file, f"its settings cannot be read ({error})") from None
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise UnusableBag(file, f"what it says of its agent cannot be read ({error})") from None


def _add_slot(bag: AgentBag, message: Any) -> None:
    """A record of the agent's own clock."""
    stamp = message.header.stamp
    start_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec) - names.TIME_ZERO_NS + bag.zero_ns
    (presence,), is_sent = message.presence.tolist(), len(message.sender) > 0
    frames = split_frames(message.heard_data, message.heard_length.tolist())
    is_before = message.heard_before.tolist() or [0] * len(frames)
    columns = zip(message.heard_sender.tolist(), message.heard_slot.tolist(), message.heard_ns.tolist(), frames, strict=True)
    heard = [ReceivedFrame(sender, slot, start_ns + at_ns, data, True) for sender, slot, at_ns, data in columns]
    datagram = message.data.tobytes() if is_sent else b""
    frame = frame_in(datagram, bag.swarm)
    record = SlotRecord(
        int(message.slot), start_ns, start_ns, bool(presence & NEW), presence & ~NEW, int(message.chosen[0]),
        int(message.reason[0]), int(message.digest[0]), float(message.score[0]), message.track.reshape(-1, 3), message.velocity,
        message.command, message.goal, frame=frame[: len(frame) - (TAG_LENGTH if bag.swarm.auth else 0)],
        sent_ns=start_ns + int(message.sent_ns[0]) if is_sent else -1, datagram=datagram,
        before=[one for one, early in zip(heard, is_before, strict=True) if early],
        heard=[one for one, early in zip(heard, is_before, strict=True) if not early],
    )  # fmt: skip
    if bag.slots and record.slot <= bag.slots[-1].slot and not record.is_first:
        raise UnusableBag(bag.path, f"slot {record.slot} comes after slot {bag.slots[-1].slot}")
    bag.slots.append(record)
