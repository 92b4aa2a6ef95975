"""The record of a flight: messages `dtsa_msgs/SlotRecord` of a bag, written and read. Needs no ROS."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.cdr import pack_received, unpack_received
from dtsa_bench.log.bag import schema
from dtsa_bench.log.bag.errors import UnusableBag
from dtsa_bench.log.bag.metadata import MERGED_FROM, RECOVERED_FROM
from dtsa_bench.log.bag.reader import Bag, register_type

from .arrays import DECIDED, PRESENT, UNKNOWN, VECTORS, ReceivedFrames, empty_arrays, split_log, swarm_section
from .flight_log import FlightLog

SLOT_RECORD, TYPE = f"{names.SWARM}/slot_record", "dtsa_msgs/msg/SlotRecord"
CONFIGURATION = "dtsa_msgs/msg/Configuration"
FORMAT, FORMAT_KEY = "2", "format"  # of bags, and its name in custom data
AGENT, SNIFFER = "agent", "sniffer"  # custom data: what the record of one agent, or of a listener, says of itself
_OF_FORMAT_1 = {f"{names.SWARM}/{topic}" for topic in (names.RECEPTION, names.TRANSMISSION, names.DECISION)}
_SECOND = 1_000_000_000
_KINDS = {
    "agent": "u2", "presence": "u1", "chosen": "u2", "reason": "u1", "digest": "u4", "score": "f8", "offset_ns": "i8",
    "track": "f8", "velocity": "f8", "command": "f8", "goal": "f8", "sender": "u2", "length": "u1", "data": "u1",
    "sent_ns": "i8", "received": "u1", "lost": "u2", "collided": "u2", "heard_sender": "u2", "heard_slot": "u4",
    "heard_ns": "i8", "heard_by": "u1", "heard_before": "u1", "heard_length": "u1", "heard_data": "u1",
}  # fmt: skip
_NOTHING = {name: np.zeros(0, kind) for name, kind in _KINDS.items()}


@cache
def _store() -> Any:
    store = get_typestore(Stores.EMPTY)
    for kind in (TYPE, CONFIGURATION):
        register_type(store, kind, schema.installed(kind).text)
    return store


def _header(time_ns: int) -> Any:
    stamp = _store().types["builtin_interfaces/msg/Time"](*divmod(time_ns, _SECOND))
    return _store().types["std_msgs/msg/Header"](stamp, names.FRAME)


def pack_configuration(run: int, settings: Mapping[str, Any]) -> bytes:
    """A dtsa_msgs/Configuration as CDR."""
    text = json.dumps(settings, sort_keys=True)
    message = _store().types[CONFIGURATION](_header(names.TIME_ZERO_NS), run, str(settings["mode"]), text)
    return bytes(_store().serialize_cdr(message, CONFIGURATION))


def pack_record(run: int, slot: int, time_ns: int, steps: int, outcome: int = UNKNOWN, **fields: Any) -> bytes:
    """A SlotRecord as CDR.

    :param time_ns: ns, when the slot starts, by the clock of the record.
    :param fields: arrays of any shape in the message's order of elements; what is not given is empty.
    """
    arrays = {name: np.ascontiguousarray(values, _KINDS[name]).ravel() for name, values in fields.items()}
    head = {"header": _header(time_ns), "run": run, "slot": slot, "outcome": outcome, "steps": steps}
    return bytes(_store().serialize_cdr(_store().types[TYPE](**head, **_NOTHING | arrays), TYPE))


def frame_fields(frames: Mapping[int, bytes], received: NDArray[np.bool_] | None) -> dict[str, Any]:
    """The fields of frames that were sent.

    :param frames: by the sender's id, ascending.
    :param received: (F, N) who received them; None: not known.
    """
    return {
        "sender": list(frames),
        "length": [len(data) for data in frames.values()],
        "data": np.frombuffer(b"".join(frames.values()), np.uint8),
        "received": [] if received is None or not frames else np.frombuffer(pack_received(received), np.uint8),
    }


# -- reading ---------------------------------------------------------------------------------------------------------
def load_log(source: Bag | str | Path) -> FlightLog:
    """The log of a recorded flight.

    :param source: run directory, bag directory or .mcap file; or an open bag.
    :raises UnusableBag: if it is no bag of this project, of another format, or its records do not fit together.
    """
    if not isinstance(source, Bag):
        with Bag(source) as bag:
            return load_log(bag)
    check_format(source)
    return build_log(source, (record for _, record in source.typed([SLOT_RECORD])))


def check_format(bag: Bag) -> None:
    """Whether a bag holds slot records.

    :raises UnusableBag: if it does not.
    """
    if SLOT_RECORD in bag.topics:
        return
    if _OF_FORMAT_1 & set(bag.topics):
        raise UnusableBag(bag.given, f"it has bag format 1, and this version reads format {FORMAT}: record it again")
    bag.config  # noqa: B018  says what is wrong with a foreign bag
    raise UnusableBag(bag.given, f"it has no {SLOT_RECORD}: no flight of a swarm")


def build_log(bag: Bag, records: Iterable[Any]) -> FlightLog:
    """The log that decoded records of a bag make.

    :raises UnusableBag: if they do not fit together.
    """
    settings = bag.config
    merged = _merged(bag)
    swarm = swarm_section(settings)
    agents, slot_ms = swarm.get("agents", 0), swarm.get("slot_ms", 10.0)
    if not isinstance(agents, int) or not 0 < agents <= 65535:
        raise UnusableBag(bag.given, "its configuration does not say how many agents there are")
    slot_ns = round(float(slot_ms) * 1e6) if isinstance(slot_ms, (int, float)) and slot_ms > 0 else 10_000_000
    found = list(records)
    try:
        is_whole = merged is None and not {AGENT, SNIFFER} & set(bag.custom_data)
        log = _Rows(found, agents, slot_ns, is_whole).log(_name(bag), settings)
    except (ValueError, IndexError, TypeError) as error:
        raise UnusableBag(bag.given, f"its slot records do not fit together ({error})") from None
    log.file, log.version = bag.path, bag.custom_data.get("version", "")
    if RECOVERED_FROM in bag.custom_data:
        log.notes.append("This bag was recovered: its recorder was killed or its file was damaged.")
    if merged is None:
        return log
    log.merged = merged
    try:
        return split_log(log, int(merged["common_slot"]))
    except ValueError as error:
        raise UnusableBag(bag.given, str(error)) from None


def _merged(bag: Bag) -> dict[str, Any] | None:
    """What a bag was merged from; None: it was recorded in flight.

    :raises UnusableBag: if what it says of that cannot be read.
    """
    if MERGED_FROM not in bag.custom_data:
        return None
    try:
        about = json.loads(bag.custom_data[MERGED_FROM])
        if not isinstance(about["common_slot"], int) or about["common_slot"] < 0:
            raise ValueError("common_slot")
        for key in ("missing", "broken_off", "not_on_the_time_line", "nothing_written", "not_determined", "processes"):
            if not isinstance(about[key], list):
                raise ValueError(key)
        if not all(isinstance(about["residual_us"][key], float) for key in ("p50", "p99")):
            raise ValueError("residual_us")
        if not isinstance(about["frames_heard_not_as_sent"], int):
            raise ValueError("frames_heard_not_as_sent")
    except (ValueError, KeyError, TypeError) as error:
        raise UnusableBag(bag.given, f"what it says of the bags it was merged from cannot be read ({error})") from None
    return dict(about)


def _name(bag: Bag) -> str:
    """A name for the flight: that of its directory, where `fly` keeps the bag as `bag` beside the results."""
    if not bag.given.is_dir():
        return bag.path.stem
    directory = bag.path.resolve().parent
    return directory.parent.name if directory.name == "bag" else directory.name


class _Rows:
    """Puts records into arrays.

    :raises ValueError: if they do not fit together.
    """

    def __init__(self, records: Sequence[Any], agents: int, slot_ns: int, is_whole: bool) -> None:
        slots = [int(record.slot) for record in records]
        self.agents, self.slot_ns = agents, slot_ns
        self._first = 0 if is_whole else min(slots, default=0)
        last = max(slots, default=-1)
        if last - self._first > 2 * len(slots) + 1000 or len(set(slots)) < len(slots):
            raise ValueError("most slots are missing, or a number is damaged")
        end = None
        if records and is_whole:  # the last one says where all are at the end, and may say no more
            end = max(records, key=lambda record: int(record.slot))
        steps = max((int(record.steps) for record in records), default=1)
        self._arrays = empty_arrays(last - self._first + (end is None), agents, steps, slot_ns)
        self._frames: dict[tuple[int, int], bytes] = {}  # by row and sender
        self._received: dict[tuple[int, int], NDArray[np.bool_]] = {}
        self._heard: list[tuple[int, int, int, int, NDArray[np.bool_], bool, bytes]] = []
        self._has_presence = self._own_clocks = False
        told = [record for record in records if record is not end]
        everybody = np.arange(1, agents + 1)
        whole = [record for record in told if np.array_equal(record.agent, everybody)]
        self._add_accounts(whole, slice(None))
        for record in told:
            if not np.array_equal(record.agent, everybody):
                self._add_accounts([record], self._columns(record))
            row = int(record.slot) - self._first
            self._add_frames(record, row)
            self._add_received(record, row)
        if end is not None:
            self._end(end)
        self.has_end = end is not None

    def _columns(self, record: Any) -> NDArray[np.intp]:
        index = np.asarray(record.agent, np.intp) - 1
        if len(index) and (index[0] < 0 or index[-1] >= self.agents or (np.diff(index) <= 0).any()):
            raise ValueError(f"slot {record.slot}: agents {record.agent.tolist()}")
        return index

    def _end(self, record: Any) -> None:
        at = self._columns(record)
        track = self._arrays["track"]
        track[int(record.slot) - self._first][:, :, at] = record.track.reshape(track.shape[1], 3, len(at))

    def _add_accounts(self, records: Sequence[Any], at: Any) -> None:
        """What agents, in these columns, told of slots."""
        if not records:
            return
        arrays, count, steps = self._arrays, len(records[0].agent), self._arrays["track"].shape[1]
        rows = np.array([int(record.slot) - self._first for record in records])

        def fill(name: str, shape: tuple[int, ...], index: Any) -> None:
            size = math.prod(shape)
            values = [getattr(record, name) for record in records]
            for record, found in zip(records, values, strict=True):
                if len(found) != size:
                    raise ValueError(f"slot {record.slot}: {len(found)} entries in {name}, {count} agents")
            arrays[name][index] = np.concatenate(values).reshape(len(rows), *shape)

        own = (rows, at) if isinstance(at, slice) else (rows[:, None], at)
        arrays["recorded"][rows], arrays["known"][own] = True, True
        arrays["outcome"][rows] = [min(int(record.outcome), UNKNOWN) for record in records]
        stamps = [(int(record.header.stamp.sec), int(record.header.stamp.nanosec)) for record in records]
        arrays["start_ns"][rows] = [sec * _SECOND + ns - names.TIME_ZERO_NS for sec, ns in stamps]
        for name in DECIDED:
            fill(name, (count,), own)
        planes = (rows, slice(None), at) if isinstance(at, slice) else (rows[:, None, None], np.arange(3)[:, None], at)
        for name in VECTORS:
            fill(name, (3, count), planes)
        for row, record in zip(rows.tolist(), records, strict=True):
            arrays["track"][row][:, :, at] = record.track.reshape(steps, 3, count)
            if len(record.offset_ns):
                arrays["offset_ns"][row, at] = record.offset_ns
            arrays["presence"][row, at] = record.presence if len(record.presence) else PRESENT
            self._has_presence = self._has_presence or len(record.presence) > 0

    def _add_frames(self, record: Any, row: int) -> None:
        arrays, senders = self._arrays, record.sender.tolist()
        if senders != sorted(set(senders)) or (senders and not 1 <= senders[0] <= senders[-1] <= self.agents):
            raise ValueError(f"slot {record.slot}: senders {senders}")
        frames = cut_frames(record.data, record.length, len(senders))
        columns = np.array(senders, np.intp) - 1
        for name in ("lost", "collided"):
            arrays[name][row, columns] = getattr(record, name)
        arrays["length"][row, columns] = record.length
        if len(record.sent_ns):
            self._own_clocks = True
            arrays["sent_ns"][row, columns] = record.sent_ns
        received = np.zeros((len(senders), self.agents), np.bool_)
        if len(record.received):
            received[:] = unpack_received(record.received.tobytes(), len(senders), self.agents)
        for sender, data, mask in zip(senders, frames, received, strict=True):
            if not data:
                raise ValueError(f"slot {record.slot}: an empty frame of cf{sender}")
            self._frames[row, sender], self._received[row, sender] = data, mask

    def _add_received(self, record: Any, row: int) -> None:
        count = len(record.heard_sender)
        self._own_clocks = self._own_clocks or count > 0 or len(record.offset_ns) > 0
        if not count:
            return
        by = unpack_received(record.heard_by.tobytes(), count, self.agents).astype(np.bool_)
        before = record.heard_before if len(record.heard_before) else np.zeros(count, np.uint8)
        data = cut_frames(record.heard_data, record.heard_length, count) if len(record.heard_length) else [b""] * count
        times = (record.heard_ns + self._arrays["start_ns"][row]).tolist()
        columns = record.heard_sender.tolist(), record.heard_slot.tolist(), times, by, before.tolist(), data
        for sender, slot, time_ns, mask, early, frame in zip(*columns, strict=True):
            self._heard.append((row, sender, slot, time_ns, mask, bool(early), frame))

    def log(self, name: str, settings: dict[str, Any]) -> FlightLog:
        """The log."""
        arrays, keys = self._arrays, sorted(self._frames)
        received = np.array([self._received[key] for key in keys], np.bool_).reshape(len(keys), self.agents)
        self._own_clocks = self._own_clocks or settings.get("mode") == names.MODES[1]
        heard = self._received_frames() if self._own_clocks else None
        presence, sent_ns = arrays.pop("presence"), arrays.pop("sent_ns")
        return FlightLog(
            name=name, settings=settings, agents=self.agents, slot_ns=self.slot_ns,
            data=b"".join([self._frames[key] for key in keys]), received=received, heard=heard,
            presence=presence if self._has_presence else None, sent_ns=sent_ns if self._own_clocks else None,
            first_slot=self._first, has_end=self.has_end, **arrays,
        )  # fmt: skip

    def _received_frames(self) -> ReceivedFrames:
        frames = [
            data or self._frames.get((slot - self._first, sender), b"")
            for _, sender, slot, _, _, _, data in self._heard
        ]
        columns = list(zip(*self._heard, strict=True)) if self._heard else [()] * 7
        numbers = [np.array(column, np.int64) for column in columns[:4]]
        by = np.array(columns[4], np.bool_).reshape(len(frames), self.agents)
        return ReceivedFrames(*numbers, by, np.array(columns[5], np.bool_), frames)


def cut_frames(data: NDArray[np.uint8], lengths: NDArray[np.uint8], count: int) -> list[bytes]:
    """Frames that lie one after the other."""
    if len(lengths) != count or int(lengths.sum(dtype=np.int64)) != len(data):
        raise ValueError(f"{len(data)} bytes of {count} frames")
    ends = np.cumsum(lengths, dtype=np.int64).tolist()
    whole = data.tobytes()
    return [whole[end - int(length) : end] for end, length in zip(ends, lengths, strict=True)]
