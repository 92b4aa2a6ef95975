"""One agent without I/O: bytes in, bytes and commands out."""

from __future__ import annotations

import numpy as np
import pytest

from dtsa_agent.core import Agent, AgentGroup, ConfigError, SlotOutcome, Swarm, SwarmConfig, decode_frame
from dtsa_agent.core.authentication import Authenticator


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
            agent.on_slot_end(SlotOutcome.FRAME if frames else SlotOutcome.SILENCE)
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


def test_a_key_belongs_to_authenticated_swarms_and_only_there() -> None:
    sealed, key = SwarmConfig(agents=2, policy="tdma", auth=True), Authenticator(bytes(16))
    for config, authenticator in ((sealed, None), (SwarmConfig(agents=2), key)):
        with pytest.raises(ConfigError, match="authenticator"):
            Agent(1, config, authenticator=authenticator)
    sender, receiver = (Agent(k, sealed, authenticator=Authenticator(bytes(16))) for k in (1, 2))
    frame = sender.on_slot(0)
    assert frame is not None
    assert receiver.on_slot(0) is None
    assert receiver.on_frame(frame, 0)
    assert not receiver.on_frame(frame[:-1], 0)
    assert receiver.swarm.rejected == 1


@pytest.mark.parametrize("policy", ["tdma", "dtsa"])
def test_a_group_shares_a_table_until_the_first_frame_that_not_all_have_heard(policy: str) -> None:
    config = SwarmConfig(agents=5, policy=policy, seed=6)
    group, plain = AgentGroup(Swarm(config, shared_table=True)), Swarm(config)
    for slot in range(120):
        plain.scenario.advance(slot, plain)
        senders = group.on_slot(slot)
        assert senders == plain.begin(slot)
        frames = [plain.frame(index) for index in senders]
        heard = np.ones((len(senders), 5), dtype=np.uint8)
        heard[np.arange(len(senders)), list(senders)] = 0
        if slot == 60:
            heard[:] = 0  # nobody else: only its sender knows what it said
        for swarm in (group.swarm, plain):
            swarm.fly(slot)
        assert group.swarm.shared == (slot <= 60)
        group.on_frames(slot, [index + 1 for index in senders], frames, heard)
        for data, mask in zip(frames, heard, strict=True):
            plain.hear(slot, data, mask)
        group.on_slot_end()
        plain.end(slot)
        assert group.swarm.shared == (slot < 60)
        assert np.array_equal(group.swarm.position, plain.position)
    assert np.array_equal(group.swarm.digest, plain.digest)
