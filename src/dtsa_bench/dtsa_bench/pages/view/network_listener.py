"""Agents on a network or a radio as a source of moments: a listener, which knows only what frames say."""

from __future__ import annotations

import select
import statistics
import time
from collections import Counter, deque

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.air.port import PortSettings, frame_in, link_of, open_port
from dtsa_agent.core import SwarmConfig, make_scenario
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.frame import decode_extended
from dtsa_agent.core.plugins import make_swarm
from dtsa_agent.core.station import (
    EARLY_COUNT,
    OTHER_TIME,
    REPEATED,
    TOO_EARLY,
    ParsedDatagram,
    StationSettings,
    check_joinable,
)
from dtsa_agent.keys import authenticator
from dtsa_bench.log.merged_flight import slots_until_all_known
from dtsa_bench.log.rules import RuleChecker
from dtsa_bench.pages.html import pack
from dtsa_bench.runs.config import REALTIME, RunConfig
from dtsa_channel_sim.model.verdict import COLLISION, SUCCESS

from .history import UNKNOWN, MomentBuilder, RunHistory

_POLL_S = 0.02
_BURST = 64  # datagrams at a time: however many arrive, time goes on
_OPEN_SLOTS = 2  # for frames that come late
_SILENCE_NS = 2_000_000_000  # after this a frame of an earlier time is of a swarm that was restarted
_SHARE = 8  # the listener's time moves by this part of the offset of a frame
_LATENESS = 50  # frames
_NO_REASON = 255


class ListenedRun:
    """A run as a listener knows it by the frames of the swarm, slot by slot.

    :param port: name of the kind of port.
    :param first: the first slot that is shown.
    :param zero_ns: ns, CLOCK_MONOTONIC, when slot 0 began or would have begun.
    """

    def __init__(self, history: RunHistory, config: SwarmConfig, port: str, first: int, zero_ns: int) -> None:
        self._config = config
        self.slot, self.zero_ns, self.received_ns = first, zero_ns, 0
        self._scenario = make_scenario(config)
        self._tables = make_swarm(config, self._scenario, local=[], observers=[0])
        listener = {"live": True, "control": False, "mode": port, "listener": True}
        run, everybody = RunConfig(config, mode=REALTIME), range(1, config.agents + 1)
        self._builder = MomentBuilder(history, run, self._scenario, listener, absent=everybody)
        self._rules = RuleChecker(config)
        self._frames: dict[int, dict[int, tuple[bytes, bytes]]] = {}  # by slot, sender: with and without its tag
        self._last: dict[int, int] = {}  # slot of the last frame, by sender
        self._lost: dict[int, int] = {}  # slot since when, of agents that were heard before
        self._quiet = slots_until_all_known(config)  # slots, in which every agent has had a turn
        self._late_ns: deque[int] = deque(maxlen=_LATENESS)
        self._no_choice = np.zeros(config.agents, np.uint16)  # only the agents know whom they choose
        self._no_reason = np.full(config.agents, _NO_REASON, np.uint8)

    def receive(self, datagram: ParsedDatagram, signed: bytes, zero_ns: int, now_ns: int) -> str:
        """Accept the frame of a slot that is still open; return why not, or an empty text.

        :param signed: the frame as it was on the air.
        :param zero_ns: ns, CLOCK_MONOTONIC, when slot 0 began by this frame.
        """
        if datagram.slot not in self._frames and len(self._frames) >= EARLY_COUNT:
            return TOO_EARLY
        frames = self._frames.setdefault(datagram.slot, {})
        if datagram.sender in frames:
            return REPEATED
        frames[datagram.sender] = signed, datagram.frame
        self.received_ns = now_ns
        self._late_ns.append(datagram.late_ns)
        offset = zero_ns - self.zero_ns
        if offset < -self._config.slot_ns // 2:  # a later time: all agents will adopt it
            self.zero_ns = zero_ns
        else:
            self.zero_ns += min(offset, self._config.slot_ns // 2) // _SHARE
        return ""

    def advance(self, refused: Counter[str], now_ns: int) -> None:
        """Close the slots that are over; `refused`: datagrams that were not accepted so far, by reason."""
        end = (now_ns - self.zero_ns) // self._config.slot_ns - _OPEN_SLOTS
        while self.slot < end:
            if self.slot % self._builder.period == 0:
                self._add_moment(refused)
            self._close_slot(self.slot)
            self.slot += 1

    def _add_moment(self, refused: Counter[str]) -> None:
        self._tables.estimate(self.slot)
        self._builder.add_positions(self.slot, self._positions())
        late = statistics.median(self._late_ns) / 1e6 if self._late_ns else 0.0
        more = {"lag_ms": round(late, 2), "refused": refused.total(), "age": pack(self._ages())}
        self._builder.append_moment(self.slot, self._tables, self._no_choice, None, **more)

    def _positions(self) -> NDArray[np.float64]:
        """(3, N) m, frame map, where the agents are: those that are lost where the last frame left them."""
        position = self._tables.estimate_position[0].copy()
        for agent, since in self._lost.items():
            if self._tables.sent_slot[0, agent - 1] <= since:  # else others hear it, and report it
                position[:, agent - 1] = self._tables.sent_position[0, :, agent - 1]
        return position

    def _ages(self) -> NDArray[np.uint16]:
        """(N,) tenths of slots since each was heard, agents that hover included."""
        ages = np.full(self._config.agents, UNKNOWN, np.uint16)
        for agent, last in self._last.items():
            ages[agent - 1] = min(10 * (self.slot - 1 - last), UNKNOWN - 1)
        return ages

    def _close_slot(self, slot: int) -> None:
        self._scenario.advance(slot, self._tables)
        frames = self._frames.pop(slot, {})
        senders = [sender for sender, (_, frame) in sorted(frames.items()) if self._tables.hear(slot, frame)]
        self._tables.end(slot)
        if senders:
            self._builder.add_frames(slot, COLLISION if len(senders) > 1 else SUCCESS, senders, self._no_reason, None)
            self._rules.check_slot(slot, {sender: frames[sender][0] for sender in senders})
            broken, self._rules.broken = self._rules.broken, []
            for text in broken:
                self._builder.add_event(slot, "bad", text)
        for sender in senders:
            self._note_presence(slot, sender, frames[sender][1])
        for agent, last in list(self._last.items()):
            if slot - last >= self._quiet:
                self._lose(slot, agent, f"cf{agent} has fallen silent")

    def _note_presence(self, slot: int, sender: int, frame: bytes) -> None:
        """Note that an agent is heard, and whether it leaves."""
        self._lost.pop(sender, None)
        if sender in self._builder.absent:
            self._builder.regain(slot, sender, f"cf{sender} is heard")
        self._last[sender] = slot
        config = self._config
        if config.policy_row.says_leaving and decode_extended(config.protocol_part(frame), config.extent_m).leaving:
            self._lose(slot, sender, f"cf{sender} leaves")

    def _lose(self, slot: int, agent: int, text: str) -> None:
        del self._last[agent]
        self._lost[agent] = slot
        self._builder.lose(slot, agent, text)


class NetworkListener:
    """Listens to agents without taking part.

    :raises ConfigError: for a swarm that cannot fly by itself, a port that cannot be used, or without the key of
        signed frames.
    """

    def __init__(self, history: RunHistory, config: SwarmConfig, port: PortSettings) -> None:
        check_joinable(config.policy)
        if config.estimator_row.needs_everybody:
            raise ConfigError("estimator", config.estimator, "one that needs only what is heard")
        self._history, self._config, self._port = history, config, port
        link = link_of(config, port.properties)
        self._datagrams = StationSettings(config, link, authenticator(config))
        self._flight_ns, self._too_long_ns = link.flight_ns, self._datagrams.too_long_ns
        self._listener = open_port(port)
        self._run: ListenedRun | None = None
        self.refused: Counter[str] = Counter()  # datagrams that were not accepted, by reason
        self.stopped = False

    def run(self) -> None:
        """Listen until ``stopped`` is set."""
        self._history.state = f"waiting for frames: {self._port.destination}"
        with self._listener:
            while not self.stopped:
                select.select([self._listener], [], [], _POLL_S)
                for datagram in self._listener.receive(_BURST):
                    if reason := self.receive(datagram.data, datagram.arrival_ns, time.monotonic_ns()):
                        self.refused[reason] += 1
                self.advance(time.monotonic_ns())

    def receive(self, data: bytes, arrival_ns: int, now_ns: int) -> str:
        """Accept a datagram (times: ns, CLOCK_MONOTONIC); return why not, or an empty text."""
        datagram = self._datagrams.read(data)
        if datagram.fault:
            return datagram.fault
        slot, run = datagram.slot, self._run
        zero_ns = arrival_ns - self._flight_ns - datagram.late_ns - slot * self._config.slot_ns
        if run is not None and slot < run.slot and now_ns - run.received_ns < _SILENCE_NS:
            return OTHER_TIME
        if run is None or slot < run.slot or run.zero_ns - zero_ns > self._too_long_ns:
            run = self._run = ListenedRun(self._history, self._config, self._port.properties.name, slot, zero_ns)
        return run.receive(datagram, frame_in(data, self._config), zero_ns, now_ns)

    def advance(self, now_ns: int) -> None:
        """Close the slots that are over; a swarm that stood still for too long starts a new run."""
        run = self._run
        if run is None:
            return
        if now_ns - run.zero_ns - run.slot * self._config.slot_ns > self._too_long_ns:
            self._run = None
        else:
            run.advance(self.refused, now_ns)
