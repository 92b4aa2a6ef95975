"""A recorded run as arrays: what the report and the export start from."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.frame import EXTENT_M
from dtsa_bench.runs.config import RunConfig

from .errors import UnusableBag
from .merged import MergedFrom, merged_from
from .reader import Bag

SLOT, TRANSMISSION, RECEPTION, DECISION = (
    "/swarm/slot",
    "/swarm/transmission",
    "/swarm/reception",
    "/swarm/decision",
)
ODOMETRY = re.compile(r"^/cf(\d+)/odom$")
OUTCOMES = ("idle", "success", "collision")
_PLACE = tuple(f"pose.pose.position.{axis}" for axis in "xyz")
_SPEED = tuple(f"twist.twist.linear.{axis}" for axis in "xyz")
_FIELD_NAMES = """slot outcome sender received lost collided agent chosen reason_name reason_index score digest
    length data steps track velocity header.stamp.sec header.stamp.nanosec"""
_FIELDS = frozenset((*_FIELD_NAMES.split(), *_PLACE, *_SPEED))
_OFFSET_NS = 1_000_000_000  # simulated time of slot 0, where a bag has no slot messages

_MOST_HOLES = 5  # that are named

Columns = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Frames:
    """All frames that were sent, in order; arrays have one row a frame."""

    slot: NDArray[np.int64]
    sender: NDArray[np.int64]  # ids
    data: list[bytes]  # as sent; empty where the bag holds no transmissions
    received: NDArray[np.bool_]  # (F, N) by id - 1
    lost: NDArray[np.int64]  # receivers that lost it to noise
    collided: NDArray[np.int64]  # receivers at which it collided


@dataclass(frozen=True, slots=True)
class Decisions:
    """What every agent decided in every slot; arrays are (D, n)."""

    slot: NDArray[np.int64]  # (D,)
    agent: NDArray[np.int64]  # ids; 0: nothing is known of who would stand here
    chosen: NDArray[np.int64]  # ids, 0: nobody
    reason: NDArray[np.int64]  # index into `names`
    score: NDArray[np.float64]
    digest: NDArray[np.uint32]
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Motion:
    """Where the agents were; rows are the moments at which all that was recorded."""

    ids: NDArray[np.int64]  # (N,)
    time_ns: NDArray[np.int64]  # (T,) simulated time
    position: NDArray[np.float64]  # m, (T, 3, N), frame map; NaN where an agent was not recorded yet
    velocity: NDArray[np.float64]  # m/s, (T, 3, N)


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """One run."""

    name: str
    config: dict[str, Any]
    agents: int
    slot_ns: int
    start_ns: int  # simulated time at which slot 0 starts
    slots: NDArray[np.int64]  # (M,) slots that the channel judged
    outcome: NDArray[np.int64]  # (M,) index into OUTCOMES
    frames: Frames
    decisions: Decisions
    motion: Motion
    merged: MergedFrom | None = None  # what the bag was merged from, if it was: its slots count from a common one
    told: NDArray[np.bool_] | None = None  # (M, N) merged: of whom there is a record in a slot; None: of all

    @property
    def known_receivers(self) -> NDArray[np.int64]:
        """(F,) other agents of which is known whether they received a frame."""
        if self.told is None:
            return np.full(len(self.frames.slot), max(0, self.agents - 1), np.int64)
        return np.asarray(self.frames.received.sum(axis=1) + self.frames.lost, np.int64)

    @property
    def outcome_known(self) -> NDArray[np.bool_]:
        """(M,) whether a slot's outcome is known: not where nobody is known to have sent, and not all have told."""
        if self.told is None:
            return np.ones(len(self.slots), np.bool_)
        return np.asarray((self.outcome != OUTCOMES.index("idle")) | self.told.all(axis=1), np.bool_)

    @property
    def missing(self) -> str:
        """Slots and agents that the bag does not have between its first and its last; empty: none."""
        holes = missing_slots(self.slots)
        absent = sorted(set(range(1, self.agents + 1)) - set(self.motion.ids.tolist()))
        parts = (holes and f"{holes}", absent and f"the motion of {', '.join(f'cf{agent}' for agent in absent)}")
        return " and ".join(str(part) for part in parts if part)

    def time_s(self, slot: NDArray[np.int64]) -> NDArray[np.float64]:
        """Seconds from the start of slot 0 to the start of a slot."""
        return np.asarray(slot * (self.slot_ns / 1e9), dtype=np.float64)


def missing_slots(slots: NDArray[np.int64]) -> str:
    """The holes in slots that should count from 0, as "slots 158 to 313"; empty: there are none.

    :param slots: (M,) numbers of slots, ascending.
    """
    known = np.concatenate(([-1], slots))
    holes = [(int(known[k]) + 1, int(known[k + 1]) - 1) for k in np.flatnonzero(np.diff(known) > 1)]
    words = [f"{first} to {last}" if first < last else f"{first}" for first, last in holes[:_MOST_HOLES]]
    more = f" and {len(holes) - _MOST_HOLES} holes more" if len(holes) > _MOST_HOLES else ""
    return f"slots {', '.join(words)}{more}" if holes else ""


def load_run(source: Bag | str | Path) -> RecordedRun:
    """Read a whole run.

    :param source: run directory, bag directory or .mcap file; or an open bag.
    :raises UnusableBag: if it is no bag of this project: it holds no configuration, or neither receptions nor odometry.
    """
    if isinstance(source, Bag):
        return _load(source)
    with Bag(source) as bag:
        return _load(bag)


def _load(bag: Bag) -> RecordedRun:
    config = bag.config
    odometry = sorted((int(m[1]), name) for name in bag.topics if (m := ODOMETRY.match(name)))
    wanted = [name for name in (RECEPTION, DECISION, TRANSMISSION) if name in bag.topics]
    if RECEPTION not in bag.topics and not odometry:
        raise UnusableBag(bag.given, f"it has neither {RECEPTION} nor odometry: no run of a swarm")
    tables = bag.tables(wanted, _FIELDS)
    merged = merged_from(bag)
    if merged is not None:
        tables = {name: _counted_from(merged.first, table) for name, table in tables.items()}
    slot_ns = _slot_ns(config)
    agents = max([_agents(config), *(number for number, _ in odometry)])
    reception, transmission = (tables.get(name, {}) for name in (RECEPTION, TRANSMISSION))
    start_ns = _start_ns(reception, slot_ns)
    motion = _tracks(transmission, agents, start_ns, slot_ns, merged is not None)
    if motion is None and merged is not None:
        raise UnusableBag(bag.given, "its transmissions do not fit together")
    if motion is None:
        told = bag.tables([name for _, name in odometry], _FIELDS)
        motion = _motion([(number, told[name]) for number, name in odometry])
    slots, outcome = _outcomes(reception)
    return RecordedRun(
        _name(bag),
        config,
        agents,
        slot_ns,
        start_ns,
        slots,
        outcome,
        _frames(reception, transmission, agents),
        _decisions(tables.get(DECISION, {})),
        motion,
        merged,
        None if merged is None else _told(slots, transmission, agents),
    )


def _counted_from(first: int, table: Columns) -> Columns:
    """Slots counted from a slot."""
    return {**table, "slot": np.asarray(table["slot"], np.int64) - first}


def _told(slots: NDArray[np.int64], transmission: Columns, agents: int) -> NDArray[np.bool_]:
    """(M, N) of whom there is a record in a slot."""
    told = np.zeros((len(slots), agents), np.bool_)
    places = {int(slot): place for place, slot in enumerate(slots)}
    for slot, ids in zip(*(transmission.get(name, ()) for name in ("slot", "agent")), strict=True):
        if int(slot) in places:
            told[places[int(slot)], np.asarray(ids, np.int64) - 1] = True
    return told


def _name(bag: Bag) -> str:
    """A name for the run: that of its directory, where `fly` keeps the bag as `bag` beside the results."""
    if not bag.given.is_dir():
        return bag.path.stem
    directory = bag.path.resolve().parent
    return directory.parent.name if directory.name == "bag" else directory.name


def swarm_section(config: Mapping[str, Any]) -> Mapping[str, Any]:
    """The swarm's settings in a recorded configuration, whether it has sections or not."""
    section = config.get("swarm", config)
    return section if isinstance(section, Mapping) else {}


def recorded_config(config: Mapping[str, Any]) -> RunConfig:
    """The recorded configuration as this version understands it.

    :raises DtsaError, TypeError, ValueError: it is not understood, or names a plug-in that is not installed.
    """
    return RunConfig.from_dict(config if "swarm" in config else {"swarm": config})


def extent_of(config: Mapping[str, Any]) -> float:
    """Largest coordinate that the frames of a recorded run can say, m."""
    value = swarm_section(config).get("extent_m", EXTENT_M)
    return float(value) if isinstance(value, (int, float)) and 0 < value < float("inf") else EXTENT_M


def _slot_ns(config: Mapping[str, Any]) -> int:
    value = swarm_section(config).get("slot_ms", 10.0)
    return round(float(value) * 1e6) if isinstance(value, (int, float)) and value > 0 else 10_000_000


def _agents(config: Mapping[str, Any]) -> int:
    value = swarm_section(config).get("agents", 0)
    return value if isinstance(value, int) and 0 < value <= 65535 else 0


def _start_ns(reception: Columns, slot_ns: int) -> int:
    if not len(reception.get("slot", ())):
        return _OFFSET_NS
    end = int(reception["header.stamp.sec"][0]) * 1_000_000_000 + int(reception["header.stamp.nanosec"][0])
    return end - (int(reception["slot"][0]) + 1) * slot_ns


def _outcomes(reception: Columns) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    empty = np.zeros(0, np.int64)
    slots = np.asarray(reception.get("slot", empty), np.int64)
    return slots, np.minimum(np.asarray(reception.get("outcome", empty), np.int64), len(OUTCOMES) - 1)


def _frames(reception: Columns, transmission: Columns, agents: int) -> Frames:
    sent: dict[tuple[int, int], bytes] = {}
    for slot, ids, lengths, data in zip(
        *(transmission.get(name, ()) for name in ("slot", "agent", "length", "data")), strict=True
    ):
        ends = np.cumsum(lengths, dtype=np.int64)
        for index in np.flatnonzero(lengths):
            end = int(ends[index])
            sent[int(slot), int(ids[index])] = data[end - int(lengths[index]) : end].tobytes()
    width = -(-agents // 8)
    rows: list[tuple[int, int, int, int]] = []
    heard: list[NDArray[np.uint8]] = []
    for slot, senders, bits, lost, collided in zip(
        *(reception.get(name, ()) for name in ("slot", "sender", "received", "lost", "collided")), strict=True
    ):
        for index, sender in enumerate(senders):
            part = np.zeros(width, np.uint8)
            found = bits[index * width : (index + 1) * width]
            part[: len(found)] = found
            heard.append(part)
            receivers = [int(column[index]) if index < len(column) else 0 for column in (lost, collided)]
            rows.append((int(slot), int(sender), receivers[0], receivers[1]))
    table = np.array(rows, np.int64).reshape(-1, 4)
    bits = np.array(heard, np.uint8).reshape(len(rows), width)
    received = np.unpackbits(bits, axis=1, bitorder="little")[:, :agents].astype(bool)
    data = [sent.get((row[0], row[1]), b"") for row in rows]
    return Frames(table[:, 0], table[:, 1], data, received, table[:, 2], table[:, 3])


def _decisions(decision: Columns) -> Decisions:
    count = len(decision.get("slot", ()))
    if not count:
        none, plane = np.zeros(0, np.int64), np.zeros((0, 0), np.int64)
        return Decisions(none, plane, plane, plane, plane.astype(float), plane.astype(np.uint32), ())
    width = max(len(row) for row in decision["agent"])
    known: dict[str, int] = {}
    reason = np.zeros((count, width), np.int64)
    for row, (names, index) in enumerate(zip(decision["reason_name"], decision["reason_index"], strict=True)):
        codes = np.array([known.setdefault(str(name), len(known)) for name in names], np.int64)
        if len(codes) and len(index):
            known_index = np.minimum(index[:width], len(codes) - 1)
            reason[row, : len(known_index)] = codes[known_index]
    return Decisions(
        np.asarray(decision["slot"], np.int64),
        _plane(decision["agent"], width, np.int64),
        _plane(decision["chosen"], width, np.int64),
        reason,
        _plane(decision["score"], width, np.float64),
        _plane(decision["digest"], width, np.uint32),
        tuple(known),
    )


def _plane(rows: NDArray[Any], width: int, dtype: Any) -> NDArray[Any]:
    """(D, width) from rows that may differ in length; what is missing is 0."""
    if rows.ndim == 2 and rows.shape[1] == width:
        return rows.astype(dtype)
    plane = np.zeros((len(rows), width), dtype)
    for index, row in enumerate(rows):
        plane[index, : len(row)] = row[:width]
    return plane


def _tracks(transmission: Columns, agents: int, start_ns: int, slot_ns: int, partly: bool = False) -> Motion | None:
    """True positions at all control instants, as the agents themselves reported them; None if any is missing.

    The answer to slot i holds the track of slot i - 1, whose last position is that of the start of slot i.

    :param partly: what is missing is not known, NaN.
    """
    slots = np.asarray(transmission.get("slot", ()), np.int64)
    if not len(slots) or not agents:
        return None
    steps = max(1, int(transmission["steps"].max()))
    first = int(slots.min())
    if int(slots.max()) - first > 2 * len(slots):
        return None  # most slots are missing, or a number is damaged
    position = np.full((int(slots.max()) - first + 1, steps, 3, agents), np.nan)
    velocity = np.full_like(position, np.nan)
    for slot, ids, track, speed in zip(
        slots, *(transmission[name] for name in ("agent", "track", "velocity")), strict=True
    ):
        if len(track) != steps * 3 * len(ids) or len(speed) != 3 * len(ids) or not len(ids) or max(ids) > agents:
            return None
        position[slot - first, :, :, ids - 1] = track.reshape(steps, 3, -1).transpose(2, 0, 1)
        velocity[slot - first, -1, :, ids - 1] = speed.reshape(3, -1).T
    part = (np.arange(steps)[:-1] + 1)[:, None, None] / steps
    before = np.concatenate((velocity[:1, -1], velocity[:-1, -1]))[:, None]
    velocity[:, :-1] = before + (velocity[:, -1:] - before) * part  # only the last of each slot is recorded
    times = start_ns + (first - 1 + np.arange(len(position))[:, None]) * slot_ns
    times = times + (np.arange(steps) + 1) * slot_ns // steps
    flown = np.isfinite(position).all(axis=(2, 3)) & (times >= start_ns)
    if partly:
        flown = times >= start_ns
    elif not flown[times >= start_ns].all():
        return None
    return Motion(np.arange(1, agents + 1), times[flown], position[flown], velocity[flown])


def _motion(tables: list[tuple[int, Columns]]) -> Motion:
    """All odometry on the union of its times; between two of its own times an agent is interpolated."""
    ids = np.array([number for number, _ in tables], np.int64)
    own = [table["log_time_ns"] for _, table in tables]
    times = np.unique(np.concatenate(own)) if own else np.zeros(0, np.int64)
    position = np.full((len(times), 3, len(tables)), np.nan)
    velocity = np.full_like(position, np.nan)
    for index, (_, table) in enumerate(tables):
        if not len(own[index]):
            continue
        for plane, names in ((position, _PLACE), (velocity, _SPEED)):
            for axis, name in enumerate(names):
                values = table[name]
                if len(values) != len(times):
                    values = np.interp(times, own[index], values, left=np.nan)
                plane[:, axis, index] = values
    return Motion(ids, times, position, velocity)
