"""Who received what in recorded, merged and sniffed flights, and in tables of others."""

from __future__ import annotations

import dataclasses
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError, DtsaError
from dtsa_bench.recordings.bag.errors import UnusableBag
from dtsa_bench.recordings.bag.metadata import RUN_ID
from dtsa_bench.recordings.bag.place import find_file
from dtsa_bench.recordings.bag.reader import Bag
from dtsa_bench.recordings.bag.run import RecordedRun, load_run, recorded_config
from dtsa_channel_sim import Channel, ChannelConfig, Medium, OnAir
from dtsa_channel_sim.model.loss_record import HEARD, LOST, MOST, UNKNOWN
from dtsa_channel_sim.model.loss_table import LossTable, read_table

from .sniffed import FILE, read_sniffed

_CHUNK = 20_000  # frames whose distances are worked out at once
Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class Observed:
    """What one flight says of losses.

    :param name: of the run, or of its file.
    :param run: the run's id; empty: it has none.
    :param kind: lockstep, realtime, merged, sniffed, table.
    :param slot_ns: ns, length of its slots; 0: not known.
    :param agents: number of agents.
    :param table: frames and their receivers.
    :param left_out: frames that do not count, by reason.
    """

    name: str
    run: str
    kind: str
    slot_ns: int
    agents: int
    table: LossTable
    left_out: Counter[str] = field(default_factory=Counter)


def observe(path: str | Path, slot_ns: int = 0) -> Observed:
    """What a flight says of losses.

    :param path: run directory, bag directory or .mcap file, directory or file of `sniff`, or a table (.csv).
    :param slot_ns: ns, length of the slots of a table; 0: not known.
    :raises ConfigError: if it cannot be used.
    """
    given = Path(path)
    if given.suffix.lower() == ".csv" and not given.is_dir():
        table = read_table(given, slot_ns)
        return Observed(given.name, "", "table", slot_ns, table.agents, table)
    file = given / FILE if (given / FILE).is_file() else find_file(given)
    sniffed = read_sniffed(file)
    if sniffed is not None:
        table, config = sniffed
        return Observed(given.name, "", "sniffed", config.slot_ns, config.agents, table)
    with Bag(given) as bag:
        run = load_run(bag)
        run_id = bag.custom_data.get(RUN_ID, "")
    table, left_out = _recorded(run, given)
    kind = "merged" if run.merged is not None else str(run.config.get("mode", "lockstep"))
    return Observed(run.name, run_id, kind, run.slot_ns, run.agents, table, left_out)


def _recorded(run: RecordedRun, path: Path) -> tuple[LossTable, Counter[str]]:
    frames, agents = run.frames, run.agents
    if not len(frames.slot):
        raise UnusableBag(path, "no frame was sent in it")
    if len(frames.slot) * (agents + 1) > MOST:
        raise UnusableBag(path, f"{len(frames.slot)} frames of {agents} agents are more than can be worked on")
    outcome = np.full((len(frames.slot), agents + 1), UNKNOWN, np.uint8)
    outcome[:, 1:] = np.where(frames.received, HEARD, LOST)
    outcome[np.arange(len(frames.slot)), frames.sender] = UNKNOWN
    left_out: Counter[str] = Counter()
    if run.merged is not None:
        good = _of_merged(run, outcome, left_out)
    else:
        good = _of_channel(run, outcome, left_out)
    good &= (outcome != UNKNOWN).any(axis=1)
    if not good.any():
        raise UnusableBag(path, "of no frame is known who received it")
    order = np.flatnonzero(good)
    order = order[np.lexsort((frames.sender[order], frames.slot[order]))]
    slots, senders = frames.slot[order], frames.sender[order]
    return LossTable(slots, senders, outcome[order], _distances(run, slots, senders)), left_out


def _of_merged(run: RecordedRun, outcome: Array, left_out: Counter[str]) -> Array:
    """Which frames count, where agents have told what they heard."""
    assert run.told is not None
    frames = run.frames
    place = np.searchsorted(run.slots, frames.slot)
    there = (place < len(run.slots)) & (run.slots[np.minimum(place, len(run.slots) - 1)] == frames.slot)
    told = np.zeros_like(frames.received)
    told[there] = run.told[place[there]]
    outcome[:, 1:][~told] = UNKNOWN
    _, which, count = np.unique(frames.slot, return_inverse=True, return_counts=True)
    good = count[which] == 1
    left_out["two senders in the slot"] += int(np.count_nonzero(~good))
    return np.asarray(good)


def _of_channel(run: RecordedRun, outcome: Array, left_out: Counter[str]) -> Array:
    """Which frames count, where the channel has told how many lost a frame, and at how many it collided."""
    frames = run.frames
    good = frames.collided == 0
    left_out["collided somewhere"] += int(np.count_nonzero(~good))
    received = frames.received.sum(axis=1)
    all_reached = received + frames.lost == run.agents - 1
    none_lost = frames.lost == 0
    rows = np.flatnonzero(good & none_lost & ~all_reached)
    missed = outcome[rows] == LOST
    outcome[rows] = np.where(missed, UNKNOWN, outcome[rows])
    unclear = np.flatnonzero(good & ~none_lost & ~all_reached)
    if len(unclear):
        clear = _reached(run, outcome, unclear)
        good[unclear[~clear]] = False
        left_out["not known who was in reach"] += int(np.count_nonzero(~clear))
    return np.asarray(good)


def _reached(run: RecordedRun, outcome: Array, rows: Array) -> Array:
    """Takes those out that a frame did not reach, by the recorded channel; whether its number of losses agrees."""
    clear = np.zeros(len(rows), np.bool_)
    try:
        air = recorded_config(run.config).air
    except (DtsaError, TypeError, ValueError):
        return clear
    channel = Channel(dataclasses.replace(air, losses=""))
    frames, places = run.frames, _places(run, run.frames.slot[rows])
    media: dict[ChannelConfig, Medium] = {}
    for index, row in enumerate(rows.tolist()):
        slot, sender = int(frames.slot[row]), int(frames.sender[row])
        now = channel.settings_at(slot)
        medium = media.get(now)
        if medium is None:
            plain = dataclasses.replace(now, loss=0.0, burst_length=0.0, loss_matrix=(), link_loss=(), jam=False)
            medium = media[now] = Medium(plain)
        if places is None and medium.needs_positions:
            continue
        start = slot * run.slot_ns
        alone = OnAir(sender, start, start, start + 1)
        reached = medium.judge(slot, alone, (), None if places is None else places[index]).received
        heard = frames.received[row]
        if int(reached.sum()) == int(heard.sum() + frames.lost[row]) and not (heard & ~reached).any():
            outcome[row, 1:][~reached] = UNKNOWN
            clear[index] = True
    return clear


def _places(run: RecordedRun, slots: Array) -> Array | None:
    """Where all were at the start of slots, (F, 3, N), m; None: not known of all."""
    motion = run.motion
    if not len(motion.time_ns) or len(motion.ids) != run.agents:
        return None
    at = np.searchsorted(motion.time_ns, run.start_ns + slots * run.slot_ns)
    return motion.position[np.minimum(at, len(motion.time_ns) - 1)]


def _distances(run: RecordedRun, slots: Array, senders: Array) -> NDArray[np.float32] | None:
    """(F, N + 1) m, from the sender to all others at the start of the slot; None: places are not known."""
    result = np.full((len(slots), run.agents + 1), np.nan, np.float32)
    for start in range(0, len(slots), _CHUNK):
        part = slice(start, start + _CHUNK)
        places = _places(run, slots[part])
        if places is None:
            return None
        own = np.take_along_axis(places, (senders[part] - 1)[:, None, None], axis=2)
        result[part, 1:] = np.sqrt(((places - own) ** 2).sum(axis=1))
    return result if np.isfinite(result).any() else None


def together(flights: list[Observed]) -> tuple[int, int]:
    """Number of agents and length of a slot, ns, that all flights have.

    :raises ConfigError: if they differ.
    """
    first = flights[0]
    for flight in flights[1:]:
        if flight.agents != first.agents and "table" not in (flight.kind, first.kind):
            raise ConfigError("agents", f"{flight.agents} in {flight.name}", f"{first.agents}, as in {first.name}")
        if flight.slot_ns != first.slot_ns:
            told = f"{flight.slot_ns / 1e6:g} ms in {flight.name}"
            raise ConfigError("slot_ms", told, f"{first.slot_ns / 1e6:g} ms, as in {first.name}")
    return max(flight.agents for flight in flights), first.slot_ns
