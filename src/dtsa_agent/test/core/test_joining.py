"""Coming into a swarm that is under way: listening for the time, and hovering until one is known."""

from __future__ import annotations

import numpy as np
import pytest

from dtsa_agent.core import Swarm, SwarmConfig
from dtsa_agent.core.agents.joining import Listeners, Newcomers

MS = 1_000_000


def test_each_takes_its_time_from_the_first_frame_it_hears() -> None:
    config = SwarmConfig(agents=4, policy="lease", slot_ms=10.0)
    listeners = Listeners(config, [2, 4], [0, 0])
    assert not listeners.ready([0, 0])
    assert listeners.hear(1, 70, 5 * MS)
    assert not listeners.hear(1, 71, 15 * MS)
    assert not listeners.ready([30 * MS, 30 * MS])
    assert listeners.hear(0, 72, 25 * MS)
    assert listeners.ready([30 * MS, 30 * MS])


def test_who_hears_nobody_begins_after_one_to_two_rounds_of_anchors() -> None:
    config = SwarmConfig(agents=4, policy="lease", slot_ms=10.0, anchor_every=5)
    rounds = 5 * 4 * 10 * MS
    for agent in range(1, 5):
        listeners = Listeners(config, [agent], [1000])
        assert not listeners.ready([1000 + rounds - 1])
        assert listeners.ready([1000 + 2 * rounds])


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
