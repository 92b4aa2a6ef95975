"""One agent without I/O: bytes in, bytes and commands out."""

from __future__ import annotations

import numpy as np
import pytest
from slot_helpers import one_slot

from dtsa_agent.core import REASONS, Agent, AgentGroup, ConfigError, SlotOutcome, Swarm, SwarmConfig
from dtsa_agent.core.authentication import Authenticator


@pytest.mark.parametrize("policy", ["tdma", "dtsa", "age"])
def test_agents_that_share_bytes_only_fly_like_the_swarm(policy: str) -> None:
    config = SwarmConfig(agents=4, policy=policy, seed=6)
    swarm, agents = Swarm(config), [Agent(k, config) for k in range(1, 5)]
    for slot in range(300):
        frames = {agent.id: data for agent in agents if (data := agent.on_slot(slot)) is not None}
        for agent in agents:
            assert agent.decision().slot == slot
            agent.swarm.fly(slot)
            for sender, data in frames.items():
                if sender != agent.id:
                    assert agent.on_frame(data, slot)
            agent.on_slot_end(SlotOutcome.FRAME if frames else SlotOutcome.SILENCE)
        assert one_slot(swarm, slot) == frames
        for column, agent in enumerate(agents):
            decision, reason = agent.decision(), REASONS[swarm.reason[column]]
            assert (decision.chosen, decision.reason) == (swarm.chosen[0], reason)
            assert agent.swarm.digest[0] == swarm.digest[column]
            assert np.array_equal(agent.swarm.position[:, 0], swarm.position[:, column])


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


@pytest.mark.parametrize("sealed", [False, True])
@pytest.mark.parametrize(("policy", "scenario"), [("tdma", "exchange"), ("dtsa", "exchange"), ("age", "stop-and-go")])
def test_a_group_shares_a_table_until_not_all_have_heard_a_frame(policy: str, scenario: str, sealed: bool) -> None:
    config = SwarmConfig(agents=5, policy=policy, scenario=scenario, seed=6)
    group, plain = AgentGroup(Swarm(config, shared_table=True)), Swarm(config)
    random = np.random.default_rng(1)
    if sealed:
        group.swarm.authenticator = Authenticator(bytes(16))
    for slot in range(200):
        plain.scenario.advance(slot, plain)
        senders = group.on_slot(slot)
        assert senders == plain.begin(slot)
        told, frames = ([swarm.frame(index) for index in senders] for swarm in (group.swarm, plain))
        heard = (random.random((len(senders), 5)) < (0.6 if slot > 60 else 1.0)).astype(np.uint8)
        heard[np.arange(len(senders)), list(senders)] = 0
        if slot == 60:
            heard[:] = 0  # nobody else: only its sender knows what it said
        for swarm in (group.swarm, plain):
            swarm.fly(slot)
        assert group.swarm.shared == (slot <= 60)
        group.on_frames(slot, [index + 1 for index in senders], told, heard)
        for data, mask in zip(frames, heard, strict=True):
            plain.hear(slot, data, mask)
        group.on_slot_end()
        plain.end(slot)
        assert group.swarm.shared == (slot < 60)
        for name in ("chosen", "reason", "digest", "score", "position", "velocity", "command"):
            assert np.array_equal(getattr(group.swarm, name), getattr(plain, name)), (slot, name)
    assert len(set(plain.digest.tolist())) > 1
