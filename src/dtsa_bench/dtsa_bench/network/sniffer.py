"""Listens to the frames of a swarm without taking part: records them, and judges what the air alone can tell."""

from __future__ import annotations

import json
import select
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dtsa_agent.air.datagram import frame_in, link_of
from dtsa_agent.air.port import PortSettings
from dtsa_agent.air.ports import open_listener
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import DtsaError
from dtsa_agent.core.station import OTHER_TIME, REPEATED, StationSettings
from dtsa_agent.keys import authenticator
from dtsa_agent.stop import Stop
from dtsa_bench.recordings.merge.agent_recorder import about_port
from dtsa_bench.recordings.merge.json_bag import JsonBag, described
from dtsa_bench.recordings.rules.judge import Judge

FRAME, METADATA = "frame", "dtsa_sniffer"  # topic of the frames in its bag, name of the metadata record
FRAME_SCHEMA = described(
    "dtsa.SniffedFrame",
    arrival_ns=("integer", "when it arrived, ns, CLOCK_MONOTONIC"),
    sender=("integer", "id that it names; 0: it was no frame of this swarm"),
    slot=("integer", "slot that it names"),
    data=("string", "the datagram, hexadecimal"),
    reason=("string", "why it is no frame of this swarm; empty: it is one"),
)
_PATIENCE_S = 0.05
_BURST = 64
_WAITS = 2  # slots that are kept open for frames that come late
_MOST_REFUSED = 50  # recorded from one flush to the next


class Sniffer:
    """One who listens.

    :param path: file for what was heard; None: it is only judged.
    :param say: is told a line when the port fails or is back; None: nobody is.
    :raises ConfigError: for a port that cannot be used, or without the key of sealed frames.
    :raises BagError: if the file cannot be made.
    """

    def __init__(
        self,
        config: SwarmConfig,
        port: PortSettings,
        path: Path | None = None,
        say: Callable[[str], None] | None = None,
    ) -> None:
        self._config, self._judge = config, Judge(config)
        self._datagrams = StationSettings(config, link_of(config, port.properties), authenticator(config))
        self._slots: dict[int, dict[int, bytes]] = {}  # not judged yet
        self._judged = -1  # last slot
        self.refused: Counter[str] = Counter()
        self.heard: Counter[int] = Counter()  # frames, by sender
        self._kept = 0  # refused datagrams since the last flush
        self._listener: Any = open_listener(port)
        self._listener.say = say
        about = {"swarm": json.dumps(config.to_dict(), sort_keys=True), **about_port(port)}
        try:
            self.bag = None if path is None else JsonBag(path, {FRAME: FRAME_SCHEMA}, METADATA, about)
        except DtsaError:
            self._listener.__exit__()
            raise

    def run(self, stop: Stop, seconds: float = 0.0) -> None:
        """Listens until a signal comes, or for a time.

        :param seconds: how long; 0: without end.
        """
        end = time.monotonic() + seconds
        while not stop and not (seconds and time.monotonic() >= end):
            select.select([self._listener], [], [], _PATIENCE_S)
            for datagram in self._listener.receive(_BURST):
                self._take(datagram.data, datagram.arrival_ns)
            if self.bag is not None and self.bag.flush_if_due():
                self._kept = 0
        for slot in sorted(self._slots):
            self._judge.slot(slot, self._slots[slot])
        self._slots.clear()

    def _take(self, data: bytes, arrival_ns: int) -> None:
        sender, slot, reason = self._read(data)
        if self.bag is not None and (not reason or self._kept < _MOST_REFUSED):
            self._kept += bool(reason)
            said = {"arrival_ns": arrival_ns, "sender": sender, "slot": slot, "data": data.hex(), "reason": reason}
            self.bag.write(FRAME, arrival_ns, said)
        if reason:
            self.refused[reason] += 1
            return
        self.heard[sender] += 1
        self._slots.setdefault(slot, {})[sender] = frame_in(data, self._config)
        for over in sorted(s for s in self._slots if s <= max(self._slots) - _WAITS):
            self._judge.slot(over, self._slots.pop(over))
            self._judged = over

    def _read(self, data: bytes) -> tuple[int, int, str]:
        fault, sender, slot, *_ = self._datagrams.read(data)
        if fault:
            return 0, 0, fault
        # Of a group that lies behind, or the same frame once more.
        if slot <= self._judged:
            return sender, slot, OTHER_TIME
        return sender, slot, REPEATED if sender in self._slots.get(slot, {}) else ""

    def summary(self) -> dict[str, Any]:
        """What was heard, and what was found."""
        return {
            "heard": {f"cf{agent}": count for agent, count in sorted(self.heard.items())},
            "not_taken_in": dict(sorted(self.refused.items())),
            **self._listener.counts(),
            **self._judge.summary(),
        }

    def close(self) -> None:
        """Ends the record, and leaves the air."""
        self._listener.__exit__()
        if self.bag is not None:
            self.bag.__exit__()

    def __enter__(self) -> Sniffer:
        return self

    def __exit__(self, *unused: object) -> None:
        self.close()
