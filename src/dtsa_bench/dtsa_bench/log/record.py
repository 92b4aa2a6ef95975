"""The record of a flight: messages `dtsa_msgs/SlotRecord` of a bag, written and read. Needs no ROS."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.cdr import SECOND, ns_of, pack_received, split_frames, unpack_received
from dtsa_bench.log.bag import schema
from dtsa_bench.log.bag.errors import UnusableBag
from dtsa_bench.log.bag.metadata import MERGED_FROM, RECOVERED_FROM
from dtsa_bench.log.bag.reader import Bag, register_type

from .arrays import DECIDED, PRESENT, UNKNOWN, VECTORS, ReceivedFrames, empty_arrays, split_log, swarm_section
from .flight_log import FlightLog

SLOT_RECORD, TYPE = f"{names.SWARM}/{names.SLOT_RECORD}", "dtsa_msgs/msg/SlotRecord"
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
def _store() -> Any:
    store = get_typestore(Stores.EMPTY)
    for kind in (TYPE, CONFIGURATION):
        register_type(store, kind, schema.installed(kind).text)
    return store


def _header(time_ns: int) -> Any:
    stamp = _store().types["builtin_interfaces/msg/Time"](*divmod(time_ns, SECOND))
    return _store().types[_HEADER](stamp, names.FRAME)


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
    """Whether a bag holds slot records, with the fields that they have here.

    :raises UnusableBag: if it does not.
    """
    if topic := bag.topics.get(SLOT_RECORD):
        bag.register(topic)
        for kind, found in ((TYPE, topic.type), (_HEADER, _HEADER)):
            (_, ours), (_, theirs) = _store().fielddefs[kind], bag.typestore.fielddefs.get(found, ((), ()))
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
    if not isinstance(agents, int) or not 0 < agents <= 65535:
        raise UnusableBag(bag.given, "its configuration does not say how many agents there are")
    slot_ns = round(float(slot_ms) * 1e6) if isinstance(slot_ms, (int, float)) and slot_ms > 0 else 10_000_000
    try:
        is_whole = merged is None and not {AGENT, SNIFFER} & set(bag.custom_data)
        log = make_log(list(records), agents, slot_ns, is_whole, _name(bag), settings)
        log.file, log.version, log.merged = bag.path, bag.custom_data.get("version", ""), merged
        if RECOVERED_FROM in bag.custom_data:
            log.notes.append("This bag was recovered: its recorder was killed or its file was damaged.")
        return log if merged is None else split_log(log, merged["common_slot"])
    except (ValueError, IndexError, TypeError) as error:
        raise UnusableBag(bag.given, f"its slot records do not fit together ({error})") from None


_LISTS = "missing", "broken_off", "not_on_the_time_line", "nothing_written", "not_determined", "processes"
_MERGED_KINDS = {"common_slot": int, "frames_heard_not_as_sent": int, **dict.fromkeys(_LISTS, list)}


def _merged(bag: Bag) -> dict[str, Any] | None:
    """What a bag was merged from; None: it was recorded in flight.

    :raises UnusableBag: if what it says of that cannot be read.
    """
    if MERGED_FROM not in bag.custom_data:
        return None
    try:
        about = json.loads(bag.custom_data[MERGED_FROM])
        wrong = [name for name, kind in _MERGED_KINDS.items() if not isinstance(about[name], kind)]
        wrong += [name for name in ("p50", "p99") if not isinstance(about["residual_us"][name], float)]
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


# Fields by agent or sender, whatever their other axes; those that may be empty.
_BY_AGENT = (*DECIDED, *VECTORS, "track", "offset_ns", "presence")
_BY_SENDER, _MAY_BE_EMPTY = ("length", "lost", "collided", "sent_ns"), {"offset_ns", "presence", "sent_ns"}


def make_log(
    records: Sequence[Any], agents: int, slot_ns: int, is_whole: bool, name: str, settings: dict[str, Any]
) -> FlightLog:
    """Put records into arrays.

    :raises ValueError: if they do not fit together.
    """
    slots = [int(record.slot) for record in records]
    first, last = 0 if is_whole else min(slots, default=0), max(slots, default=-1)
    if last - first > 2 * len(slots) + 1000 or len(set(slots)) < len(slots):
        raise ValueError("most slots are missing, or a number is damaged")
    # The last one of a flight says where all are at the end, and may say no more.
    has_end = is_whole and bool(slots)
    steps = max((int(record.steps) for record in records), default=1)
    arrays = empty_arrays(last - first + (not has_end), agents, steps, slot_ns)
    frames: dict[tuple[int, int], tuple[bytes, NDArray[np.uint8]]] = {}  # by row and sender: bytes, receivers
    nothing = np.zeros(0, np.int64)
    heard, heard_data = [(nothing, nothing, nothing, nothing, np.zeros((0, agents), np.uint8), nothing)], list[bytes]()
    for record, slot in zip(records, slots, strict=True):
        row, at, columns = slot - first, _columns(record.agent, agents), _columns(record.sender, agents)
        if has_end and slot == last:
            _fill(arrays, record, ("track",), row, at)
            continue
        arrays["recorded"][row], arrays["known"][row, at], arrays["presence"][row, at] = True, True, PRESENT
        arrays["outcome"][row] = min(int(record.outcome), UNKNOWN)
        arrays["start_ns"][row] = ns_of(record.header.stamp) - names.TIME_ZERO_NS
        _fill(arrays, record, _BY_AGENT, row, at)
        if len(columns):
            _fill(arrays, record, _BY_SENDER, row, columns)
            data = split_frames(record.data, record.length.tolist())
            masks = np.zeros((len(columns), agents), np.uint8)
            if len(record.received):  # else it is not known
                masks = unpack_received(record.received.tobytes(), len(columns), agents)
            for column, sent, mask in zip(columns.tolist(), data, masks, strict=True):
                if not sent:
                    raise ValueError(f"slot {slot}: an empty frame of cf{column + 1}")
                frames[row, column + 1] = sent, mask
        if count := len(record.heard_sender):
            before = record.heard_before if len(record.heard_before) else np.zeros(count, np.uint8)
            times_ns = record.heard_ns + arrays["start_ns"][row]
            by = unpack_received(record.heard_by.tobytes(), count, agents)
            heard.append((np.full(count, row), record.heard_sender, record.heard_slot, times_ns, by, before))
            lengths = record.heard_length.tolist() or [0] * count
            heard_data += split_frames(record.heard_data, lengths)
            if {len(values) for values in (*heard[-1], lengths)} != {count}:
                raise ValueError(f"slot {slot}: frames that were heard")
    keys = sorted(frames)
    received = np.array([frames[key][1] for key in keys], np.bool_).reshape(len(keys), agents)
    own_clocks = (
        settings.get("mode") == names.MODES[1]
        or len(heard) > 1
        or any(len(record.sent_ns) or len(record.offset_ns) for record in records)
    )
    presence, sent_ns = arrays.pop("presence"), arrays.pop("sent_ns")
    return FlightLog(
        name=name, settings=settings, agents=agents, slot_ns=slot_ns,
        data=b"".join([frames[key][0] for key in keys]), received=received, first_slot=first, has_end=has_end,
        presence=presence if any(len(record.presence) for record in records) else None,
        sent_ns=sent_ns if own_clocks else None,
        heard=_received_frames(heard, heard_data, frames, first) if own_clocks else None, **arrays,
    )  # fmt: skip


def _columns(ids: NDArray[np.uint16], agents: int) -> NDArray[np.intp]:
    """The columns of ascending ids."""
    index = np.asarray(ids, np.intp) - 1
    if len(index) and (index[0] < 0 or index[-1] >= agents or (np.diff(index) <= 0).any()):
        raise ValueError(f"ids {ids.tolist()}")
    return index


def _fill(arrays: dict[str, Any], record: Any, fields: Sequence[str], row: int, columns: NDArray[np.intp]) -> None:
    """Copy fields of a record into the row of a slot."""
    for name in fields:
        values, target = getattr(record, name), arrays[name][row]
        if len(values) or name not in _MAY_BE_EMPTY:
            at = slice(None) if len(columns) == target.shape[-1] else columns  # of all agents, which is faster
            target[..., at] = values.reshape(*target.shape[:-1], len(columns))


def _received_frames(
    heard: Sequence[Any], data: Sequence[bytes], frames: Mapping[tuple[int, int], Any], first: int
) -> ReceivedFrames:
    """The frames that agents took in; those without bytes of their own are as they were sent."""
    row, sender, slot, time_ns, by, before = (np.concatenate(column) for column in zip(*heard, strict=True))
    keys = zip((slot.astype(np.int64) - first).tolist(), sender.tolist(), strict=True)
    whole = [own or frames.get(key, (b"",))[0] for own, key in zip(data, keys, strict=True)]
    numbers = (values.astype(np.int64) for values in (row, sender, slot, time_ns))
    return ReceivedFrames(*numbers, by.astype(np.bool_), before.astype(np.bool_), whole)
