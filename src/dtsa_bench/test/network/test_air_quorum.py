"""Integration: agents over UDP that do not hear enough of the others, or are not heard, hover and say so."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path

import air_helpers as helpers
import pytest
from waiting import wait_for

from dtsa_agent.air.settings import UdpSettings
from dtsa_agent.core import SwarmConfig
from dtsa_bench.log.agent_bag import read
from dtsa_bench.log.merge.merge import Merge, is_verified

CONFIG = SwarmConfig(agents=4, policy="tdma", slot_ms=20.0)  # a frame counts for 40 slots
FAST, SLOW = 0.05, 0.001  # m/s


@pytest.fixture
def groups() -> tuple[str, str]:
    helpers.need_multicast()
    return helpers.own_group(), helpers.own_group()


def flying(groups: tuple[str, str], directory: Path) -> AbstractContextManager[list[helpers.Flying]]:
    """Agents of the first group, and the last agent in the second group."""
    ports = [UdpSettings(interface="lo", group=groups[agent == CONFIG.agents]) for agent in range(1, CONFIG.agents + 1)]
    return helpers.flying(CONFIG, ports, directory, lambda _: {"quorum": "all-but-one"})


@pytest.mark.parametrize("deaf", [True, False])
def test_an_agent_whose_frames_are_lost_one_way_hovers_in_flight_and_flies_on_when_they_come(groups, tmp_path, deaf):
    link = helpers.Carrier(*groups)
    try:
        with flying(groups, tmp_path) as agents:
            *others, cut = agents
            wait_for(lambda: all(agent.speed > FAST for agent in agents))
            if deaf:
                link.to_far = False
            else:
                link.to_near = False
            wait_for(lambda: any(line.startswith("hovers: ") for line in cut.said))
            wait_for(lambda: cut.speed < SLOW)
            line = next(line for line in cut.said if line.startswith("hovers: "))
            assert ("hears 0 of 3" in line) == deaf
            assert deaf or "hears 3 of 3" in line
            assert "(quorum 2)" in line
            assert not any("hovers" in line for agent in others for line in agent.said)  # one may be missing
            link.to_far = link.to_near = True
            wait_for(lambda: cut.said[-1].startswith("flies: "))
            wait_for(lambda: cut.speed > FAST)
    finally:
        link.end()
    summary = cut.agent.summary()
    assert summary["held_slots"] > 20
    assert summary["quorum"] == "all-but-one"
    assert [agent.agent.summary()["held_slots"] for agent in others] == [0, 0, 0]
    found = Merge([read(tmp_path / f"cf{agent}.mcap") for agent in range(1, 5)]).summary()
    assert found["held_slots"].keys() == {"cf4"}
    assert found["never_flew"] == []
    assert is_verified(found), found["decisions_again"]


@pytest.mark.parametrize(("quorum", "flies"), [("0", True), ("all-but-one", False), ("1", False)])
def test_an_agent_that_is_alone_flies_only_where_nobody_has_to_be_there(groups, tmp_path, quorum, flies):
    udp = UdpSettings(interface="lo", group=groups[0])
    with helpers.flying(CONFIG, [udp], tmp_path, lambda _: {"quorum": quorum}) as (alone,):
        if flies:
            wait_for(lambda: alone.speed > FAST)
        else:
            wait_for(lambda: "is alone, and hovers until it hears others" in alone.said)
            helpers.go_on([alone], 50)
            assert alone.speed < SLOW
    summary = alone.agent.summary()
    assert (summary["held_at_start_slots"] > 50, summary["held_slots"]) == (not flies, 0)
    assert bool(summary["never_flew"]) == (not flies)
