"""Integration: interfaces that get another address, go, and are made anew, on hosts of their own, in flight."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from dtsa_dev.network.hosts import why_not
from trials import Trial, under_way

from dtsa_agent.core import SwarmConfig
from dtsa_bench.log.agent_bag import read
from dtsa_bench.log.merge.merge import Merge, is_verified

pytestmark = pytest.mark.skipif(bool(why_not()), reason=why_not() or "hosts can be made")
_LONG_S = 30.0


SWARM = SwarmConfig(agents=4, policy="lease", slot_ms=20.0, auth=True, auth_session=5, scenario="waypoints")


@pytest.mark.realtime
def test_agents_fly_on_when_their_interfaces_change(tmp_path: Path) -> None:
    """cf2 gets another address, cf3 has no interface for a while, that of cf4 is off for a while."""
    with under_way(Trial(SWARM, seconds=4.0, spread_s=0.2), tmp_path) as flight:
        flight.carry(1.0)
        joined = flight.hosts
        joined[2].readdress("10.68.9.9")
        joined[3].unplug()
        joined[4].switch(up=False)
        flight.carry(2.0)
        joined[3].plug(joined[3].address)
        joined[4].switch(up=True)
        flight.wait_for_frames((2, 3, 4))
        flight.carry(1.0)
        flight.end()
        found = Merge(flight.bags()).summary()
    assert is_verified(found), found["decisions_again"]
    for agent in (1, 2, 3, 4):  # all hear the others again
        log = read(tmp_path / f"cf{agent}-1").log
        assert log.heard is not None
        last = log.heard.part(len(log) - 30, len(log))
        assert set(last.sender[~last.before].tolist()) >= {1, 2, 3, 4} - {agent}
    summaries = [json.loads((tmp_path / f"cf{agent}-1" / "summary.json").read_text()) for agent in (1, 2, 3, 4)]
    assert [one["interface_changes"] for one in summaries] == [0, 1, 1, 0]
    assert summaries[3]["unsent_because"]["Network is unreachable"] > 0
    errors = {agent: (tmp_path / f"cf{agent}-1.err").read_text() for agent in (1, 2, 3, 4)}
    assert "is another one now" in errors[2]
    assert errors[3].count("has gone") == 1
    assert "frames leave again" in errors[3]
    assert "frames leave again" in errors[4]
