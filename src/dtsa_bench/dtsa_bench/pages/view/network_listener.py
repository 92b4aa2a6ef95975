"""Agents on a network or a radio as a source of moments: a listener, which knows only what frames say."""

from __future__ import annotations

import select
import statistics
import time
from collections import Counter, deque

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.air.datagram import frame_in, link_of
from dtsa_agent.air.port import PortSettings
from dtsa_agent.air.ports import open_listener
from dtsa_agent.core import SwarmConfig, make_scenario
from dtsa_agent.core.errors import ConfigError, RemoteProtocolError
from dtsa_agent.core.frame import decode_extended, decode_frame
from dtsa_agent.core.plugins.entry_points import make_swarm
from dtsa_agent.core.station import (
    EARLY_COUNT,
    NO_FRAME,
    OTHER_TIME,
    REPEATED,
    TOO_EARLY,
    ParsedDatagram,
    StationSettings,
    check_joinable,
)
from dtsa_agent.keys import authenticator
from dtsa_bench.log.merge.joined import all_known_after
from dtsa_bench.log.rules import Judge
from dtsa_bench.pages.html import pack
from dtsa_bench.runs.config import REALTIME, RunConfig
from dtsa_channel_sim.model.verdict import COLLISION, SUCCESS

from .moments import UNKNOWN, Moments, run_info
from .track import Track

_PATIENCE_S = 0.02
_PERIOD_NS = 50_000_000  # from one moment to the next
_BURST = 64  # datagrams at a time: whatever comes, time goes on
_WAITS = 2  # slots that are kept open for frames that come late
_SILENCE_NS = 2_000_000_000  # after this a frame of an earlier time is of a swarm that began anew
_SHARE = 8  # of which the listener's time moves by a part with a frame
_LATENESS = 50  # frames
_NO_REASON = 255


class HeardRun:
    """What a listener makes of the frames of a swarm, slot by slot.

    :param air: name of the kind of port.
    :param first: the first slot that is shown.
    :param zero_ns: ns, CLOCK_MONOTONIC, when slot 0 began or would have begun.
    """

    def __init__(self, track: Track, config: SwarmConfig, air: str, first: int, zero_ns: int) -> None:
        self._track, self._config = track, config
        self.slot, self.zero_ns, self.heard_ns = first, zero_ns, 0
        self._scenario = make_scenario(config)
        self._tables = make_swarm(config, self._scenario, local=[], observers=[0])
        self._moments = Moments(self._scenario)
        self._judge = Judge(config)
        self._frames: dict[int, dict[int, tuple[bytes, bytes]]] = {}  # by slot, sender: with and without its tag
        self._last: dict[int, int] = {}  # slot of the last frame, by sender
        self._absent = set(range(1, config.agents + 1))
        self._lost: dict[int, int] = {}  # slot since when, of those that were heard before
        self._quiet = all_known_after(config)  # slots, in which every agent has had a turn
        self._late_ns: deque[int] = deque(maxlen=_LATENESS)
        self._every = max(1, round(_PERIOD_NS / config.slot_ns))  # slots from one moment to the next
        self._nobody = np.zeros(config.agents, np.uint16)  # whom they take for the sender, only the agents know
        self._reason = np.full(config.agents, _NO_REASON, np.uint8)
        seen = {"live": True, "control": False, "mode": air, "listener": True}
        track.begin(run_info(track.name, RunConfig(config, mode=REALTIME), self._scenario) | seen)

    def hear(self, said: ParsedDatagram, sealed: bytes, zero_ns: int, now_ns: int) -> str:
        """Takes in a frame of a slot that is still open; why not, or an empty text.

        :param sealed: the frame as it was on the air.
        :param zero_ns: ns, CLOCK_MONOTONIC, when slot 0 began by this frame.
        """
        if said.slot not in self._frames and len(self._frames) >= EARLY_COUNT:
            return TOO_EARLY
        frames = self._frames.setdefault(said.slot, {})
        if said.sender in frames:
            return REPEATED
        frames[said.sender] = sealed, said.frame
        self.heard_ns = now_ns
        self._late_ns.append(said.late_ns)
        off = zero_ns - self.zero_ns
        if off < -self._config.slot_ns // 2:  # a later time: all will take it over
            self.zero_ns = zero_ns
        else:
            self.zero_ns += min(off, self._config.slot_ns // 2) // _SHARE
        return ""

    def tell(self, refused: Counter[str], now_ns: int) -> None:
        """Hand over the slots that are over; `refused`: datagrams that were not accepted so far, by reason."""
        until = (now_ns - self.zero_ns) // self._config.slot_ns - _WAITS
        while self.slot < until:
            if self.slot % self._every == 0:
                self._tell_moment(refused)
            self._close(self.slot)
            self.slot += 1

    def _tell_moment(self, refused: Counter[str]) -> None:
        self._tables.estimate(self.slot)
        self._moments.place(self.slot, self._places())
        late = statistics.median(self._late_ns) / 1e6 if self._late_ns else 0.0
        more = {"lag_ms": round(late, 2), "refused": refused.total(), "age": pack(self._ages())}
        self._track.add(self._moments.take(self.slot, self._tables, self._nobody, None, self._absent, **more))

    def _places(self) -> NDArray[np.float64]:
        """(3, N) m, frame map, where the agents are: those that are lost where the last frame left them."""
        place = self._tables.estimate_position[0].copy()
        for agent, since in self._lost.items():
            if self._tables.sent_slot[0, agent - 1] <= since:  # else others hear it, and tell of it
                place[:, agent - 1] = self._tables.sent_position[0, :, agent - 1]
        return place

    def _ages(self) -> NDArray[np.uint16]:
        """(N,) tenths of slots since each was heard, also those that rest."""
        told = np.full(self._config.agents, UNKNOWN, np.uint16)
        for agent, last in self._last.items():
            told[agent - 1] = min(10 * (self.slot - 1 - last), UNKNOWN - 1)
        return told

    def _close(self, slot: int) -> None:
        self._scenario.advance(slot, self._tables)
        frames = self._frames.pop(slot, {})
        heard = [sender for sender, (_, frame) in sorted(frames.items()) if self._tables.hear(slot, frame)]
        self._tables.end(slot)
        if heard:
            self._moments.frames(slot, COLLISION if len(heard) > 1 else SUCCESS, heard, self._reason, None)
            self._judge.slot(slot, {sender: frames[sender][0] for sender in heard})
            broken, self._judge.broken = self._judge.broken, []
            for text in broken:
                self._moments.event(slot, "bad", text)
        for sender in heard:
            self._note(slot, sender, frames[sender][1])
        for agent, last in list(self._last.items()):
            if slot - last >= self._quiet:
                self._lose(slot, agent, f"cf{agent} has fallen silent")

    def _note(self, slot: int, sender: int, frame: bytes) -> None:
        """Who has come, and who leaves."""
        self._lost.pop(sender, None)
        if sender in self._absent:
            self._absent.discard(sender)
            self._moments.event(slot, "back", f"cf{sender} is heard")
        self._last[sender] = slot
        if self._config.policy_row.says_leaving:
            said = decode_extended(self._config.protocol_part(frame), self._config.extent_m)
            if said.leaving:
                self._lose(slot, sender, f"cf{sender} leaves")

    def _lose(self, slot: int, agent: int, text: str) -> None:
        del self._last[agent]
        self._absent.add(agent)
        self._lost[agent] = slot
        self._moments.event(slot, "lost", text)


class NetworkListener:
    """Listens to agents without taking part.

    :raises ConfigError: for a swarm that cannot fly by itself, a port that cannot be used, or without the key of
        sealed frames.
    """

    def __init__(self, track: Track, config: SwarmConfig, port: PortSettings) -> None:
        check_joinable(config.policy)
        if config.estimator_row.needs_everybody:
            raise ConfigError("estimator", config.estimator, "one that needs only what is heard")
        self._track, self._config = track, config
        link = link_of(config, port.properties)
        self._datagrams = StationSettings(config, link, authenticator(config))
        self._air, self._flight_ns = port.properties.name, link.flight_ns
        self._too_long_ns = self._datagrams.too_long_ns
        self._where = port.where
        self._listener = open_listener(port)
        self._run: HeardRun | None = None
        self.refused: Counter[str] = Counter()  # datagrams that were not taken in, by reason
        self.stopped = False

    def run(self) -> None:
        """Listens until ``stopped`` is set."""
        self._track.end(f"waiting for frames: {self._where}")
        with self._listener:
            while not self.stopped:
                select.select([self._listener], [], [], _PATIENCE_S)
                for datagram in self._listener.receive(_BURST):
                    if reason := self.take(datagram.data, datagram.arrival_ns, time.monotonic_ns()):
                        self.refused[reason] += 1
                self.pass_time(time.monotonic_ns())

    def take(self, data: bytes, arrival_ns: int, now_ns: int) -> str:
        """Take in a datagram (times: ns, CLOCK_MONOTONIC); why not, or an empty text."""
        said = self._datagrams.read(data)
        if said.fault:
            return said.fault
        if not self._is_frame(said.frame):
            return NO_FRAME
        zero_ns = arrival_ns - self._flight_ns - said.late_ns - said.slot * self._config.slot_ns
        run = self._run
        if run is not None and said.slot < run.slot and now_ns - run.heard_ns < _SILENCE_NS:
            return OTHER_TIME
        if run is None or said.slot < run.slot or run.zero_ns - zero_ns > self._too_long_ns:
            run = self._run = HeardRun(self._track, self._config, self._air, said.slot, zero_ns)
        return run.hear(said, frame_in(data, self._config), zero_ns, now_ns)

    def pass_time(self, now_ns: int) -> None:
        """Hand over the slots that are over; a swarm that stood still for too long starts a new run."""
        run = self._run
        if run is None:
            return
        if now_ns - run.zero_ns - run.slot * self._config.slot_ns > self._too_long_ns:
            self._run = None
        else:
            run.tell(self.refused, now_ns)

    def _is_frame(self, frame: bytes) -> bool:
        """Whether bytes are a frame: nothing else may say what time it is."""
        try:
            decode_frame(self._config.protocol_part(frame), self._config.extent_m)
        except RemoteProtocolError:
            return False
        return True
