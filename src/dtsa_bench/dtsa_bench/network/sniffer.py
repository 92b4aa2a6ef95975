"""Listens to the frames of a swarm without taking part: records them, and judges what the air alone can tell."""

from __future__ import annotations

import dataclasses
import json
import select
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dtsa_agent.air.port import PortSettings, frame_in, link_of, open_port
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import DtsaError
from dtsa_agent.core.station import OTHER_TIME, REPEATED, StationSettings
from dtsa_agent.keys import authenticator
from dtsa_agent.ros.common import names
from dtsa_agent.stop import Stop
from dtsa_bench.log.agent_bag import RecordFile
from dtsa_bench.log.record import SNIFFER, frame_fields, pack_record
from dtsa_bench.log.rules import RuleChecker
from dtsa_channel_sim.model.verdict import COLLISION, SUCCESS

_PATIENCE_S = 0.05
_BURST = 64
_WAITS = 2  # slots that are kept open for frames that come late
_SILENCE_NS = 2_000_000_000  # after this a frame of an earlier slot is of a swarm that was started again


class Sniffer:
    """A listener.

    :param path: file for what was heard; None: it is only judged. A swarm that is started again gets another one.
    :param log: prints a line when the port fails or is back; None: nothing is printed.
    :raises ConfigError: for a port that cannot be used, or without the key of signed frames.
    :raises BagError: if the file cannot be made.
    """

    def __init__(
        self, config: SwarmConfig, port: PortSettings, path: Path | None = None,
        log: Callable[[str], None] | None = None,
    ) -> None:  # fmt: skip
        self._config, self._rules = config, RuleChecker(config)
        self._datagrams = StationSettings(config, link_of(config, port.properties), authenticator(config))
        self._slots: dict[int, dict[int, tuple[int, bytes]]] = {}  # not judged yet: by sender, when it came, and what
        self._judged = -1  # last slot
        self._recorded_ns = 0  # when it was recorded to start
        self._accepted_ns = 0  # when the last frame came
        self._starts = 1  # of the swarm
        self.refused: Counter[str] = Counter()
        self.heard: Counter[int] = Counter()  # frames, by sender
        self._zero_ns = time.monotonic_ns()
        self._listener = open_port(port)
        self._listener.log = log
        about = {"port": dataclasses.asdict(port.properties), "port_settings": port.to_dict(), "zero_ns": self._zero_ns}
        self._custom, self._path = {SNIFFER: json.dumps(about, sort_keys=True)}, path
        try:
            self.bag = None if path is None else RecordFile(path, config, self._custom)
        except DtsaError:
            self._listener.close()
            raise

    def run(self, stop: Stop, seconds: float = 0.0) -> None:
        """Listen until a signal comes, or for seconds (0: without end)."""
        end = time.monotonic() + seconds
        while not stop and not (seconds and time.monotonic() >= end):
            select.select([self._listener], [], [], _PATIENCE_S)
            for datagram in self._listener.receive(_BURST):
                self._receive(datagram.data, datagram.arrival_ns)
        self._close_slots(max(self._slots, default=0))

    def _receive(self, data: bytes, arrival_ns: int) -> None:
        reason, sender, slot, *_ = self._datagrams.read(data)
        if not reason and slot <= self._judged:  # of a group that lies behind, or the same frame once more
            if arrival_ns - self._accepted_ns > _SILENCE_NS:
                self._start_again()
            else:
                reason = OTHER_TIME
        if not reason and sender in self._slots.get(slot, {}):
            reason = REPEATED
        if reason:
            self.refused[reason] += 1
            return
        self.heard[sender] += 1
        self._accepted_ns = arrival_ns
        self._slots.setdefault(slot, {})[sender] = arrival_ns, frame_in(data, self._config)
        self._close_slots(max(self._slots) - _WAITS)

    def _start_again(self) -> None:
        """The swarm counts its slots anew: they are judged anew, and have a file of their own."""
        self._close_slots(max(self._slots, default=0))
        self._judged, self._starts = -1, self._starts + 1
        self._rules.restart()
        if self.bag is None or self._path is None:
            return
        self.bag.close()
        if not self.bag.failure:
            path = self._path.with_stem(f"{self._path.stem}_{self._starts}")
            try:
                self.bag = RecordFile(path, self._config, self._custom)
            except DtsaError as error:
                self.bag.failure = str(error)

    def _close_slots(self, last: int) -> None:
        for slot in sorted(slot for slot in self._slots if slot <= last):
            self._close_slot(slot)
            self._judged = slot

    def _close_slot(self, slot: int) -> None:
        """Check a slot, and record it: its time is that of the first frame that was heard in it."""
        heard = dict(sorted(self._slots.pop(slot).items()))
        frames = {sender: data for sender, (_, data) in heard.items()}
        self._rules.check_slot(slot, frames)
        if self.bag is not None:
            # An old frame may have been sent again: records have their times in the order in which they are written.
            first_ns = self._recorded_ns = max(self._recorded_ns, min(at_ns for at_ns, _ in heard.values()))
            at, nothing = first_ns - self._zero_ns + names.TIME_ZERO_NS, [0] * len(heard)
            outcome = COLLISION if len(heard) > 1 else SUCCESS
            self.bag.write(at, pack_record(
                self._config.auth_session or 1, slot, at, self._config.steps, outcome, **frame_fields(frames, None),
                sent_ns=[at_ns - first_ns for at_ns, _ in heard.values()], lost=nothing, collided=nothing,
            ))  # fmt: skip

    def summary(self) -> dict[str, Any]:
        """What was heard, and what was found."""
        return {
            "heard": {f"cf{agent}": count for agent, count in sorted(self.heard.items())},
            "not_taken_in": dict(sorted(self.refused.items())),
            **self._listener.counts(),
            **self._rules.summary(),
        }

    def close(self) -> None:
        """End the record, and leave the air."""
        self._listener.close()
        if self.bag is not None:
            self.bag.close()
