"""A flight of several agents' bags as one log, opened, and written as a bag."""

from __future__ import annotations

import json
import shutil
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_agent.core import SwarmConfig
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.cdr import pack_received
from dtsa_bench.log.arrays import DECIDED, VECTORS, FlightArrays
from dtsa_bench.log.bag.cdr import COLLIDED, SENDING, WAITING, MarkerPacker, OdometryPacker
from dtsa_bench.log.bag.errors import BagError
from dtsa_bench.log.bag.metadata import MERGED_FROM, RUN_ID
from dtsa_bench.log.bag.reader import Bag
from dtsa_bench.log.bag.writer import BagWriter
from dtsa_bench.log.flight_log import FlightLog
from dtsa_bench.log.record import (
    AGENT,
    CONFIGURATION,
    FORMAT,
    FORMAT_KEY,
    add_records,
    frame_fields,
    load_log,
    pack_configuration,
    pack_record,
)
from dtsa_bench.runs.options import check_free

from .agent_bag import find_bags, read_all
from .merge.merge import Merge

_VIEW_NS = 50_000_000  # from one picture of the swarm to the next


def open_log(path: str | Path) -> FlightLog:
    """The log of a recorded flight; of a directory with the bags of its agents, these as one.

    :param path: run directory, bag directory or .mcap file.
    :raises UnusableBag: if it is no bag of this project, of another format, or its records do not fit together.
    :raises ConfigError: for agents' bags that are not of one flight, or have no common time line.
    """
    if not (bags := find_bags(path)):
        with Bag(path) as bag:
            if AGENT not in bag.custom_data:
                return load_log(bag)
        bags = [Path(path)]
    log = Merge(*read_all(bags)).log
    log.name, log.file = Path(path).resolve().stem, Path(path)
    return log


def write_merged(directory: Path, log: FlightArrays, summary: Mapping[str, Any]) -> Path:
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
        _write_bag(part / "bag", log)
        (part / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
        part.replace(whole)  # also where that is an empty directory
    except OSError as error:
        raise BagError(f"cannot write to {directory}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return directory / "bag"


def _write_bag(directory: Path, log: FlightArrays) -> None:
    about = json.dumps(log.merged, sort_keys=True)
    run, whole = zlib.crc32(about.encode()) or 1, log.whole or log
    custom = {MERGED_FROM: about, RUN_ID: f"{run:08x}", FORMAT_KEY: FORMAT}
    with BagWriter(directory, log.settings, custom_data=custom) as bag:
        about_run = bag.add_topic(f"{names.SWARM}/{names.CONFIGURATION}", CONFIGURATION, "latched")
        bag.write(about_run, pack_configuration(run, log.settings), names.TIME_ZERO_NS, names.TIME_ZERO_NS)
        record, viewer = add_records(bag), _Viewer(bag, log.config.swarm)
        for row in range(len(whole)):
            slot, outcome = whole.first_slot + row, int(whole.outcome[row])
            at_ns = names.slot_time_ns(slot, log.slot_ns)
            data = pack_record(run, slot, at_ns, whole.track.shape[1], outcome, **_record_fields(whole, row))
            bag.write(record, data, at_ns, at_ns)
            if slot >= log.first_slot:
                viewer.show(whole, row, at_ns)


def _record_fields(log: FlightArrays, row: int) -> dict[str, Any]:
    """The fields of the record of a slot."""
    here, senders = np.flatnonzero(log.known[row]), np.flatnonzero(log.length[row])
    fields = {
        "agent": here + 1, **{name: getattr(log, name)[row, here] for name in (*DECIDED, "offset_ns")},
        **{name: getattr(log, name)[row][..., here] for name in (*VECTORS, "track")},
        **frame_fields(log.frames_in(row), log.received[log.sent_ends[row] : log.sent_ends[row + 1]]),
        **{name: getattr(log, name)[row, senders] for name in ("sent_ns", "lost", "collided")},
        "presence": [] if log.presence is None else log.presence[row, here],
    }  # fmt: skip
    heard = log.heard and log.heard.part(row, row + 1)
    if not heard or not heard.data:
        return fields
    # Of a time that its sender gave up: the log has another frame of that slot.
    keys = zip((heard.slot - log.first_slot).tolist(), heard.sender.tolist(), heard.data, strict=True)
    other = [b"" if 0 <= at < len(log) and log.frame(at, sender) == data else data for at, sender, data in keys]
    return fields | {
        "heard_sender": heard.sender, "heard_slot": heard.slot, "heard_ns": heard.time_ns - log.start_ns[row],
        "heard_by": np.frombuffer(pack_received(heard.receivers), np.uint8),
        "heard_before": heard.before if heard.before.any() else [],
        "heard_length": [len(data) for data in other] if any(other) else [],
        "heard_data": np.frombuffer(b"".join(other), np.uint8),
    }  # fmt: skip


class _Viewer:
    """Odometry and pictures of those of whom it is known where they are; the others vanish."""

    def __init__(self, bag: BagWriter, config: SwarmConfig) -> None:
        self._bag, self._every = bag, max(1, round(_VIEW_NS / config.slot_ns))
        self._markers = bag.add_topic(f"{names.SWARM}/{names.MARKERS}", "visualization_msgs/msg/MarkerArray")
        spaces = [names.agent_namespace(agent) for agent in range(1, config.agents + 1)]
        self._odometry = [bag.add_topic(f"{space}/{names.ODOMETRY}", "nav_msgs/msg/Odometry") for space in spaces]
        self._packer = OdometryPacker([names.body_frame(space) for space in spaces])
        self._shown: tuple[int, ...] = ()
        self._marker_packer = MarkerPacker([])

    def show(self, log: FlightArrays, row: int, at_ns: int) -> None:
        """Write what viewers show of a slot."""
        if (log.first_slot + row) % self._every:
            return
        here = np.flatnonzero(log.known[row])
        ids = tuple((here + 1).tolist())
        packed = self._packer.pack(at_ns, log.track[row, -1], log.velocity[row])
        for agent in ids:
            self._bag.write(self._odometry[agent - 1], packed[agent - 1], at_ns, at_ns)
        if ids != self._shown:
            self._marker_packer, self._shown = MarkerPacker(ids), ids
            self._bag.write(self._markers, MarkerPacker.nothing(), at_ns, at_ns)
        if ids:
            sent = log.sent[row]
            state = np.where(sent[here], COLLIDED if sent.sum() > 1 else SENDING, WAITING).astype(np.uint8)
            positions, goals = log.track[row, -1][:, here], log.goal[row][:, here]
            self._bag.write(self._markers, self._marker_packer.pack(at_ns, positions, state, goals), at_ns, at_ns)
