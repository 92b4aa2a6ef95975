"""Coming into a swarm that is under way: hovering until one is known."""

from __future__ import annotations

import numpy as np
import pytest

from dtsa_agent.core import Swarm, SwarmConfig
from dtsa_agent.core.agents.agent import Newcomers
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.station import check_joinable


@pytest.mark.parametrize("policy", ["dtsa", "age"])
def test_who_must_have_the_same_table_as_all_cannot_come_late(policy: str) -> None:
    with pytest.raises(ConfigError, match="policy"):
        check_joinable(policy)


@pytest.mark.parametrize("policy", ["tdma", "aloha", "lease"])
@pytest.mark.parametrize("scenario", ["exchange", "waypoints"])
def test_a_newcomer_hovers_until_it_has_been_heard_and_a_round_is_over(policy: str, scenario: str) -> None:
    config = SwarmConfig(agents=4, moving=4, policy=policy, scenario=scenario, stops=2, announce=False)
    swarm, newcomers, first = Swarm(config), Newcomers(4), 30
    spoke = flew = -1
    place = np.zeros(3)
    for slot in range(300):
        if slot == first:
            newcomers.add(swarm, 2, slot)
            swarm.velocity[:, 2] = swarm.command[:, 2] = 0.0
            place = swarm.position[:, 2].copy()
        swarm.scenario.advance(slot, swarm)
        newcomers.hold(swarm, slot)
        senders = swarm.begin(slot)
        frames = [swarm.frame(index) for index in senders]
        swarm.fly(slot)
        if len(frames) == 1:
            swarm.hear(slot, frames[0], np.array([index not in senders for index in range(4)], dtype=np.uint8))
        if 2 in senders and slot >= first and spoke < 0:
            spoke = slot
        swarm.end(slot)
        if slot >= first and flew < 0:
            if swarm.active[2]:
                flew = slot
                assert policy != "lease" or not swarm.lease_status(2)["probation"]
            else:
                assert swarm.position[:, 2].tolist() == place.tolist()
        assert swarm.active[[0, 1, 3]].all()
    assert first <= spoke < flew
    assert flew >= first + 4
    assert np.linalg.norm(swarm.position[:, 2] - place) > 0.1
