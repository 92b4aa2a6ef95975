"""A flight of several agents' bags as one log: on one time line, written, read, checked and followed.

Times are ns from the start of slot 0. The line is the one that :mod:`.timeline` estimates, measured in slots of the
swarm: slot i starts at i slot lengths, as in every other log.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import zlib
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_agent.air.port import NETWORK, frame_in
from dtsa_agent.air.record import ReceivedFrame, SlotRecord
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.cdr import pack_received
from dtsa_bench.log.arrays import NEW, UNKNOWN
from dtsa_bench.log.flight_log import FlightLog
from dtsa_bench.log.knowledge import Ages, Knowledge, ObservedPairs
from dtsa_bench.log.record import (
    AGENT,
    CONFIGURATION,
    FORMAT,
    FORMAT_KEY,
    SLOT_RECORD,
    TYPE,
    frame_fields,
    load_log,
    log_of_fields,
    pack_configuration,
    pack_record,
)
from dtsa_bench.log.bag.cdr import COLLIDED, SENDING, WAITING, MarkerPacker, OdometryPacker
from dtsa_bench.log.bag.errors import BagError, UnusableBag
from dtsa_bench.log.bag.metadata import MERGED_FROM, RUN_ID
from dtsa_bench.log.bag.reader import Bag
from dtsa_bench.log.bag.writer import BagWriter
from dtsa_bench.runs.options import check_free
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS

from .agent_bag import find_bags, read_all
from .merge.joined import AgentBag, run_of
from .merge.merge import Merge, clocks_apart, sent_of
from .merge.merged_flight import FrameOfOther, MergedFlight, from_log
from .merge.timeline import Clock, Life, named

_VIEW_NS = 50_000_000  # from one picture of the swarm to the next
_SECTIONS = ("swarm", "limits", "mode")  # of the configuration: there is no simulated channel, and no simulated clocks


# -- from the agents' bags ------------------------------------------------------------------------------------------
def merge_bags(paths: Sequence[str | Path]) -> FlightLog:
    """The log of a flight of which these are the agents' bags.

    :raises ConfigError: for bags that are not of one flight, or have no common time line.
    """
    merge = Merge(*read_all(paths))
    return to_log(align(merge, merge.judge()))


def open_log(path: str | Path) -> FlightLog:
    """The log of a recorded flight; of a directory with the bags of its agents, these as one.

    :param path: run directory, bag directory or .mcap file.
    :raises UnusableBag: if it is no bag of this project, of another format, or its records do not fit together.
    :raises ConfigError: for agents' bags that are not of one flight.
    """
    if bags := find_bags(path):
        return _named(merge_bags(bags), path)
    with Bag(path) as bag:
        if AGENT not in bag.custom_data:
            return load_log(bag)
    return _named(merge_bags([path]), path)


def _named(log: FlightLog, path: str | Path) -> FlightLog:
    log.name, log.file = Path(path).resolve().stem, Path(path)
    return log


def align(merge: Merge, summary: Mapping[str, Any]) -> MergedFlight:
    """A flight with its times on the common line.

    :raises ConfigError: if there is no slot that all counted alike.
    """
    first, clocks = merge.turns.common_slot, merge.line.clocks
    if first is None and len(merge.lives) == 1:  # there is nothing to compare the one clock with
        ((life, bag),) = merge.lives.items()
        first, clocks = bag.slots[0].slot, {life: Clock(bag.slots[0].start_ns, 0.0, 0.0)}
    if first is None and merge.apart:
        raise ConfigError("bags", len(merge.lives), f"bags of one flight on one time line; {clocks_apart(merge.apart)}")
    if first is None:
        raise ConfigError("bags", len(merge.lives), "bags of agents that hear each other and come to count slots alike")
    on_line = {life: bag for life, bag in merge.lives.items() if life in clocks and bag.slots}
    zero, length = _line_of_slots(on_line, clocks, first, merge.config.slot_ns)
    slot_ns = merge.config.slot_ns

    def to_common_time(clock: Clock) -> Callable[[int], int]:
        return lambda own_ns: round((clock.common_ns(own_ns) - zero) * slot_ns / length)

    lives = {life: _with_times(bag, to_common_time(clocks[life])) for life, bag in on_line.items()}
    sent = sent_of(lives)
    strays: dict[tuple[int, int], FrameOfOther] = {}
    for bag in lives.values():
        for record in bag.slots:
            for heard in (*record.before, *record.heard):
                key = heard.slot, heard.sender
                if key not in sent and key not in strays:
                    at_ns = heard.arrival_ns - round(merge.line.flight_ns)
                    strays[key] = FrameOfOther(at_ns, frame_in(heard.datagram, merge.config))
    residual = {name: value or 0.0 for name, value in summary["time_line"]["residual_us"].items()}
    about = {
        "common_slot": first,
        **{name: summary[name] for name in ("missing", "broken_off", "nothing_written", "not_on_the_time_line",
                                            "not_determined", "frames_heard_not_as_sent")},
        "residual_us": residual,
        "clocks": summary["time_line"]["clocks"],
        "slot_on_the_first_clock_ns": length,
        "agents_that_gave_up_a_time": sorted({agent for agent, number in merge.lives if number < 0}),
        "processes": [_describe_process(life, bag) for life, bag in lives.items()],
    }  # fmt: skip
    return MergedFlight(merge.config, first, lives, strays, about)


def _line_of_slots(
    lives: Mapping[Life, AgentBag], clocks: Mapping[Life, Clock], first: int, slot_ns: int
) -> tuple[float, float]:
    """Start of slot 0 and length of a slot, ns of common time, as a straight line through the slots' starts."""
    starts: dict[int, list[int]] = {}
    for life, bag in lives.items():
        for record in bag.slots:
            if record.slot >= first:
                starts.setdefault(record.slot, []).append(clocks[life].common_ns(record.start_ns))
    slots = np.array(sorted(starts), dtype=np.float64)
    at = np.array([float(np.median(starts[int(slot)])) for slot in slots])
    length = float(slot_ns)
    if len(slots) > 1:
        length = float(np.polyfit(slots - first, at - at[0], 1)[0])
    return float(np.median(at - length * slots)), length


def _with_times(bag: AgentBag, to_common: Callable[[int], int]) -> AgentBag:
    """A bag whose times are those of the line."""

    def move(record: SlotRecord) -> SlotRecord:
        def arrived(frames: Sequence[ReceivedFrame]) -> list[ReceivedFrame]:
            return [dataclasses.replace(heard, arrival_ns=to_common(heard.arrival_ns)) for heard in frames]

        return dataclasses.replace(
            record, start_ns=to_common(record.start_ns), opened_ns=to_common(record.opened_ns),
            sent_ns=max(0, to_common(record.sent_ns)) if record.datagram else -1,  # of slot 0 it may be a little less
            before=arrived(record.before), heard=arrived(record.heard),
        )  # fmt: skip

    return dataclasses.replace(bag, slots=[move(record) for record in bag.slots])


def _describe_process(life: Life, bag: AgentBag) -> dict[str, Any]:
    """State of a process that records of slots do not carry."""
    return {
        "agent": life[0],
        "process": named(life),
        "bag": str(bag.path),
        "first": bag.slots[0].slot,
        "last": bag.slots[-1].slot,
        "goals_told": bag.goals_told,
        "ended_in_order": bool(bag.summary),
        "broken_off": bag.broken_off,
    }


# -- as records of slots ---------------------------------------------------------------------------------------------
def slot_fields(flight: MergedFlight) -> Iterator[tuple[int, dict[str, Any]]]:
    """The fields of a record of each slot. Receivers of which there is no record are neither reached nor lost.

    :raises BagError: if most slots are missing.
    """
    config, slot_ns = flight.config, flight.config.slot_ns
    here: dict[int, dict[int, SlotRecord]] = {}  # by slot and agent
    heard_by: dict[tuple[int, int], set[int]] = {}
    frames: dict[int, dict[int, tuple[int, bytes]]] = {}  # by slot and sender: when, and what
    for (slot, sender), stray in flight.strays.items():
        frames.setdefault(slot, {})[sender] = stray.sent_ns, stray.data
    for (agent, _), bag in sorted(flight.lives.items()):
        for record in bag.slots:
            here.setdefault(record.slot, {})[agent] = record
            for one in (*record.before, *record.heard):
                heard_by.setdefault((one.slot, one.sender), set()).add(agent)
            if record.datagram:
                frames.setdefault(record.slot, {})[agent] = record.sent_ns, frame_in(record.datagram, config)
    first, last = min(here), max(here)
    if last - first >= 2 * len(here) + 1000 or last > 0xFFFFFFFF:
        raise BagError(f"no agent tells of most of the slots {first} to {last}: no flight to record")
    for slot in range(first, last + 1):
        records, sent = dict(sorted(here.get(slot, {}).items())), dict(sorted(frames.get(slot, {}).items()))
        start_ns = slot * slot_ns
        mask, lost = np.zeros((len(sent), config.agents), np.bool_), []
        for row, sender in enumerate(sent):
            receivers = heard_by.get((slot, sender), set()) - {sender}
            mask[row, [agent - 1 for agent in receivers]] = True
            lost.append(len(records.keys() - receivers - {sender}))
        outcome = COLLISION if len(sent) > 1 else SUCCESS if sent else IDLE
        if not sent and len(records) < config.agents:
            outcome = UNKNOWN
        heard = [(agent, one, early) for agent, record in records.items()
                 for frames_heard, early in ((record.before, 1), (record.heard, 0)) for one in frames_heard]  # fmt: skip
        # Of a time that its sender gave up: the log has another frame of that slot.
        other = [_other_frame(one, frames, config) for _, one, _ in heard]
        by = np.zeros((len(heard), config.agents), np.bool_)
        by[np.arange(len(heard)), [agent - 1 for agent, _, _ in heard]] = True
        vectors = {
            name: np.stack([getattr(record, name) for record in records.values()], axis=1) if records else []
            for name in ("velocity", "command", "goal")
        }
        track = np.stack([record.track for record in records.values()], axis=2) if records else np.zeros(0)
        yield slot, {
            "outcome": outcome, "steps": config.steps, "agent": list(records),
            "presence": [record.present | (NEW if record.is_first else 0) for record in records.values()],
            **{name: [getattr(record, name) for record in records.values()]
               for name in ("chosen", "reason", "digest", "score")},
            "offset_ns": [(r.sent_ns if r.datagram else r.start_ns) - start_ns for r in records.values()],
            "track": track, **vectors, **frame_fields({sender: data for sender, (_, data) in sent.items()}, mask),
            "sent_ns": [at_ns - start_ns for at_ns, _ in sent.values()], "lost": lost, "collided": [0] * len(sent),
            "heard_sender": [one.sender for _, one, _ in heard], "heard_slot": [one.slot for _, one, _ in heard],
            "heard_ns": [one.arrival_ns - start_ns for _, one, _ in heard],
            "heard_by": np.frombuffer(pack_received(by), np.uint8) if heard else [],
            "heard_before": [early for _, _, early in heard] if any(early for _, _, early in heard) else [],
            "heard_length": [len(data) for data in other] if any(other) else [],
            "heard_data": np.frombuffer(b"".join(other), np.uint8),
        }  # fmt: skip


def _other_frame(heard: ReceivedFrame, frames: Mapping[int, Mapping[int, tuple[int, bytes]]], config: SwarmConfig) -> bytes:
    """A frame that was heard, if the log has another one of its sender and slot; else nothing."""
    data = frame_in(heard.datagram, config)
    return b"" if frames[heard.slot][heard.sender][1] == data else data


def to_log(flight: MergedFlight) -> FlightLog:
    """A merged flight as a log.

    :raises BagError: if most slots are missing.
    """
    return log_of_fields(slot_fields(flight), "", _settings(flight.config), flight.config.slot_ns, flight.about)


def _settings(config: SwarmConfig) -> dict[str, Any]:
    plain = run_of(config).to_dict()
    return {name: plain[name] for name in _SECTIONS}


# -- as a bag --------------------------------------------------------------------------------------------------------
def write_merged(directory: Path, flight: MergedFlight, summary: Mapping[str, Any]) -> Path:
    """Write `bag` and `summary.json`, as flights leave them, whole or not at all; return the bag.

    :param directory: where to; must not exist, or be empty.
    :raises ConfigError: if something is there already.
    :raises BagError: if it cannot be written.
    """
    check_free(directory)
    whole = directory.resolve()
    part = whole.with_name(f".{whole.name}.part")
    try:
        shutil.rmtree(part, ignore_errors=True)  # of an earlier run that was killed
        part.mkdir(parents=True)
        _write_bag(part / "bag", flight)
        (part / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
        part.replace(whole)  # also where that is an empty directory
    except OSError as error:
        raise BagError(f"cannot write to {directory}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return directory / "bag"


def _write_bag(directory: Path, flight: MergedFlight) -> None:
    config, fields = flight.config, slot_fields(flight)
    about = json.dumps(flight.about, sort_keys=True)
    run = zlib.crc32(about.encode()) or 1
    custom = {MERGED_FROM: about, RUN_ID: f"{run:08x}", FORMAT_KEY: FORMAT}
    settings = _settings(config)
    with BagWriter(directory, settings, custom_data=custom) as bag:
        about_run = bag.add_topic(f"{names.SWARM}/{names.CONFIGURATION}", CONFIGURATION, "latched")
        bag.write(about_run, pack_configuration(run, settings), names.TIME_ZERO_NS, names.TIME_ZERO_NS)
        record = bag.add_topic(SLOT_RECORD, TYPE)
        viewer = _Viewer(bag, config, flight.common_slot)
        for slot, values in fields:
            at = names.slot_time_ns(slot, config.slot_ns)
            steps, outcome = (int(values.pop(name)) for name in ("steps", "outcome"))
            bag.write(record, pack_record(run, slot, at, steps, outcome, **values), at, at)
            viewer.show(slot, at, values)


class _Viewer:
    """Odometry and pictures of those of whom it is known where they are; the others vanish."""

    def __init__(self, bag: BagWriter, config: SwarmConfig, common_slot: int) -> None:
        self._bag, self._first, self._every = bag, common_slot, max(1, round(_VIEW_NS / config.slot_ns))
        self._markers = bag.add_topic(f"{names.SWARM}/{names.MARKERS}", "visualization_msgs/msg/MarkerArray")
        spaces = [names.agent_namespace(agent) for agent in range(1, config.agents + 1)]
        self._odometry = [bag.add_topic(f"{space}/{names.ODOMETRY}", "nav_msgs/msg/Odometry") for space in spaces]
        self._packer = OdometryPacker([names.body_frame(space) for space in spaces], names.FRAME)
        self._shown: tuple[int, ...] = ()
        self._marker_packer = MarkerPacker([])
        self._position, self._velocity = np.zeros((3, config.agents)), np.zeros((3, config.agents))

    def show(self, slot: int, at: int, fields: Mapping[str, Any]) -> None:
        """Write what viewers show of a slot."""
        if slot < self._first or slot % self._every:
            return
        ids = tuple(fields["agent"])
        if ids:
            columns = np.array(ids) - 1
            self._position[:, columns], self._velocity[:, columns] = fields["track"][-1], fields["velocity"]
            packed = self._packer.pack(at, self._position, self._velocity)
            for agent in ids:
                self._bag.write(self._odometry[agent - 1], packed[agent - 1], at, at)
        if ids != self._shown:
            self._marker_packer, self._shown = MarkerPacker([f"cf{agent}" for agent in ids], ids=ids), ids
            self._bag.write(self._markers, MarkerPacker.nothing(names.FRAME), at, at)
        if ids:
            senders = fields["sender"]
            speaks = COLLIDED if len(senders) > 1 else SENDING
            state = np.array([speaks if agent in senders else WAITING for agent in ids], np.uint8)
            data = self._marker_packer.pack(at, fields["track"][-1], state, fields["goal"])
            self._bag.write(self._markers, data, at, at)
