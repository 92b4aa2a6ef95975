"""The records of agents on a network, put together to one log."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.air.port import frame_in
from dtsa_agent.air.record import ReceivedFrame, SlotRecord
from dtsa_agent.core import SwarmConfig
from dtsa_bench.log.agent_bag import AgentBag
from dtsa_bench.log.arrays import DECIDED, NEW, UNKNOWN, VECTORS, FlightArrays, ReceivedFrames, empty_arrays, split_log
from dtsa_bench.log.bag.errors import BagError
from dtsa_bench.log.flight_log import FlightLog
from dtsa_bench.log.merged_flight import run_of
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS

from .timeline import Process, process_name

_SECTIONS = ("swarm", "limits", "mode")  # of the configuration: there is no simulated channel, and no simulated clocks
_MAX_SLOT = 0xFFFFFFFF


def join(
    processes: Mapping[Process, AgentBag],
    times: Mapping[Process, Callable[[int], int]],
    common_slot: int,
    flight_ns: int,
    about: Mapping[str, Any],
) -> FlightLog:
    """The log of a flight of which these are the agents' records; slot i starts at i slot lengths.

    :param times: make ns of the common line of those of each process's own clock.
    :param common_slot: the first slot that all counted alike, slot 0 of the log.
    :param flight_ns: from the order to send a frame to its arrival.
    :param about: what to know of the bags, as plain values.
    :raises BagError: if most slots are missing.
    """
    config = next(iter(processes.values())).swarm
    slots = {record.slot for bag in processes.values() for record in bag.slots}
    first, last = min(slots), max(slots)
    if last - first >= 2 * len(slots) + 1000 or last > _MAX_SLOT:
        raise BagError(f"no agent tells of most of the slots {first} to {last}: no flight to record")
    arrays = empty_arrays(last - first + 1, config.agents, config.steps, config.slot_ns)
    arrays["start_ns"] += first * config.slot_ns
    arrays["recorded"][:] = True
    frames: dict[tuple[int, int], tuple[int, bytes]] = {}  # by row and sender: when, and what
    heard: list[tuple[int, int, ReceivedFrame, int, bool]] = []  # row, column of the receiver, frame, when, before the slot
    for process, bag in sorted(processes.items()):
        column, to_common = process[0] - 1, times[process]
        for record in bag.slots:
            row = record.slot - first
            own_ns = _add_account(arrays, row, column, record, to_common)
            if record.datagram:
                frames[row, column + 1] = own_ns, frame_in(record.datagram, config)
            for early, entries in ((True, record.before), (False, record.heard)):
                heard += [(row, column, one, to_common(one.arrival_ns), early) for one in entries]
    heard.sort(key=lambda entry: entry[0])
    for _, _, one, arrival_ns, _ in heard:  # frames of agents of which there is no record
        if first <= one.slot <= last:
            frames.setdefault((one.slot - first, one.sender), (arrival_ns - flight_ns, frame_in(one.datagram, config)))
    keys = sorted(frames)
    for row, sender in keys:
        at_ns, data = frames[row, sender]
        arrays["length"][row, sender - 1] = len(data)
        arrays["sent_ns"][row, sender - 1] = at_ns - arrays["start_ns"][row]
    log = FlightLog(
        name="", settings=_settings(config), agents=config.agents, slot_ns=config.slot_ns, first_slot=first,
        data=b"".join(frames[key][1] for key in keys), received=np.zeros((len(keys), config.agents), np.bool_),
        heard=_received_frames(heard, config), has_end=False,
        merged={**about, "common_slot": common_slot, "processes": [_describe(*one) for one in processes.items()]},
        **arrays,
    )  # fmt: skip
    log.received, log.lost, log.outcome = receptions_of(log)[0]
    return split_log(log, common_slot)


def _add_account(
    arrays: dict[str, Any], row: int, column: int, record: SlotRecord, to_common: Callable[[int], int]
) -> int:
    """Add what an agent recorded of a slot; return when its slot, or its frame, started, ns of the common line."""
    own_ns = max(0, to_common(record.sent_ns)) if record.datagram else to_common(record.start_ns)
    arrays["known"][row, column] = True
    arrays["presence"][row, column] = record.present | (NEW if record.is_first else 0)
    arrays["offset_ns"][row, column] = own_ns - arrays["start_ns"][row]
    for name in DECIDED:
        arrays[name][row, column] = getattr(record, name)
    for name in VECTORS:
        arrays[name][row, :, column] = getattr(record, name)
    arrays["track"][row, :, :, column] = record.track
    return own_ns


def _received_frames(heard: list[tuple[int, int, ReceivedFrame, int, bool]], config: SwarmConfig) -> ReceivedFrames:
    by = np.zeros((len(heard), config.agents), np.bool_)
    by[np.arange(len(heard)), np.array([column for _, column, *_ in heard], np.intp)] = True
    numbers = [(row, one.sender, one.slot, at_ns) for row, _, one, at_ns, _ in heard]
    columns = np.array(numbers, np.int64).reshape(-1, 4).T
    data = [frame_in(one.datagram, config) for _, _, one, *_ in heard]
    return ReceivedFrames(*columns, by, np.array([early for *_, early in heard], np.bool_), data)


def _describe(process: Process, bag: AgentBag) -> dict[str, Any]:
    """State of a process that records of slots do not carry."""
    return {
        "agent": process[0],
        "process": process_name(process),
        "bag": str(bag.path),
        "first": bag.slots[0].slot,
        "last": bag.slots[-1].slot,
        "goals_told": bag.goals_told,
        "ended_in_order": bool(bag.summary),
        "broken_off": bag.broken_off,
    }


def _settings(config: SwarmConfig) -> dict[str, Any]:
    plain = run_of(config).to_dict()
    return {name: plain[name] for name in _SECTIONS}


def receptions_of(log: FlightArrays) -> list[tuple[NDArray[np.bool_], NDArray[np.uint16], NDArray[np.uint8]]]:
    """Received, lost and outcome, as in a log, of each of its parts: what follows from what the agents heard.

    Receivers of which there is no record are neither reached nor lost.
    """
    heard_by: dict[tuple[int, int], NDArray[np.bool_]] = {}  # by slot and sender
    for part in log.parts:
        if part.heard is not None:
            for slot, sender, by in zip(part.heard.slot.tolist(), part.heard.sender.tolist(), part.heard.receivers, strict=True):
                before = heard_by.get((slot, sender))
                heard_by[slot, sender] = by if before is None else before | by
    found = []
    for part in log.parts:
        row, column = np.nonzero(part.length)
        received = np.zeros((len(row), log.agents), np.bool_)
        for k, key in enumerate(zip((row + part.first_slot).tolist(), (column + 1).tolist(), strict=True)):
            if key in heard_by:
                received[k] = heard_by[key]
        received[np.arange(len(row)), column] = False
        lost = np.zeros(part.length.shape, np.uint16)
        missed = part.known[row] & ~received
        missed[np.arange(len(row)), column] = False
        lost[row, column] = missed.sum(axis=1)
        count = (part.length > 0).sum(axis=1)
        outcome = np.where(count > 1, COLLISION, np.where(count > 0, SUCCESS, IDLE)).astype(np.uint8)
        outcome[(count == 0) & ~part.known.all(axis=1)] = UNKNOWN
        found.append((received, lost, outcome))
    return found
