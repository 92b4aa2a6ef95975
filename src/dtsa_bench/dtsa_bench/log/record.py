"""The record of a flight: messages `dtsa_msgs/SlotRecord` of a bag, written and read. Needs no ROS."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import shown
from dtsa_agent.core.settings.config import MAX_AGENTS
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.cdr import SECOND, ns_of, pack_received, split_frames, unpack_received
from dtsa_bench.log.bag import schema
from dtsa_bench.log.bag.errors import UnusableBag
from dtsa_bench.log.bag.metadata import MERGED_FROM, RECOVERED_FROM, load_json
from dtsa_bench.log.bag.reader import Bag
from dtsa_bench.log.bag.writer import BagWriter

from .arrays import DECIDED, PRESENT, UNKNOWN, VECTORS, ReceivedFrames, empty_arrays, split_log, swarm_section
from .flight_log import FlightLog

SLOT_RECORD, TYPE = f"{names.SWARM}/{names.SLOT_RECORD}", "dtsa_msgs/msg/SlotRecord"
_STATUS = f"{names.SWARM}/{names.STATUS}"
CONFIGURATION = "dtsa_msgs/msg/Configuration"
_HEADER = "std_msgs/msg/Header"
FORMAT, FORMAT_KEY = "2", "format"  # of bags, and its name in custom data
AGENT, SNIFFER = "agent", "sniffer"  # custom data: what the record of one agent, or of a listener, says of itself
_OF_FORMAT_1 = {f"{names.SWARM}/{topic}" for topic in ("reception", "transmission", "decision")}
_KINDS = {
    "agent": "u2", "presence": "u1", "chosen": "u2", "reason": "u1", "digest": "u4", "score": "f8", "offset_ns": "i8",
    "track": "f8", "velocity": "f8", "command": "f8", "goal": "f8", "sender": "u2", "length": "u1", "data": "u1",
    "sent_ns": "i8", "received": "u1", "lost": "u2", "collided": "u2", "heard_sender": "u2", "heard_slot": "u4",
    "heard_ns": "i8", "heard_by": "u1", "heard_before": "u1", "heard_length": "u1", "heard_data": "u1",
}  # fmt: skip
_NOTHING = {name: np.zeros(0, kind) for name, kind in _KINDS.items()}


@cache
def _store(kind: str) -> Any:
    return schema.typestore_of(schema.installed(kind))


def _header(time_ns: int) -> Any:
    types = _store(TYPE).types
    return types[_HEADER](types["builtin_interfaces/msg/Time"](*divmod(time_ns, SECOND)), names.FRAME)


def pack_configuration(run: int, settings: Mapping[str, Any]) -> bytes:
    """A dtsa_msgs/Configuration as CDR."""
    text = json.dumps(settings, sort_keys=True)
    store = _store(CONFIGURATION)
    message = store.types[CONFIGURATION](_header(names.TIME_ZERO_NS), run, str(settings["mode"]), text)
    return bytes(store.serialize_cdr(message, CONFIGURATION))


def pack_record(run: int, slot: int, time_ns: int, steps: int, outcome: int = UNKNOWN, **fields: Any) -> bytes:
    """A SlotRecord as CDR.

    :param time_ns: ns, when the slot starts, by the clock of the record.
    :param fields: arrays of any shape in the message's order of elements; what is not given is empty.
    """
    arrays = {name: np.ascontiguousarray(values, _KINDS[name]).ravel() for name, values in fields.items()}
    head = {"header": _header(time_ns), "run": run, "slot": slot, "outcome": outcome, "steps": steps}
    store = _store(TYPE)
    return bytes(store.serialize_cdr(store.types[TYPE](**head, **_NOTHING | arrays), TYPE))


def add_records(bag: BagWriter) -> int:
    """The number of a new topic for slot records.

    To make the first record takes 20 ms: longer than slots in which an agent must go on. One is made here.
    """
    pack_record(0, 0, 0, 1)
    return bag.add_topic(SLOT_RECORD, TYPE)


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
    """Whether a bag holds slot records, with the fields that they have here.

    :raises UnusableBag: if it does not.
    """
    if topic := bag.topics.get(SLOT_RECORD):
        recorded = bag.typestore(SLOT_RECORD).fielddefs
        for kind, (_, ours) in _store(TYPE).fielddefs.items():
            _, theirs = recorded.get(topic.type if kind == TYPE else kind, ((), ()))
            if not dict(ours).items() <= dict(theirs).items():
                raise UnusableBag(bag.given, f"{SLOT_RECORD} is {topic.type}, without fields of this version's {kind}")
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
    if not isinstance(agents, int) or not 0 < agents <= MAX_AGENTS:
        raise UnusableBag(bag.given, f"its configuration says agents {shown(agents)}, not 1 to {MAX_AGENTS}")
    slot_ns = round(float(slot_ms) * 1e6) if isinstance(slot_ms, (int, float)) and 0 < slot_ms <= 1e6 else 10_000_000
    found = list(records)
    try:
        is_whole = merged is None and not {AGENT, SNIFFER} & set(bag.custom_data)
        log = make_log(found, agents, slot_ns, is_whole, _name(bag), settings)
        log.file, log.version, log.merged = bag.path, bag.custom_data.get("version", ""), merged
        if is_whole and log.heard is not None and not log.known.all():
            log.absent = _absent_agents(bag, log)
        if RECOVERED_FROM in bag.custom_data:
            log.notes.append("This bag was recovered: its recorder was killed or its file was damaged.")
        return log if merged is None else split_log(log, merged["common_slot"])
    except (ValueError, IndexError, TypeError, AttributeError, MemoryError) as error:  # fields of a foreign type
        raise UnusableBag(bag.given, f"its slot records do not fit together ({error})") from None


def _absent_agents(bag: Bag, log: FlightLog) -> NDArray[np.bool_]:
    """(S, N) agents that were not there, as the channel has told in flight.

    :raises ValueError: for ids of no agents.
    """
    absent = np.zeros_like(log.known)
    for _, status in bag.typed([_STATUS]):
        if status.phase == status.FLYING:
            if len(status.lost) and not 0 < status.lost.min() <= status.lost.max() <= log.agents:
                raise ValueError(f"lost agents {status.lost.tolist()}")
            absent[status.slot :] = False
            absent[status.slot :, status.lost.astype(np.int64) - 1] = True
    return absent


_GAVE_UP = "agents_that_gave_up_a_time"  # bags of earlier versions have none
_LISTS = "missing", "broken_off", "not_on_the_time_line", "nothing_written", "not_determined", "processes", _GAVE_UP
_MERGED_KINDS = {"common_slot": int, "frames_heard_not_as_sent": int, **dict.fromkeys(_LISTS, list)}


def _merged(bag: Bag) -> dict[str, Any] | None:
    """What a bag was merged from; None: it was recorded in flight.

    :raises UnusableBag: if what it says of that cannot be read.
    """
    if MERGED_FROM not in bag.custom_data:
        return None
    try:
        about = {_GAVE_UP: [], **load_json(bag.custom_data[MERGED_FROM])}
        wrong = [name for name, kind in _MERGED_KINDS.items() if not isinstance(about[name], kind)]
        wrong += [name for name in ("p50", "p99") if not isinstance(about["residual_us"][name], float)]
        if not all(isinstance(group, list) for group in about["not_determined"]):
            wrong.append("not_determined")
        if wrong or about["common_slot"] < 0:
            raise ValueError(", ".join(wrong) or "common_slot")
    except (ValueError, KeyError, TypeError) as error:
        raise UnusableBag(bag.given, f"what it says of the bags it was merged from cannot be read ({error})") from None
    return dict(about)


def _name(bag: Bag) -> str:
    """A name for the flight: that of its directory, where `fly` keeps the bag as `bag` beside the results."""
    if not bag.given.is_dir():
        return bag.path.stem
    directory = bag.path.resolve().parent
    return directory.parent.name if directory.name == "bag" else directory.name


# Fields by agent or sender, whatever their other axes; values of those that a record may leave out.
_BY_AGENT = (*DECIDED, *VECTORS, "track", "offset_ns", "presence")
_BY_SENDER = ("length", "lost", "collided", "sent_ns")
_LEFT_OUT = {"offset_ns": 0, "sent_ns": 0, "presence": PRESENT, "heard_before": 0}


def make_log(
    records: Sequence[Any], agents: int, slot_ns: int, is_whole: bool, name: str, settings: dict[str, Any]
) -> FlightLog:
    """Put records into arrays.

    :raises ValueError: if they do not fit together.
    """
    records = sorted(records, key=lambda record: int(record.slot))
    slots = np.array([record.slot for record in records], np.int64)
    first, last = (0 if is_whole or not records else int(slots[0])), int(slots.max(initial=-1))
    if (np.diff(slots) == 0).any():
        raise ValueError("a slot is there twice")
    own_clocks = settings.get("mode") == names.MODES[1] or any(
        len(values) for record in records for values in (record.sent_ns, record.offset_ns, record.heard_sender)
    )
    has_presence, has_end = any(len(record.presence) for record in records), is_whole and bool(records)
    steps = max((int(record.steps) for record in records), default=1)
    arrays = empty_arrays(last - first + (not has_end), len(slots), agents, steps, slot_ns)
    if has_end:  # the last one of a flight says where all are at the end, and may say no more
        _fill(arrays, [records.pop()], first, "agent", ("track",))
    rows = slots[: len(records)] - first
    arrays["recorded"][rows] = True
    arrays["outcome"][rows] = [min(int(record.outcome), UNKNOWN) for record in records]
    arrays["start_ns"][rows] = [ns_of(record.header.stamp) - names.TIME_ZERO_NS for record in records]
    arrays["known"][_fill(arrays, records, first, "agent", _BY_AGENT)] = True
    row, column = _fill(arrays, records, first, "sender", _BY_SENDER)
    data: list[bytes] = []
    received = np.zeros((len(row), agents), np.bool_)
    for record in records:
        at = len(data)
        data += split_frames(record.data, record.length.tolist())
        if len(record.received):  # else it is not known
            received[at : len(data)] = unpack_received(record.received.tobytes(), len(data) - at, agents)
    if not all(data):
        raise ValueError("an empty frame")
    frames = dict(zip(zip((row + first).tolist(), (column + 1).tolist(), strict=True), data, strict=True))
    heard = _heard_by(records, rows, arrays["start_ns"][rows], agents, frames) if own_clocks else None
    presence, sent_ns = arrays.pop("presence"), arrays.pop("sent_ns")
    return FlightLog(
        name=name, settings=settings, agents=agents, slot_ns=slot_ns, data=b"".join(data), received=received,
        first_slot=first, has_end=has_end, presence=presence if has_presence else None,
        sent_ns=sent_ns if own_clocks else None, heard=heard, **arrays,
    )  # fmt: skip


def _fill(
    arrays: dict[str, Any], records: Sequence[Any], first: int, by: str, fields: Sequence[str]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Copy fields of records, with an entry for each agent that the field `by` names.

    :param first: slot of the first row.
    :returns: rows and columns of the entries.
    """
    counts = np.array([len(getattr(record, by)) for record in records], np.int64)
    row = np.repeat(np.array([record.slot for record in records], np.int64) - first, counts)
    column = _column(records, by, counts).astype(np.int64) - 1
    agents = arrays["known"].shape[1]
    if len(column) and (column.min() < 0 or column.max() >= agents or (np.diff(row * agents + column) <= 0).any()):
        raise ValueError(f"ids that do not ascend from 1 to {agents}")
    for name in fields:
        arrays[name][row, ..., column] = _column(records, name, counts, arrays[name].shape[1:-1])
    return row, column


def _column(records: Sequence[Any], field: str, counts: NDArray[np.int64], shape: tuple[int, ...] = ()) -> NDArray[Any]:
    """The entries of a field, of some shape, of which records have so many."""
    parts = [np.zeros((*shape, 0), _KINDS[field])]
    for record, count in zip(records, counts.tolist(), strict=True):
        values = getattr(record, field)
        if not len(values) and field in _LEFT_OUT:
            values = np.full(count, _LEFT_OUT[field], _KINDS[field])
        parts.append(values.reshape(*shape, count))
    return np.moveaxis(np.concatenate(parts, axis=-1), -1, 0)


def _heard_by(
    records: Sequence[Any], rows: NDArray[np.int64], start_ns: NDArray[np.int64], agents: int,
    frames: Mapping[tuple[int, int], bytes],
) -> ReceivedFrames:  # fmt: skip
    """The frames that agents took in; those without bytes of their own are as they were sent: `frames`."""
    counts = np.array([len(record.heard_sender) for record in records], np.int64)
    sender, slot, late_ns, before = (
        _column(records, f"heard_{name}", counts) for name in ("sender", "slot", "ns", "before")
    )
    by, own = [np.zeros((0, agents), np.uint8)], list[bytes]()
    for record, count in zip(records, counts.tolist(), strict=True):
        by.append(unpack_received(record.heard_by.tobytes(), count, agents))
        lengths = record.heard_length.tolist() or [0] * count
        if len(lengths) != count:
            raise ValueError(f"slot {record.slot}: frames that were heard")
        own += split_frames(record.heard_data, lengths)
    keys = zip(slot.tolist(), sender.tolist(), strict=True)
    return ReceivedFrames(
        np.repeat(rows, counts), sender.astype(np.int64), slot.astype(np.int64), np.repeat(start_ns, counts) + late_ns,
        np.concatenate(by).astype(np.bool_), before.astype(np.bool_),
        [data or frames.get(key, b"") for data, key in zip(own, keys, strict=True)],
    )  # fmt: skip
