"""Reads the bag that an agent on a network has made of its own flight."""

from __future__ import annotations

import json
import struct
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Channel, Message, Metadata
from mcap.stream_reader import StreamReader
from zstandard import ZstdError

from dtsa_agent.air.datagram import flight_ns
from dtsa_agent.air.port import PortProperties
from dtsa_agent.air.record import Heard, SlotRecord
from dtsa_agent.core import SwarmConfig
from dtsa_bench.recordings.bag.errors import UnusableBag
from dtsa_bench.recordings.bag.metadata import RECORD_KEY, RECORD_NAME, custom_data, load
from dtsa_bench.recordings.bag.writer import BROKEN_OFF
from dtsa_bench.runs.program import program

from .agent_recorder import METADATA, REFUSED, SLOT, SUMMARY

_LONGEST_RECORD = 1 << 24  # bytes
_DAMAGE = (McapError, ZstdError, struct.error, EOFError, ValueError, KeyError, TypeError, AttributeError)


@dataclass(slots=True)
class AgentBag:
    """What one agent said about itself."""

    path: Path
    agent: int  # id
    swarm: SwarmConfig
    port: PortProperties
    started_ns: int  # own clock, when its process began
    slots: list[SlotRecord] = field(default_factory=list)  # ascending, but where it took over another time
    refused: Counter[str] = field(default_factory=Counter)  # datagrams not taken in, by reason
    summary: dict[str, Any] = field(default_factory=dict)  # its own; empty: it was killed
    broken_off: bool = False  # the file was not finished
    unsent_kept: bool = True  # frames that were too late to be sent are in it
    goals_told: bool = False  # it was told goals in flight: none was known to be its last

    @property
    def flight_ns(self) -> int:
        """From the order to send a frame to its arrival as the agents take it to be, ns."""
        return flight_ns(self.swarm, self.port)


class NothingWritten(UnusableBag):
    """A process was started, and ended before it wrote anything."""


def find(path: str | Path) -> Path:
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
    """The bag of an agent; of a file that was not finished, what is whole.

    :raises UnusableBag: if it is no bag of an agent on a network.
    :raises NothingWritten: if its process ended before it wrote anything.
    """
    file = find(path)
    bag: AgentBag | None = None
    topics: dict[int, str] = {}
    finished = False
    try:
        if not file.stat().st_size:
            raise NothingWritten(file, "is empty")
        with file.open("rb") as stream:
            try:
                for record in StreamReader(stream, validate_crcs=True, record_size_limit=_LONGEST_RECORD).records:
                    if isinstance(record, Channel):
                        topics[record.id] = record.topic
                    elif isinstance(record, Metadata):
                        bag = _metadata(file, record, bag)
                    elif isinstance(record, Message) and bag is not None:
                        _message(bag, topics.get(record.channel_id, ""), json.loads(record.data))
                finished = True
            except UnusableBag:
                raise
            except _DAMAGE as error:
                if bag is None:
                    raise UnusableBag(file, f"not readable ({error})") from None
    except OSError as error:
        raise UnusableBag(file, error.strerror or str(error)) from None
    if bag is None:
        raise UnusableBag(file, f"no bag of an agent on a network, as `{program()} agent --out` makes them")
    bag.broken_off = bag.broken_off or not finished
    return bag


def read_all(paths: Sequence[str | Path]) -> tuple[list[AgentBag], list[str]]:
    """The bags of a flight's agents, and, by path, the processes that wrote nothing.

    :raises UnusableBag: if one is no bag of an agent on a network, or the only one given is not written.
    """
    if len(paths) == 1:
        return [read(paths[0])], []
    found = [(str(path), _read_if_written(path)) for path in paths]
    return [bag for _, bag in found if bag], [path for path, bag in found if not bag]


def _read_if_written(path: str | Path) -> AgentBag | None:
    try:
        return read(path)
    except NothingWritten:
        return None


def _metadata(file: Path, record: Metadata, bag: AgentBag | None) -> AgentBag | None:
    values = record.metadata
    if record.name == METADATA:
        try:
            swarm = SwarmConfig.from_dict(json.loads(values["swarm"]))
            told = values.get("goals_told") == "yes"
            return AgentBag(file, int(values["id"]), swarm, _port(values), int(values["started_ns"]), goals_told=told)
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            raise UnusableBag(file, f"its settings cannot be read ({error})") from None
    if record.name == RECORD_NAME and bag is not None:  # `recover` has made this file of one that was not finished
        bag.broken_off = BROKEN_OFF in custom_data(load(values.get(RECORD_KEY, "")))
    if record.name == SUMMARY and bag is not None:
        bag.summary = json.loads(values.get("summary", "{}"))
    return bag


def _port(values: Mapping[str, str]) -> PortProperties:
    """Bags of earlier versions are of networks, and have their settings alone."""
    if "port" in values:
        said = json.loads(values["port"])
        return PortProperties(str(said.pop("name")), **{name: int(value) for name, value in said.items()})
    udp = json.loads(values["udp"])
    return PortProperties("udp", int(udp["flight_time_ns"]), int(udp["byte_time_ns"]))


def _message(bag: AgentBag, topic: str, said: dict[str, Any]) -> None:
    if topic == REFUSED:
        bag.refused[str(said["reason"])] += 1
    elif topic == SLOT:
        arrays = {name: np.array(said.pop(name), dtype=np.float64) for name in _ARRAYS}
        heard = {name: [_heard(one) for one in said.pop(name)] for name in ("before", "heard")}
        data = {name: bytes.fromhex(said.pop(name)) for name in ("frame", "datagram")}
        record = SlotRecord(**said, **arrays, **heard, **data)
        if bag.slots and record.slot <= bag.slots[-1].slot and not record.anew:
            raise UnusableBag(bag.path, f"slot {record.slot} comes after slot {bag.slots[-1].slot}")
        bag.slots.append(record)


_ARRAYS = ("track", "velocity", "command", "goal")


def _heard(said: dict[str, Any]) -> Heard:
    return Heard(said["sender"], said["slot"], said["arrival_ns"], bytes.fromhex(said["datagram"]), said["accepted"])
