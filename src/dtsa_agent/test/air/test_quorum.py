"""Whether an agent may fly, and what it says of that."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dtsa_agent.air.contacts import Contact
from dtsa_agent.air.driver import LiveAgent
from dtsa_agent.air.quorum import ALL_BUT_ONE, Hold, Quorum
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.air.udp import UdpPort, UdpSettings
from dtsa_agent.core import ConfigError, SwarmConfig

SECOND = 10**9


@pytest.mark.parametrize(
    ("text", "needed"),
    [
        (ALL_BUT_ONE, {0: 0, 1: 1, 2: 1, 3: 2, 11: 10}),
        ("100%", {0: 0, 1: 1, 11: 11}),
        ("80%", {0: 0, 1: 1, 5: 4, 10: 8, 11: 9}),
        ("33.4%", {3: 2}),
        ("0%", {11: 0}),
        ("0", {0: 0, 11: 0}),
        ("3", {0: 3, 11: 3}),
    ],
)
def test_how_many_others_are_needed(text: str, needed: dict[int, int]) -> None:
    assert {there: Quorum(text).needed(there) for there in needed} == needed


@pytest.mark.parametrize("text", ["", "all", "101%", "-1", "0.8", "1.5", "%", "8 %", "\u0663", "all-but-two"])
def test_other_words_are_refused(text: str) -> None:
    with pytest.raises(ConfigError) as error:
        AgentSettings(id=1, quorum=text)
    assert error.value.field == "quorum"
    assert error.value.value == text


def test_a_number_that_can_never_be_there_is_refused() -> None:
    config = SwarmConfig(agents=3, policy="tdma")
    with UdpPort(UdpSettings(interface="lo")) as port:
        LiveAgent(AgentSettings(id=1, quorum="2"), config, port)
        with pytest.raises(ConfigError, match="at most 2, the number of the others"):
            LiveAgent(AgentSettings(id=1, quorum="3"), config, port)


@given(percent=st.integers(0, 100), there=st.integers(0, 1023))
def test_a_share_is_never_less_than_said(percent: int, there: int) -> None:
    needed = Quorum(f"{percent}%").needed(there)
    assert needed - 1 < percent * there / 100 + 1e-6 <= needed + 2e-6
    assert 0 <= needed <= there


def test_an_agent_says_at_once_that_it_hovers_and_that_it_flies_on() -> None:
    said: list[str] = []
    hold = Hold(Quorum(ALL_BUT_ONE), said.append)
    assert hold.held  # until it is known who is there
    all_there, deaf = Contact(5, 5, 5, 5), Contact(5, 2, 1, 1)
    hold.judge(deaf, True, 0)
    hold.hover()
    hold.judge(all_there, True, 50 * SECOND)
    assert (hold.held, hold.slots, hold.slots_at_start) == (False, 0, 1)
    hold.judge(deaf, False, 51 * SECOND)
    hold.hover()
    hold.judge(all_there, False, 51 * SECOND + 1)
    assert said == []  # a start takes a moment
    assert (hold.slots, hold.slots_at_start, hold.problem) == (0, 2, "")
    hold.judge(deaf, False, 60 * SECOND)
    hold.hover()
    assert (hold.held, hold.slots) == (True, 1)
    assert said == ["hovers: hears 2 of 5, is heard by 1 (quorum 4)"]
    hold.judge(all_there, False, 61 * SECOND)
    assert (hold.held, len(said)) == (False, 1)
    hold.judge(Contact(5, 4, 5, 4), False, 62 * SECOND)
    assert said[1:] == ["flies on: hears 4 of 5, is heard by 5 (quorum 4)"]
    hold.judge(all_there, False, 99 * SECOND)
    assert len(said) == 2


def test_an_agent_that_never_gets_a_quorum_says_so_a_second_after_it_is_no_longer_new() -> None:
    said: list[str] = []
    hold = Hold(Quorum("5"), said.append)
    for tenth in range(100):
        hold.judge(Contact(3, 3, 3, 3), tenth < 50, tenth * SECOND // 10)
        assert len(said) == (tenth >= 60)
    assert said == ["hovers: hears 3 of 3, is heard by 3 (quorum 5)"]
    assert not hold.problem  # it has not hovered through a slot yet
    hold.hover()
    assert hold.problem == "never had its quorum, and hovered for 1 slots"
    Hold(Quorum("5"), None).judge(Contact(0, 0, 0, 0), False, 0)
