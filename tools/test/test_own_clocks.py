"""Swarms whose agents have clocks of their own and nobody who tells them the slot."""

from __future__ import annotations

import random

import pytest
from dtsa_dev.protocol.own_clocks import OwnClocks

from dtsa_agent.core import SwarmConfig
from dtsa_channel_sim import ChannelConfig
from dtsa_channel_sim.model.clocks import AgentClock

S = 1_000_000_000


def swarm(
    agents: int, loss: float, align: bool = True, together: bool = False, schedule: tuple[dict[str, object], ...] = ()
) -> OwnClocks:
    """Clocks that show anything at all and drift by up to 50 ppm; agents are switched on within three seconds."""
    draw = random.Random(agents)
    config = SwarmConfig(agents=agents, policy="lease", avoider="none", seed=agents)
    clocks = [
        AgentClock(offset_ns=draw.randrange(10**12), drift_ppb=draw.randint(-50_000, 50_000), agent=k + 1)
        for k in range(agents)
    ]
    channel = ChannelConfig(agents=agents, slot_ns=config.slot_ns, seed=1, loss=loss, schedule=schedule)  # type: ignore[arg-type]
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
    run = swarm(8, 0.1, schedule=({"slot": 0, "until": 2000, "partition": "1-4 | 5-8"},))
    before = run.run(19 * S)
    assert max(before.spread_ns[10:18]) == -1
    seen = run.run(40 * S)
    assert all(0 <= spread < 200_000 for spread in seen.spread_ns[26:])
    assert [when for when in seen.destroyed if when > 26 * S] == []
    assert not any(agent.swarm.lease_status(0)["probation"] for agent in run.agents)
    assert 4 <= sum(agent.base.restarts for agent in run.agents) <= 8


def test_ten_minutes_of_drift() -> None:
    seen = swarm(6, 0.2).run(600 * S)
    assert all(0 <= spread <= 200_000 for spread in seen.spread_ns[10:])
    assert [when for when in seen.destroyed if when > 10 * S] == []


def test_without_alignment_slots_overlap() -> None:
    seen = swarm(6, 0.2, align=False).run(240 * S)
    assert max(seen.spread_ns[:100]) > 2_000_000
    assert len(seen.destroyed) > 100
