"""Integration: stations whose agents have clocks of their own, over the channel's medium on its time line.

An event simulation, exact to the nanosecond, and the same for the same seeds.
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from drifting_clocks import to_channel, to_local
from dtsa_dev.protocol.experiment import FAR, still_scenario

from dtsa_agent.core import Swarm, SwarmConfig
from dtsa_agent.core.station import Link, Station, StationSettings
from dtsa_channel_sim import Air, Channel, ChannelConfig
from dtsa_channel_sim.model.config import AgentClock, ClockConfig, make_clocks

S = 1_000_000_000
TRUST_NS = 1_000_000


class OwnClocks:
    """Stations on a channel, switched on at `start_ns`, or all with slot 0; jitter: standard deviation of sends."""

    def __init__(
        self, config: SwarmConfig, channel: ChannelConfig, clocks: Sequence[AgentClock],
        start_ns: Sequence[int] | None = None, jitter_ns: int = 0,
    ) -> None:  # fmt: skip
        self.config, self.clocks, self._air = config, clocks, Air(Channel(channel))
        flight_ns = channel.airtime.total_ns(config.frame_length) + channel.link_delay_ns
        link = Link(b"", says_late=False, names=0, flight_ns=flight_ns, trust_ns=TRUST_NS)
        self._random = np.random.default_rng(channel.seed)
        self._jitter_ns = jitter_ns
        self.stations: list[Station | None] = [None] * config.agents
        self.collided: list[int] = []  # ns: starts of frames that overlapped another one at a receiver
        self.spread_ns: list[int] = []  # largest distance of two agents' slot starts, once a second; -1: several times
        self._link, self._count = link, 0
        self._data: dict[int, bytes] = {}
        self._events = [(0 if start_ns is None else start_ns[k], k) for k in range(config.agents)]
        self._together = start_ns is None
        heapq.heapify(self._events)

    def _start(self, k: int, local_ns: int) -> Station:
        config, scenario = self.config, still_scenario(self.config.agents, self.config.seed)
        swarm = Swarm(config, scenario, local=[k + 1])
        swarm.active[:] = 0
        swarm.goal[0, 0] = FAR
        origin = local_ns if self._together else None
        return Station(swarm, StationSettings(config, self._link, id=k + 1, origin_ns=origin), local_ns)

    def run(self, until_ns: int) -> None:
        probe = len(self.spread_ns) * S
        while self._events[0][0] < until_ns:
            now, k = heapq.heappop(self._events)
            self._deliver(now)
            while probe <= now:
                self.spread_ns.append(self._spread(probe))
                probe += S
            self._step(k, now)

    def _step(self, k: int, now: int) -> None:
        clock = self.clocks[k]
        local = to_local(clock, now)
        station = self.stations[k]
        if station is None:
            station = self.stations[k] = self._start(k, local)
        while True:
            due, data = station.step(local)
            if data:
                jitter = int(self._jitter_ns * self._random.standard_normal()) if self._jitter_ns else 0
                self._air.begin(self._count, k + 1, now + max(0, jitter), len(data))
                self._data[self._count] = data
                self._count += 1
                station.sent(local, True)
            elif due > local:
                break
        heapq.heappush(self._events, (max(now + 1, to_channel(clock, due)), k))

    def _deliver(self, now: int) -> None:
        for verdict in self._air.resolve(now):
            data = self._data.pop(verdict.frame_id)
            if verdict.collided:
                self.collided.append(verdict.start_ns)
            for k in verdict.received.nonzero()[0].tolist():
                station = self.stations[k]
                if station is not None:
                    station.receive(data, to_local(self.clocks[k], verdict.arrival_ns))

    def _spread(self, at_ns: int) -> int:
        slot_ns, starts = self.config.slot_ns, []
        for clock, station in zip(self.clocks, self.stations, strict=True):
            if station is None or station.slot < 0:
                return -1
            local = to_local(clock, at_ns)
            slot = (local - station.slot_start_ns(0) + slot_ns // 2) // slot_ns
            starts.append((slot, clock, station))
        common = max(slot for slot, *_ in starts)
        if common - min(slot for slot, *_ in starts) > 1:
            return -1
        times = [to_channel(clock, station.slot_start_ns(common)) for _, clock, station in starts]
        return max(times) - min(times)

    def all_are_known(self) -> bool:
        """Whether no agent is on probation any more, and all have sent."""
        return all(
            station is not None and not station.probation() and station.swarm.sent_slot.min() > 0
            for station in self.stations
        )


def lease(agents: int, loss: float, together: bool = False, schedule: Any = ()) -> OwnClocks:
    """Clocks that show anything at all and drift by up to 50 ppm; agents are switched on within three seconds."""
    draw = random.Random(agents)
    config = SwarmConfig(agents=agents, policy="lease", avoider="none", seed=agents)
    clocks = [
        AgentClock(offset_ns=draw.randrange(10**12), drift_ppb=draw.randint(-50_000, 50_000)) for _ in range(agents)
    ]
    channel = ChannelConfig(agents=agents, slot_ns=config.slot_ns, seed=1, loss=loss, schedule=schedule)
    return OwnClocks(config, channel, clocks, [0 if together else draw.randrange(3 * S) for _ in range(agents)])


@pytest.mark.parametrize("loss", [0.0, 0.3])
@pytest.mark.parametrize("together", [False, True])
def test_cold_start(loss: float, together: bool) -> None:
    run = lease(7, loss, together)
    run.run(20 * S)
    assert all(0 <= spread < 200_000 for spread in run.spread_ns[8:])
    assert all(when < 8 * S for when in run.collided)
    assert run.all_are_known()
    assert sum(station.status.sent for station in run.stations if station) > 1500


def test_two_groups_meet() -> None:
    """Each finds a time of its own; then they hear each other, and one takes the other's."""
    run = lease(8, 0.1, schedule=({"slot": 0, "until": 2000, "partition": [[1, 2, 3, 4], [5, 6, 7, 8]]},))
    run.run(19 * S)
    assert max(run.spread_ns[10:18]) == -1
    before = [station.status.restarts for station in run.stations if station]
    run.run(40 * S)
    assert all(0 <= spread < 200_000 for spread in run.spread_ns[26:])
    assert [when for when in run.collided if when > 26 * S] == []
    assert run.all_are_known()
    after = [station.status.restarts for station in run.stations if station]
    assert sum(after) - sum(before) == 4  # one group goes on as it is


def test_two_minutes_of_drift() -> None:
    run = lease(6, 0.2)
    run.run(120 * S)
    assert all(0 <= spread <= 200_000 for spread in run.spread_ns[10:])
    assert [when for when in run.collided if when > 10 * S] == []


def tdma(loss: float, burst_length: float = 0.0) -> OwnClocks:
    """A minute of TDMA; crystals over the whole range, in no order, so that neighbours meet."""
    config = SwarmConfig(agents=18, policy="tdma", avoider="none")
    clocks = make_clocks(ClockConfig(drift_ppm=50, offset_ns=10**12, seed=1), 18)
    drifts = np.random.default_rng(1).permutation(np.linspace(-50_000, 50_000, 18)).astype(int)
    clocks = [clock._replace(drift_ppb=drift) for clock, drift in zip(clocks, drifts.tolist(), strict=True)]
    channel = ChannelConfig(agents=18, slot_ns=config.slot_ns, seed=1, loss=loss, burst_length=burst_length)
    run = OwnClocks(config, channel, clocks, jitter_ns=5000)
    run.run(60 * S)
    return run


@pytest.mark.parametrize(("loss", "burst_length"), [(0.0, 0.0), (0.2, 0.0), (0.5, 0.0), (0.2, 20.0)])
def test_slots_stay_together(loss: float, burst_length: float) -> None:
    run = tdma(loss, burst_length)
    assert max(run.spread_ns[2:]) < 200_000
    assert min(run.spread_ns[2:]) >= 0
    assert run.collided == []


def test_agents_that_hear_nothing_drift_apart() -> None:
    assert max(tdma(1.0).spread_ns) > 5_000_000
