"""Integration: what plug-ins may say in frames, and what they are told of each slot."""

from __future__ import annotations

import struct
from typing import Any, ClassVar

import numpy as np
import pytest

from dtsa_agent.core import Agent, ConfigError, PluginError, SlotOutcome, Swarm, SwarmConfig
from dtsa_agent.core.authentication import Authenticator
from dtsa_agent.core.plugins import Table, make_swarm
from dtsa_agent.core.registry import ESTIMATORS, POLICIES

KEY = bytes(range(16))


class Counting:
    """Policy: turns in id order; says how many frames it has heard, and notes what others say."""

    own_bytes: ClassVar[int] = 4
    port = ("send", "received", "busy")

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        self.agents, self.agent = config.agents, agent
        self.count = 0
        self.others: dict[int, int] = {}
        self.outcomes: list[SlotOutcome] = []

    def choose(self, table: Table, slot: int) -> int:
        return slot % self.agents + 1

    def own_data(self, table: Table, slot: int) -> bytes:
        return struct.pack("<HH", self.agent, self.count)

    def receive_data(self, table: Table, slot: int, sender: int, data: bytes) -> None:
        agent, count = struct.unpack("<HH", data)
        assert agent == sender
        assert table.sent_slot[sender - 1] == slot
        self.count += 1
        self.others[sender] = count

    def slot_over(self, table: Table, slot: int, outcome: SlotOutcome) -> None:
        self.outcomes.append(outcome)


class Initials:
    """Estimator: the last heard state; says two letters."""

    own_bytes: ClassVar[int] = 2

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        self.letters: dict[int, bytes] = {}

    def estimate(self, table: Table, slot: int, step: int, position: Any, velocity: Any) -> None:
        position[:], velocity[:] = table.sent_position, table.sent_velocity

    def own_data(self, table: Table, slot: int) -> bytes:
        return bytes([65 + table.agent, 97 + slot % 26])

    def receive_data(self, table: Table, slot: int, sender: int, data: bytes) -> None:
        self.letters[sender] = data


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    for rows, name, part in ((POLICIES, "counting", Counting), (ESTIMATORS, "initials", Initials)):
        monkeypatch.setattr(rows, "_plug_ins", {})
        monkeypatch.setattr(rows, "registered", set())
        rows.register(name, part)


def config(**settings: Any) -> SwarmConfig:
    return SwarmConfig(**{"agents": 3, "moving": 2, "policy": "counting", "estimator": "initials", **settings})


def parts(swarm: Swarm, kind: str) -> list[Any]:
    return [part.instance for part in getattr(swarm, kind)]


def fly(swarm: Swarm, slots: range, lost: tuple[int, int] | None = None) -> list[bytes]:
    """Flies some slots; agent and slot of ``lost``: does not hear the frame of that slot."""
    frames = []
    for slot in slots:
        swarm.scenario.advance(slot, swarm)
        (index,) = swarm.begin(slot)
        frames.append(swarm.frame(index))
        swarm.fly(slot)
        mask = np.array([k != index and (k + 1, slot) != lost for k in range(3)], dtype=np.uint8)
        assert swarm.hear(slot, frames[-1], mask)
        swarm.end(slot)
    return frames


def test_bytes_of_plug_ins_follow_the_frame_and_reach_those_that_hear_it() -> None:
    swarm = make_swarm(config())
    plain = make_swarm(config(policy="tdma", estimator="hold"))
    frames = fly(swarm, range(7), lost=(3, 3))
    assert [len(data) for data in frames] == [19 + 4 + 2] * 7
    assert [data[:19] for data in frames[:3]] == fly(plain, range(3))
    assert frames[4][19:] == struct.pack("<HH", 2, 3) + b"Ce"
    assert parts(swarm, "policies")[0].others == {2: 3, 3: 3}
    assert parts(swarm, "policies")[1].others == {1: 4, 3: 3}
    assert parts(swarm, "policies")[2].others == {1: 4, 2: 3}
    assert parts(swarm, "estimators")[0].letters == {2: b"Ce", 3: b"Df"}


def test_the_outcome_of_a_slot_is_a_frame_silence_or_a_collision_where_it_can_be_told() -> None:
    swarm = make_swarm(config())
    fly(swarm, range(2), lost=(3, 1))
    swarm.begin(2)
    swarm.sends[:] = 0
    swarm.emit(2)  # nobody sends
    swarm.end(2, np.array([0, 1, 0], dtype=np.uint8))
    told = [part.outcomes for part in parts(swarm, "policies")]
    silence, frame, collision = SlotOutcome.SILENCE, SlotOutcome.FRAME, SlotOutcome.COLLISION
    assert told == [[frame, frame, silence], [frame, frame, collision], [frame, silence, silence]]


def test_single_agents_hear_and_are_told_the_same() -> None:
    together = make_swarm(config())
    agents = [Agent(k, config()) for k in (1, 2, 3)]
    expected = fly(together, range(30))
    for slot in range(30):
        frames = [agent.on_slot(slot) for agent in agents]
        assert [data for data in frames if data] == [expected[slot]]
        for agent, own in zip(agents, frames, strict=True):
            agent.swarm.fly(slot)
            assert own or agent.on_frame(expected[slot], slot)
            agent.on_slot_end(SlotOutcome.FRAME)
    for agent, part in zip(agents, parts(together, "policies"), strict=True):
        assert parts(agent.swarm, "policies")[0].others == part.others
        assert parts(agent.swarm, "policies")[0].outcomes == part.outcomes
    agents[0].on_slot(30)
    agents[0].on_slot_end(SlotOutcome.COLLISION)
    agents[1].on_slot(30)
    agents[1].on_slot_end(SlotOutcome.COLLISION)
    told = [parts(agent.swarm, "policies")[0].outcomes[-1] for agent in agents[:2]]
    assert told == [SlotOutcome.FRAME, SlotOutcome.COLLISION]  # who sends hears nothing else


def test_bytes_of_plug_ins_are_authenticated_and_short_frames_are_none() -> None:
    sealed = make_swarm(config())
    sealed.authenticator = Authenticator(KEY)
    fly(sealed, range(3))
    (index,) = sealed.begin(3)
    data = sealed.frame(index)
    assert len(data) == 19 + 6 + 4
    assert not sealed.hear(3, data[:20] + bytes([data[20] ^ 1]) + data[21:])
    assert sealed.rejected == 1
    swarm = make_swarm(config())
    swarm.begin(0)
    frame = swarm.frame(0)
    for cut in (b"", frame[:5], frame[:19], frame[:-1], frame + b"x"):
        assert not swarm.hear(0, cut)
    assert swarm.malformed == 5
    assert not any(part.count for part in parts(swarm, "policies"))


def test_a_restarted_agent_and_a_reset_swarm_begin_with_new_parts() -> None:
    swarm = make_swarm(config())
    fly(swarm, range(6))
    before = parts(swarm, "policies")[:]
    swarm.restart(1)
    assert [a is b for a, b in zip(before, parts(swarm, "policies"), strict=True)] == [True, False, True]
    first = fly(make_swarm(config()), range(20))
    swarm.reset()
    assert fly(swarm, range(20)) == first


def test_bytes_that_do_not_fit_are_refused_and_broken_promises_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match=r"own_bytes of counting and initials: got 6; allowed: 0 to 4 with"):
        config(frame="extended")
    assert config(frame="extended", estimator="linear").own_bytes == 4
    with pytest.raises(ConfigError, match="own_bytes of counting: got 4; allowed: 0 to 0"):
        config(frame="extended", estimator="linear", auth=True)
    monkeypatch.setattr(Counting, "own_data", lambda self, table, slot: b"abc")
    swarm = make_swarm(config())
    with pytest.raises(PluginError, match="policy counting, own_data: gave 3 bytes, declared 4"):
        swarm.begin(0)
