"""Integration: swarms whose agents have clocks of their own and nobody who tells them the slot.

An event simulation on the channel's time line: exact to the nanosecond, and the same for the same seeds.
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import pytest
from drifting_clocks import to_channel, to_local
from dtsa_dev.protocol.experiment import FAR, still_scenario

from dtsa_agent.core import Swarm, SwarmConfig, decode_frame
from dtsa_agent.core.reference.timebase import LISTENING, RESTARTED, TimeBase
from dtsa_channel_sim import Air, Channel, ChannelConfig
from dtsa_channel_sim.model.clocks import AgentClock

S = 1_000_000_000


@dataclass(slots=True)
class Seen:
    """What happened on air."""

    frames: int = 0
    destroyed: list[int] = field(default_factory=list)  # ns: starts of frames that overlapped another one somewhere
    spread_ns: list[int] = field(default_factory=list)  # largest distance of two agents' slot starts, once a probe
    restarts: int = 0


class _Agent:
    """One agent: clock, time base, protocol."""

    def __init__(self, config: SwarmConfig, agent: int, clock: AgentClock, align: bool) -> None:
        self.clock = clock
        self.swarm = Swarm(config, still_scenario(config.agents, config.seed), local=[agent])
        self.swarm.active[:] = 0
        self.swarm.goal[0, 0] = FAR
        self.base = TimeBase(
            agents=config.agents, anchor_every=config.anchor_every, slot_ns=config.slot_ns, agent=agent,
            seed=config.seed,
        )  # fmt: skip
        self.align = align
        self.open: int | None = None
        self.on = False

    def forget(self) -> None:
        if self.open is not None:
            self.swarm.end(self.open)
        self.open = None
        self.swarm.restart(0)

    def take_slot(self, slot: int) -> bytes:
        """Begins a slot; returns the frame to send in it, if any."""
        if self.open is not None:
            self.swarm.end(self.open)
        self.open = slot
        return self.swarm.frame(0) if self.swarm.begin(slot) else b""


class OwnClocks:
    """The swarm, its clocks and its channel.

    :param start_ns: ns of the channel's time: when each agent is switched on.
    :param align: whether agents go on listening for the time once they have one; without it their slots drift apart.
    """

    def __init__(
        self, config: SwarmConfig, channel: ChannelConfig, clocks: Sequence[AgentClock], start_ns: Sequence[int],
        align: bool = True,
    ) -> None:  # fmt: skip
        self.config, self.seen = config, Seen()
        self._air: Air[tuple[int, int]] = Air(Channel(channel))
        self._delay_ns = 2 * channel.link_delay_ns
        self._airtime = channel.airtime
        self.agents = [_Agent(config, k + 1, clock, align) for k, clock in enumerate(clocks)]
        self._data: dict[tuple[int, int], bytes] = {}
        self._events: list[tuple[int, int, bool]] = []  # channel's ns, agent, switched on now
        for k, when in enumerate(start_ns):
            heapq.heappush(self._events, (when, k, True))

    def run(self, until_ns: int, probe_ns: int = 1_000_000_000) -> Seen:
        """Run until a moment of the channel's time; slot starts are compared at each probe."""
        probe = (self._events[0][0] // probe_ns + 1) * probe_ns
        while self._events[0][0] < until_ns:
            now, k, on = heapq.heappop(self._events)
            self._deliver(now)
            while probe <= now:
                self._compare(probe)
                probe += probe_ns
            self._turn(self.agents[k], k, now, on)
        return self.seen

    def _turn(self, agent: _Agent, k: int, now: int, on: bool) -> None:
        """Whatever an agent does at a moment it has been waiting for."""
        local = to_local(agent.clock, now)
        if on:
            agent.on = True
            agent.forget()
            self._push(k, agent.base.start(local))
            return
        if agent.base.state == LISTENING and not agent.base.wake(local):
            return
        slot = agent.base.slot(local)
        if slot is not None and slot != agent.open:
            data = agent.take_slot(slot)
            if data:
                self._air.begin((k, slot), k + 1, now, len(data))
                self._data[k, slot] = data
                self.seen.frames += 1
        if slot is not None:
            self._push(k, agent.base.slot_start_ns(slot + 1))

    def _push(self, k: int, local_ns: int) -> None:
        heapq.heappush(self._events, (to_channel(self.agents[k].clock, local_ns), k, False))

    def _deliver(self, now: int) -> None:
        for verdict in self._air.settle(now):
            sender, slot = verdict.frame_id
            data = self._data.pop((sender, slot))
            if verdict.collided:
                self.seen.destroyed.append(verdict.start_ns)
            for k in verdict.received.nonzero()[0]:
                self._hear(int(k), data, verdict.arrival_ns)

    def _hear(self, k: int, data: bytes, arrival_ns: int) -> None:
        agent = self.agents[k]
        if not agent.on:
            return
        local = to_local(agent.clock, arrival_ns)
        start = local - self._airtime.total_ns(len(data)) - self._delay_ns // 2
        listens = agent.align or agent.base.state == LISTENING
        if listens and agent.base.hear(decode_frame(data).slot, start) == RESTARTED:
            self.seen.restarts += 1
            agent.forget()
            slot = agent.base.slot(local)
            assert slot is not None
            agent.take_slot(slot)
            self._push(k, agent.base.slot_start_ns(slot + 1))
        if agent.open is not None:
            agent.swarm.hear(agent.open, data)

    def _compare(self, at_ns: int) -> None:
        """Distance of the agents' slot starts around a moment, in the channel's time; -1 unless all are in one time."""
        starts = []
        slots = set()
        for agent in self.agents:
            slot = agent.base.slot(to_local(agent.clock, at_ns) + self.config.slot_ns // 2)
            if slot is None:
                self.seen.spread_ns.append(-1)
                return
            slots.add(slot)
            starts.append((slot, agent))
        if max(slots) - min(slots) > 1:
            self.seen.spread_ns.append(-1)
            return
        times = [to_channel(agent.clock, agent.base.slot_start_ns(max(slots))) for _, agent in starts]
        self.seen.spread_ns.append(max(times) - min(times))


def swarm(agents: int, loss: float, align: bool = True, together: bool = False, **more: Any) -> OwnClocks:
    """Clocks that show anything at all and drift by up to 50 ppm; agents are switched on within three seconds."""
    draw = random.Random(agents)
    config = SwarmConfig(agents=agents, policy="lease", avoider="none", seed=agents)
    clocks = [
        AgentClock(offset_ns=draw.randrange(10**12), drift_ppb=draw.randint(-50_000, 50_000)) for _ in range(agents)
    ]
    channel = ChannelConfig(agents=agents, slot_ns=config.slot_ns, seed=1, loss=loss, **more)
    starts = [0 if together else draw.randrange(3 * S) for _ in range(agents)]
    return OwnClocks(config, channel, clocks, starts, align)


@pytest.mark.parametrize("loss", [0.0, 0.3])
@pytest.mark.parametrize("together", [False, True])
def test_cold_start(loss: float, together: bool) -> None:
    run = swarm(7, loss, together=together)
    seen = run.run(20 * S)
    assert all(0 <= spread < 200_000 for spread in seen.spread_ns[8:])
    assert all(when < 8 * S for when in seen.destroyed)
    for agent in run.agents:
        assert not agent.swarm.lease_status(0)["probation"]
        assert (agent.swarm.sent_slot > 0).all()
    assert seen.frames > 1500


def test_two_groups_meet() -> None:
    """Each finds a time of its own; then they hear each other, and one takes the other's."""
    run = swarm(8, 0.1, schedule=({"slot": 0, "until": 2000, "partition": [[1, 2, 3, 4], [5, 6, 7, 8]]},))
    before = run.run(19 * S)
    assert max(before.spread_ns[10:18]) == -1
    seen = run.run(40 * S)
    assert all(0 <= spread < 200_000 for spread in seen.spread_ns[26:])
    assert [when for when in seen.destroyed if when > 26 * S] == []
    assert not any(agent.swarm.lease_status(0)["probation"] for agent in run.agents)
    assert 4 <= sum(agent.base.restarts for agent in run.agents) <= 8


@pytest.mark.parametrize(("loss", "burst_length"), [(0.5, 0.0), (0.2, 20.0)])
def test_ten_minutes_of_drift(loss: float, burst_length: float) -> None:
    seen = swarm(6, loss, burst_length=burst_length).run(600 * S)
    assert all(0 <= spread <= 200_000 for spread in seen.spread_ns[10:])
    assert [when for when in seen.destroyed if when > 10 * S] == []


def test_without_alignment_slots_overlap() -> None:
    seen = swarm(6, 0.2, align=False).run(240 * S)
    assert max(seen.spread_ns[:100]) > 2_000_000
    assert len(seen.destroyed) > 100
