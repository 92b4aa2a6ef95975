"""One agent without I/O: bytes in, bytes and commands out."""

from __future__ import annotations

import numpy as np

from dtsa_agent.core import Agent, Swarm, SwarmConfig, decode_frame


def test_agents_that_share_bytes_only_fly_like_the_swarm() -> None:
    config = SwarmConfig(agents=4, policy="dtsa", seed=6)
    swarm, agents = Swarm(config), [Agent(k, config) for k in range(1, 5)]
    for slot in range(300):
        swarm.scenario.advance(slot, swarm)
        senders = swarm.begin(slot)
        frames = {agent.id: data for agent in agents if (data := agent.on_slot(slot)) is not None}
        assert list(frames) == [swarm.ids[index] for index in senders]
        assert all(agent.decision().chosen == swarm.chosen[0] for agent in agents)
        for agent in agents:
            agent.swarm.fly(slot)
            for sender, data in frames.items():
                if sender != agent.id:
                    assert agent.on_frame(data, slot)
            if not frames:
                agent.on_silence(slot)
        swarm.fly(slot)
        for index in senders:
            swarm.hear(slot, swarm.frame(index))
        swarm.end(slot)
        for column, agent in enumerate(agents):
            assert np.array_equal(agent.swarm.position[:, 0], swarm.position[:, column])


def test_a_decision_says_why() -> None:
    agent = Agent(1, SwarmConfig(agents=2, policy="tdma"))
    frame = agent.on_slot(0)
    assert frame is not None
    assert decode_frame(frame).sender == 1
    assert (agent.decision().chosen, agent.decision().reason, agent.decision().slot) == (1, "tdma", 0)
    assert agent.on_slot(1) is None
    assert agent.decision().chosen == 2


def test_garbage_is_counted_and_ignored() -> None:
    agent = Agent(1, SwarmConfig(agents=2, policy="tdma"))
    agent.on_slot(0)
    assert not agent.on_frame(b"garbage", 0)
    assert agent.swarm.malformed == 1


def test_commands_lead_to_the_goal_at_any_instant_of_a_slot() -> None:
    config = SwarmConfig(agents=2, policy="tdma", avoider="none", slot_ms=50, seed=1)
    agent = Agent(1, config)
    agent.on_slot(0)
    position = (0.0, 0.0, 0.0)
    goal = agent.swarm.goal[:, 0]
    command = np.array(agent.command(position, (0.0, 0.0, 0.0), 0, 3))
    assert command @ goal > 0.99 * np.linalg.norm(command) * np.linalg.norm(goal)
    assert 0 < np.linalg.norm(command) <= 1.5 + 1e-9
