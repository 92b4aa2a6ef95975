"""One live agent: a station, connected with a clock, a port and a vehicle.

The rules are the station's (``core.station``). The loop sleeps until the station is due, hands in what has arrived,
sends what the station gives, and flies the vehicle.
"""

from __future__ import annotations

import gc
import select
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.plugins import make_swarm
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.station import ClockMap, Station, StationSettings, check_joinable
from dtsa_agent.core.swarm import Swarm
from dtsa_agent.keys import authenticator, check_session
from dtsa_agent.priority import realtime_thread, wake_precisely
from dtsa_agent.stop import Stop

from .port import Port, check_fits, link_of
from .record import AgentReports, ReceivedFrame, SlotRecord, SlotRecords, Watcher
from .settings import AgentSettings

_SECOND, _NEVER = 1_000_000_000, 1 << 62  # ns
_SIGNAL_POLL_S = 0.05  # a signal is noticed after this time at the latest
_LEAVING_NS = 900_000_000  # a signal is obeyed within a second
_BURST = 16  # datagrams that are read at a time: whatever comes, the own slots go on
_BURSTS = 256  # more than wait in any port


class AgentVehicle:
    """The vehicle of one agent: the point mass of the simulator, unless a subclass flies another one."""

    def is_ready(self) -> bool:
        """Whether it is known where the vehicle is: the agent listens and sends only from then on."""
        return True

    def sense(self, swarm: Swarm) -> None:
        """Write where the vehicle is, and how it moves, into its agent, between two slots."""

    def before_slot(self, swarm: Swarm) -> Callable[[int], None] | None:
        """Return what a station calls before each slot of the agent; None: there is nothing to sense."""
        return None if type(self).sense is AgentVehicle.sense else lambda slot: self.sense(swarm)

    def hover(self, swarm: Swarm) -> None:
        """Hold the vehicle where it is: the agent has no slots yet. Called again and again until it has."""

    def fly(self, swarm: Swarm, slot: int) -> None:
        """Fly through a slot, after the agent has decided."""
        swarm.fly(slot)


class LiveAgent:
    """An agent that begins its slots by its own clock, and whose frames go over a port.

    :param own: this agent.
    :param config: the settings that all agents share.
    :param port: what carries its datagrams; the caller keeps it open while the agent flies.
    :param watcher: follows what happens; None: nothing does.
    :param vehicle: what it flies; None: a simulated one.
    :param log: prints a line in flight; None: nothing is printed.
    :param show: shows a line in place of the one before; None: nothing is shown.
    :raises ConfigError: for an id or a policy that cannot fly here, or a missing key or session.
    """

    def __init__(
        self, own: AgentSettings, config: SwarmConfig, port: Port, watcher: Watcher | None = None,
        vehicle: AgentVehicle | None = None, log: Callable[[str], None] | None = None,
        show: Callable[[str], None] | None = None,
    ) -> None:  # fmt: skip
        if own.id > config.agents:
            raise ConfigError("id", own.id, f"1 to {config.agents}, the number of agents")
        check_joinable(config.policy)
        check_session(config)
        check_fits(config, port.properties)
        link = link_of(config, port.properties)
        self.own, self.config, self.port, self.watcher = own, config, port, watcher
        self._settings = StationSettings(config, link, authenticator(config), own.id, own.quorum)
        self.swarm = make_swarm(config, local=[own.id])
        self.clock = ClockMap(own.clock_offset_ns, own.clock_drift_ppb, time.monotonic_ns())
        self._header = port.properties.header(config.auth) if port.properties.varies else None
        self._vehicle = vehicle or AgentVehicle()
        self.station = self._start()
        self.slot = -1  # the present slot
        port.log = log
        self.reports = AgentReports(own.id, config.slot_ms, log, time.monotonic_ns(), show)
        self._flight_ns = link.flight_ns
        self._no_priority = ""  # why it has none
        self._leaves_by: int | None = None  # CLOCK_MONOTONIC, ns
        self._signals = 0

    def _start(self) -> Station:
        every_frame, sense = bool(self.watcher or self._header is not None), self._vehicle.before_slot(self.swarm)
        now = self.clock.local_ns(time.monotonic_ns())
        self._records = SlotRecords(self.watcher)
        return Station(self.swarm, self._settings, now, sense, self, every_frame)

    # The loop.

    def run(self, stop: Stop) -> None:
        """Fly until a signal comes or the time is over; with policy ``lease`` it first announces that it leaves."""
        wake_precisely()
        gc.collect()
        gc.freeze()  # nothing made so far is garbage: do not look at it again and again
        with realtime_thread(self.own.priority) as self._no_priority:
            self._run(stop)
        self.reports.ended_ns = time.monotonic_ns()

    def _run(self, stop: Stop) -> None:
        began = self.reports.began_ns = time.monotonic_ns()
        end = began + round(self.own.duration_s * _SECOND) if self.own.duration_s else _NEVER
        clock, port, now = self.clock, self.port, began
        while True:
            for _ in range(_BURSTS):  # what came before it listens would have it begin in the past
                if not port.receive(_BURST):
                    break
            if self._vehicle.is_ready():
                break
            now = time.monotonic_ns()
            self.reports.state("waits for the vehicle's odometry", now)
            if stop or now >= end:
                return
            time.sleep(_SIGNAL_POLL_S)
        station = self.station = self._start()
        step = station.step
        local, deliver, descriptor = clock.local_ns, port.deliver, [port.fileno()]
        while not ((stop.signal or now >= end) and self._has_ended(stop)):
            count = deliver(station, clock, _BURST)
            due = shown = -1
            while due <= shown:
                now = time.monotonic_ns()
                shown = local(now)
                due, datagram = step(shown)
                if datagram:
                    self._send(datagram, shown)
                elif station.slot != self.slot:
                    self._fly(station.slot, now)
            if self.slot < 0:
                self.reports.state("listens for others", now)
                self._vehicle.hover(self.swarm)
            if count == _BURST:
                continue
            left = min((clock.monotonic_ns(due) - time.monotonic_ns()) / 1e9, _SIGNAL_POLL_S)
            if left <= 0:
                continue
            if station.awaits_frame(shown):
                select.select(descriptor, (), (), left)
            else:  # one wake-up a slot: datagrams wait in the port, which has noted when they arrived
                time.sleep(left)
        self._records.close()

    def _has_ended(self, stop: Stop) -> bool:
        """Whether to end now: after a second signal, when it has announced that it leaves, or has no time left to."""
        now = time.monotonic_ns()
        if self._leaves_by is None:
            if not self.config.policy_row.says_leaving or self.slot < 0:
                return True
            turns = (self.config.main_every + 1) * self.config.agents * self.config.slot_ns
            self._leaves_by, self._signals = now + min(_LEAVING_NS, turns), stop.count
            self.station.leave()
        return self.station.status.gone or now >= self._leaves_by or stop.count > self._signals

    def _fly(self, slot: int, now: int) -> None:
        """A slot has begun: fly through it."""
        self.slot = slot
        self._vehicle.fly(self.swarm, slot)
        self.reports.slot(self.station, now)

    def _send(self, datagram: bytes, shown: int) -> None:
        """Hand a datagram to the port; shown: what the own clock showed when it was due."""
        refusal = self.port.send(datagram)
        now = time.monotonic_ns()
        self.station.sent(self.clock.local_ns(now), not refusal)
        if refusal:
            self.reports.count_unsent(refusal, now)
            return
        self.reports.count_transmission(max(0, shown - self.station.slot_start_ns(self.station.slot)), now)
        self._records.transmit(shown, datagram)

    # Events of the station.

    def opened(self, slot: int, start_ns: int, is_first: bool) -> None:
        if self.watcher is None:
            return
        swarm = self.swarm
        self._records.open(SlotRecord(
            slot, start_ns, is_first, int(swarm.present[0]), int(swarm.chosen[0]), int(swarm.reason[0]),
            int(swarm.digest[0]), float(swarm.score[0]), swarm.track[:, :, 0].copy(), swarm.velocity[:, 0].copy(),
            swarm.command[:, 0].copy(), swarm.goal[:, 0].copy(),
        ))  # fmt: skip

    def restarted(self, slot: int) -> None:
        self._records.restart()
        self.slot = slot
        self.reports.join()

    def heard(self, sender: int, slot: int, datagram: bytes, arrival_ns: int, accepted: bool) -> None:
        if accepted and self._header is not None:
            start, late = self.station.slot_start_ns(slot), self._header.late_ns(datagram)
            self.reports.count_arrival(arrival_ns - start - self._flight_ns - late)
        if self.watcher is not None:
            self._records.receive(ReceivedFrame(sender, slot, arrival_ns, datagram, accepted))

    def refused(self, fault: str, datagram: bytes, arrival_ns: int) -> None:
        self.reports.count_refused(fault, time.monotonic_ns())
        if self.watcher is not None:
            self.watcher.refused(fault, datagram, arrival_ns)

    def summary(self) -> dict[str, Any]:
        """Return the results of the flight, as plain values."""
        swarm, station = self.swarm, self.station
        away = swarm.goal[:, 0] - swarm.position[:, 0]
        return {
            "id": self.own.id,
            "agents": self.config.agents,
            "policy": self.config.policy,
            "slot_ms": self.config.slot_ms,
            "sealed": self.config.auth,
            "no_priority": self._no_priority,
            "quorum": self.own.quorum,
            **self.reports.summary(
                station.status, station.longest_gap(), malformed=swarm.malformed, foreign=swarm.foreign
            ),
            "heard_of": sorted(int(k) + 1 for k in np.flatnonzero(swarm.sent_slot[0] >= 0) if k + 1 != self.own.id),
            **self.port.counts(),
            "position_m": [round(float(x), 4) for x in swarm.position[:, 0]],
            "arrived": bool(np.sqrt((away * away).sum()) <= self.config.r_min and swarm.final[0]),
        }
