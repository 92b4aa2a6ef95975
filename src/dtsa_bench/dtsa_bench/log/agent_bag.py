"""The bag that an agent on a network makes of its own flight: a file of slot records, written and read. Needs no ROS.

Times are those of the agent's own clock, moved so that its first is one second. Frames are whole datagrams here, those
of others that it heard among them. A file that was not finished is read as far as it is whole.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic_ns
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.air.port import PortProperties, PortSettings
from dtsa_agent.air.record import SlotRecord
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import DtsaError
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.cdr import ns_of, pack_received
from dtsa_bench.log.arrays import DECIDED, NEW, VECTORS, ReceivedFrames
from dtsa_bench.log.bag import metadata
from dtsa_bench.log.bag.errors import BagError, NothingWritten, UnusableBag
from dtsa_bench.log.bag.reader import Bag, BagMessage
from dtsa_bench.log.bag.recover import Recovery, recover
from dtsa_bench.log.bag.writer import BROKEN_OFF, KEY, BagDigest, BagWriter
from dtsa_bench.log.flight_log import FlightLog
from dtsa_bench.log.record import (
    AGENT,
    FORMAT,
    FORMAT_KEY,
    SLOT_RECORD,
    add_records,
    check_format,
    frame_fields,
    make_log,
    pack_record,
)
from dtsa_bench.runs.config import REALTIME
from dtsa_bench.runs.options import new_directory
from dtsa_bench.runs.program import program

if TYPE_CHECKING:
    from dtsa_agent.air.driver import LiveAgent

SUMMARY = "summary"  # name in custom data
_CHUNK = 1 << 18  # bytes
_MANY = 1000  # slots that an agent had no part in: those of a time that it has taken over are kept apart
_AT_A_TIME = 8  # slots: several at a time take half as long
_MOST_NS = 1 << 58  # of a clock, nine years: sums and differences of times fit into 64 bits
_MOST_OF_PORT = 10**12  # ns or bytes
_NAME = re.compile(r"cf\d+\.mcap")


@dataclass(slots=True)
class AgentBag:
    """What one agent recorded of itself."""

    path: Path
    agent: int  # id
    swarm: SwarmConfig
    port: PortProperties
    started_ns: int  # own clock, when its process began
    log: FlightLog  # one column, its own, as that of agent 1; times of its own clock; frames are whole datagrams
    earlier: list[FlightLog] = field(default_factory=list)  # of times that it gave up, unless for near larger numbers
    refused: Counter[str] = field(default_factory=Counter)  # datagrams not accepted, by reason
    summary: dict[str, Any] = field(default_factory=dict)  # its own; empty: it was killed
    broken_off: bool = False  # the file was not finished, or is damaged
    damage: str = ""  # why a finished file is not as it was finished; empty: it is
    goals_told: bool = False  # it was told goals in flight: none was known to be its last

    @property
    def slots(self) -> NDArray[np.int64]:
        """(R,) slots of which there is a record."""
        return np.flatnonzero(self.log.known) + self.log.first_slot

    @property
    def sent_ns(self) -> NDArray[np.int64]:
        """(F,) when each frame of the log was handed to the network."""
        row = self.log.sent_frames.row
        assert self.log.sent_ns is not None
        return self.log.start_ns[row] + self.log.sent_ns[row, 0]

    @property
    def heard(self) -> ReceivedFrames:
        """What the agent heard."""
        assert self.log.heard is not None
        return self.log.heard


# -- writing ---------------------------------------------------------------------------------------------------------
class RecordFile:
    """One file of slot records.

    When it cannot be written any more it keeps still, and ``failure`` says why: a full disk does not end a flight.

    :param custom: texts of its metadata.
    :raises BagError: if the file cannot be made.
    """

    def __init__(self, path: Path, swarm: SwarmConfig, custom: dict[str, str]) -> None:
        settings = {"swarm": swarm.to_dict(), "mode": REALTIME}
        self.failure = ""
        self._bag = BagWriter(path, settings, chunk_size=_CHUNK, custom_data={FORMAT_KEY: FORMAT, **custom})
        self._channel = add_records(self._bag)

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


class AgentRecorder(RecordFile):
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
        self._zero_ns = started - names.TIME_ZERO_NS
        about = {
            "id": own.id, "started_ns": started, "zero_ns": self._zero_ns, "goals_told": goals_told,
            "own": own.to_dict(), "port": dataclasses.asdict(port.properties), "port_settings": port.to_dict(),
        }  # fmt: skip
        super().__init__(path, config, {AGENT: json.dumps(about, sort_keys=True)})
        self._id, self._session = own.id, config.auth_session or 1
        self._by = pack_received(np.arange(1, config.agents + 1)[None] == own.id)
        self._slots: list[SlotRecord] = []  # not written yet
        self.summary: dict[str, Any] = {}  # of the agent; known at the end

    def slot(self, record: SlotRecord) -> None:
        """A slot of the agent is over."""
        self._slots.append(record)
        if len(self._slots) >= _AT_A_TIME:
            self._write_slots()

    def refused(self, reason: str, data: bytes, arrival_ns: int) -> None:
        """A datagram has not been accepted: the agent's summary counts these."""

    def _write_slots(self) -> None:
        for record in self._slots:
            at_ns = record.start_ns - self._zero_ns + names.TIME_ZERO_NS
            self.write(at_ns, self._pack(record, at_ns))
        self._slots.clear()

    def _pack(self, record: SlotRecord, at_ns: int) -> bytes:
        heard, count = [*record.before, *record.heard], int(bool(record.datagram))
        return pack_record(
            self._session, record.slot, at_ns, len(record.track), agent=[self._id],
            presence=[record.present | (NEW if record.is_first else 0)],
            **{name: getattr(record, name) for name in (*DECIDED, *VECTORS, "track")},
            offset_ns=[record.sent_ns - record.start_ns if count else 0],
            **frame_fields({self._id: record.datagram} if count else {}, None),
            sent_ns=[record.sent_ns - record.start_ns] * count, lost=[0] * count, collided=[0] * count,
            heard_sender=[one.sender for one in heard], heard_slot=[one.slot for one in heard],
            heard_ns=[one.arrival_ns - record.start_ns for one in heard],
            heard_by=np.frombuffer(self._by * len(heard), np.uint8),
            heard_before=[1] * len(record.before) + [0] * len(record.heard) if record.before else [],
            heard_length=[len(one.datagram) for one in heard],
            heard_data=np.frombuffer(b"".join(one.datagram for one in heard), np.uint8),
        )  # fmt: skip

    def finish(self, summary: dict[str, Any]) -> None:
        """The flight is over.

        :param summary: the agent's own.
        """
        self.summary = summary
        self._bag.custom_data[SUMMARY] = json.dumps(summary)

    def __enter__(self) -> AgentRecorder:
        return self

    def __exit__(self, *unused: object) -> None:
        self._write_slots()
        self.close()


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
    file = directory / "summary.json"
    try:
        file.write_text(json.dumps(recorder.summary, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        recorder.failure = recorder.failure or f"cannot write {file}: {error.strerror or error}"


# -- reading ---------------------------------------------------------------------------------------------------------
def find_bags(path: str | Path) -> list[Path]:
    """The agents' bags of a flight in a directory: `cf1.mcap`, ... in it, or each in a directory of its own.

    :returns: none if it is a flight's own directory, or something else.
    """
    given = Path(path)
    if not given.is_dir() or (given / "bag").is_dir() or (given / metadata.FILE_NAME).exists():
        return []
    return sorted(
        file for part in ("cf*.mcap", "*/cf*.mcap") for file in given.glob(part) if _NAME.fullmatch(file.name)
    )


def read_all(paths: Sequence[str | Path]) -> tuple[list[AgentBag], list[str]]:
    """The bags of a flight's agents, and, by path, the processes that wrote nothing.

    :raises UnusableBag: if one is no bag of an agent on a network, or the only one given is not written.
    """
    bags: list[AgentBag] = []
    nothing: list[str] = []
    for path in paths:
        try:
            bags.append(read(path))
        except NothingWritten:  # noqa: PERF203
            if len(paths) == 1:
                raise
            nothing.append(str(path))
    return bags, nothing


def read(path: str | Path) -> AgentBag:
    """The bag of an agent; of a file that was not finished, or is damaged, what is whole.

    :raises UnusableBag: if it is no bag of an agent on a network, or its messages are not those that were recorded.
    :raises NothingWritten: if its process ended before it wrote anything.
    :raises OSError: if the file is damaged, and there is no room for a copy of what can be read.
    """
    given = Path(path)
    if given.is_dir() and not any(given.glob("*.mcap*")):
        raise NothingWritten(given, "holds no .mcap file")
    file = metadata.find_files(given)[0]
    try:
        is_empty = not file.stat().st_size
    except OSError as error:
        raise UnusableBag(file, error.strerror or str(error)) from None
    if is_empty:
        raise NothingWritten(file, "is empty")
    try:
        with ExitStack() as stack:
            try:
                bag, damage = stack.enter_context(Bag(given)), ""
                messages = list(bag.messages())
            except UnusableBag as error:
                saved = _recover(given, file, stack)
                bag = stack.enter_context(Bag(saved.directory))
                damage = (saved.damaged or [error.reason])[0] if saved.has_end else ""
                messages = list(bag.messages())
            try:
                bag.check_files()
            except UnusableBag as error:
                damage = error.reason
            return _read_bag(file, bag, messages, damage)
    except UnusableBag as error:
        raise type(error)(file, error.reason) from None


def _recover(given: Path, file: Path, stack: ExitStack) -> Recovery:
    """What can be read of a damaged file, in a bag that is gone when the stack is closed.

    :raises OSError: if there is no room for it.
    """
    directory = Path(stack.enter_context(TemporaryDirectory()))
    try:
        return recover(given, directory / file.name)
    except BagError as error:
        if not isinstance(error.__cause__, OSError):
            raise
        number, why = error.__cause__.errno, f"{error.__cause__.strerror}, to copy what can be read of {file}"
        raise OSError(number, why, str(directory.parent)) from None


def _read_bag(file: Path, bag: Bag, messages: Sequence[BagMessage], damage: str) -> AgentBag:
    """The bag of the agent that a file's metadata describes.

    :param damage: of the file.
    """
    custom, digest = bag.custom_data, BagDigest()
    if AGENT not in custom:
        raise UnusableBag(file, f"no bag of an agent on a network, as `{program()} agent --out` makes them")
    if messages:
        check_format(bag)
    for message in messages:
        digest.add(*message)
    if custom.get(KEY, digest.hexdigest()) != digest.hexdigest():
        raise UnusableBag(file, "a message was changed, left out, added or moved after the recording")
    try:
        about, summary = metadata.load_json(custom[AGENT]), metadata.load_json(custom.get(SUMMARY, "{}"))
        swarm = SwarmConfig.from_dict(bag.config["swarm"])
        agent, started_ns = int(about["id"]), int(about["started_ns"])
        # As they were recorded: the clock of a vehicle that was switched off starts anew. Up to the first that is lost.
        own = sorted((one for one in messages if one.topic == SLOT_RECORD), key=lambda message: message.sequence)
        records = [bag.decode(message) for number, message in enumerate(own) if message.sequence == number]
        logs = [_log_of(part, file.stem, agent, swarm, about) for part in _split_times(records, swarm.slot_ns)]
        refused = Counter({str(why): int(count) for why, count in summary.get("not_taken_in", {}).items()})
        return AgentBag(
            file, agent, swarm, _port_of(about), started_ns, logs[-1], logs[:-1], refused, summary,
            BROKEN_OFF in custom, damage, bool(about["goals_told"]),
        )  # fmt: skip
    except (DtsaError, LookupError, ValueError, TypeError, AttributeError, OverflowError) as error:
        raise UnusableBag(file, f"what it says of its agent cannot be read ({error})") from None


def _port_of(about: Mapping[str, Any]) -> PortProperties:
    """The port of an agent; ValueError: a number of it is none that a port has."""
    port = PortProperties(**about["port"])
    for one in dataclasses.fields(port):
        value, default = getattr(port, one.name), one.default
        if isinstance(default, int) and (type(value) is not type(default) or not 0 <= value <= _MOST_OF_PORT):
            raise ValueError(f"port.{one.name} {value!r}")
    return port


def _split_times(records: Sequence[Any], slot_ns: int) -> list[list[Any]]:
    """The records of each time that an agent has taken over, the last one perhaps without any.

    A time with larger numbers goes on in the same log, with a row for each slot between, unless these are many.
    """
    times: list[list[Any]] = [[]]
    for record in records:
        if times[-1]:
            last, is_new = times[-1][-1], record.presence[0] & NEW
            slots = int(record.slot) - int(last.slot)
            if slots <= 0 and not is_new:
                raise ValueError(f"slot {record.slot} comes after slot {last.slot}")
            # After a stand-still it restarts, too, but its slots start where they would have.
            off_ns = ns_of(record.header.stamp) - ns_of(last.header.stamp) - slots * slot_ns
            if slots <= 0 or (slots > _MANY and is_new and 2 * abs(off_ns) > slot_ns):
                times.append([])
        times[-1].append(record)
    return times


def _log_of(records: Sequence[Any], name: str, agent: int, swarm: SwarmConfig, about: Mapping[str, Any]) -> FlightLog:
    """The log of an agent's records, with its own column alone, as that of agent 1, and times of its own clock."""
    for record in records:
        if len(record.agent) != 1 or len(record.presence) != 1:
            raise ValueError("not of one agent")
        record.agent, record.sender = np.ones_like(record.agent), np.ones_like(record.sender)
        by = pack_received(np.ones((len(record.heard_sender), 1), np.bool_))
        record.heard_by, record.received = np.frombuffer(by, np.uint8), record.received[:0]
    log = make_log(records, 1, swarm.slot_ns, False, name, {"swarm": swarm.to_dict(), "mode": REALTIME})
    assert log.heard is not None
    assert log.sent_ns is not None
    if len(log) and log.track.shape[1] != swarm.steps:
        raise ValueError(f"{log.track.shape[1]} control instants a slot, not {swarm.steps}")
    log.start_ns += int(about["zero_ns"])
    log.heard.time_ns[:] += int(about["zero_ns"])
    started_ns = np.array([int(about["started_ns"])], np.int64)
    times_ns = np.concatenate((started_ns, log.start_ns, log.sent_ns[:, 0], log.heard.time_ns))
    if times_ns.min() < -_MOST_NS or times_ns.max() > _MOST_NS:
        raise ValueError(f"times beyond {_MOST_NS} ns")
    if not (1 <= agent <= swarm.agents and np.isin(log.heard.sender, range(1, swarm.agents + 1)).all()):
        raise ValueError(f"ids of agents that are not among {swarm.agents}")
    return log
