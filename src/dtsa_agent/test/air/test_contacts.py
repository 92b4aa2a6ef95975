"""Whom an agent hears, who hears it, who is there: the plain statement, by what it is for."""

from __future__ import annotations

import dataclasses
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dtsa_agent.air.contacts import FOR_EVER, Contact, Contacts, Limits, limits_of, said_of
from dtsa_agent.air.delay import Delay
from dtsa_agent.core import Frame, SwarmConfig, encode_frame
from dtsa_agent.core.frame import ExtendedFrame, encode_extended

LIMITS = Limits(moving=100, resting=500, named=50)
STATE = ((1.0, 2.0, 3.0), (0.0, 0.0, 0.0))
MOVES = encode_frame(Frame(1, 1, 1, *STATE))


def extended(rests: bool = False, leaving: bool = False, probation: bool = False) -> bytes:
    """A frame with policy lease."""
    own = Frame(1, 1, int(not rests), *STATE, (0.0, 0.0, 0.0))
    return encode_extended(ExtendedFrame(own, leaving=leaving, probation=probation))


@given(
    agents=st.integers(2, 40),
    peers=st.integers(1, 4),
    draw=st.randoms(use_true_random=False),
    heard_share=st.floats(0.0, 1.0),
    loss=st.floats(0.0, 0.8),
)
def test_what_datagrams_say_is_true_and_whatever_is_lost_makes_up_nothing(
    agents: int, peers: int, draw: random.Random, heard_share: float, loss: float
) -> None:
    sender = 1 + draw.randrange(agents)
    others = [k for k in range(1, agents + 1) if k != sender]
    heard = {k for k in others if draw.random() < heard_share}
    delay, told = Delay(sender, 10**6, peers), set()
    for k in heard:
        delay.hear(k, 0, ())
    for _ in range(2 * agents + 2):
        names = [peer for peer, _ in delay.tell(heard.__contains__)]
        assert len(names) == min(peers, len(heard))
        if draw.random() < loss:
            continue
        for k in others:
            says = said_of(k, names, peers)
            assert says in (None, k in heard)
            told |= {k} if says is not None else set()
    if not loss and (peers > 1 or not heard):
        assert told == set(others)  # within two rounds of its names


@given(names=st.lists(st.integers(1, 65535), max_size=4), agent=st.integers(1, 1024))
def test_a_list_that_cannot_be_says_something_or_nothing(names: list[int], agent: int) -> None:
    assert said_of(agent, names, 4) in (True, False, None)
    assert said_of(agent, names, 0) in (True, False, None)


def test_an_agent_that_hears_nobody_any_more_does_not_come_to_believe_that_nobody_is_there() -> None:
    contacts = Contacts(4, 1, LIMITS, 4)
    assert contacts.count(0, True) == Contact(0, 0, 0, 0)
    for slot, sender in enumerate((2, 3, 4), 10):
        contacts.hear(sender, slot, MOVES, [1])
    assert contacts.count(12, True) == contacts.count(110, False) == Contact(3, 3, 3, 3)
    assert contacts.count(112, False) == Contact(3, 1, 3, 1)
    assert contacts.count(10**6, False) == Contact(3, 0, 3, 0)


def test_the_dead_are_there_for_a_while_and_those_that_leave_no_longer() -> None:
    contacts = Contacts(5, 1, LIMITS, 4)
    for sender in (2, 3, 4, 5):
        contacts.hear(sender, 0, extended(), [1])
    contacts.hear(5, 1, extended(leaving=True), [1, 2, 3, 4])
    contacts.hear(2, 100, extended(), [1, 3, 4, 5])  # it has not heard that 5 leaves
    assert contacts.count(100, False) == Contact(3, 3, 3, 3)
    contacts.hear(2, 150, extended(), [1])
    assert contacts.count(150, False) == Contact(3, 1, 3, 1)
    contacts.hear(2, 151, extended(), [1])
    assert contacts.count(151, False) == Contact(1, 1, 1, 1)
    assert contacts.count(151, True) == Contact(3, 1, 3, 1)  # one that is new waits for longer
    contacts.hear(5, 200, extended(), [1])  # it is back
    assert contacts.count(200, False).there == 2


def test_those_that_were_there_are_so_in_a_new_time_and_those_of_another_time_as_well() -> None:
    contacts = Contacts(6, 1, LIMITS, 4)
    contacts.hear(2, 0, extended(), [1, 3])
    contacts.hear(4, 1, extended(leaving=True), [1])
    contacts.see(5, 700, 1)
    assert contacts.count(1, True) == Contact(3, 1, 1, 1)
    contacts.hear(2, 60, MOVES, [1])
    assert contacts.count(60, False).there == 1
    contacts.see(5, 701, 60)
    contacts.see(3, 0, 60)
    contacts.see(3, 0, 120)  # played again
    contacts.see(4, 30, 60)  # it has left
    contacts.hear(2, 115, MOVES, [1])
    assert contacts.count(115, False).there == 1
    contacts.see(5, 702, 115)
    contacts.reset(800)
    contacts.hear(6, 800, MOVES, [1])
    assert contacts.count(800, True) == Contact(3, 1, 1, 1)
    contacts.reset(900)
    assert contacts.count(900, True) == Contact(3, 0, 0, 0)


def test_an_agent_known_by_name_is_there_and_not_heard() -> None:
    contacts = Contacts(9, 1, LIMITS, 4)
    contacts.hear(2, 0, MOVES, [1, 3, 4, 5])
    assert contacts.count(0, True) == Contact(4, 1, 1, 1)
    contacts.hear(2, 51, MOVES, [1, 3])
    assert contacts.count(51, False) == Contact(2, 1, 2, 1)  # who has not said whether it hears this one may
    assert contacts.count(51, True) == Contact(4, 1, 1, 1)


def test_one_that_rests_may_be_silent_for_longer_and_one_on_probation_counts_for_the_new_alone() -> None:
    contacts = Contacts(4, 1, LIMITS, 4)
    contacts.hear(2, 0, extended(rests=True), [1])
    contacts.hear(3, 0, extended(probation=True), [1])
    contacts.hear(4, 0, extended(), [])
    assert contacts.count(50, True) == Contact(3, 3, 2, 2)
    assert contacts.count(50, False) == Contact(2, 2, 1, 1)
    assert contacts.count(101, True) == Contact(3, 2, 2, 2)
    assert [contacts.hears(agent, 101) for agent in (2, 3, 4)] == [True, True, False]
    assert not contacts.hears(2, 501)


def test_that_an_agent_is_not_heard_counts_for_a_while_and_not_from_one_that_is_new() -> None:
    contacts = Contacts(9, 1, LIMITS, 4)
    contacts.hear(2, 0, extended(rests=True), [])
    contacts.hear(3, 0, extended(probation=True), [2])
    contacts.hear(3, 1, extended(), [4, 5, 6, 7])
    assert contacts.count(50, False).heard_by == contacts.count(50, False).there - 1
    assert contacts.count(50, True).heard_by == 0
    assert contacts.count(51, False).heard_by == contacts.count(51, False).there


def test_with_one_name_a_datagram_only_long_silence_tells() -> None:
    contacts = Contacts(3, 1, LIMITS, 1)
    contacts.hear(2, 0, MOVES, [1])
    for slot in range(1, 17):
        contacts.hear(2, slot, MOVES, [3])
        assert contacts.count(slot, True).heard_by == 1
    contacts.hear(2, 17, MOVES, [3])
    assert contacts.count(17, True).heard_by == 0
    nobody = Contacts(3, 1, LIMITS, 0)  # datagrams have no room for names
    nobody.hear(2, 0, MOVES, [])
    assert nobody.count(0, True) == Contact(1, 1, 1, 1)


@pytest.mark.parametrize("policy", ["lease", "tdma", "aloha"])
def test_limits_follow_from_how_often_agents_speak(policy: str) -> None:
    config = SwarmConfig(agents=12, policy=policy)
    limits = limits_of(config, 4)
    long = 6 * config.main_every * 12
    assert (
        limits
        == {
            "lease": Limits(120, long, 144),
            "tdma": Limits(120, 120, 144),
            "aloha": Limits(long, FOR_EVER, long),
        }[policy]
    )
    assert limits_of(config, 1).named == (long if policy == "aloha" else 3 * 12 * 11)
    assert limits_of(config, 0).named == long
    slow = SwarmConfig(agents=2, policy=policy, slot_ms=150.0)
    assert limits_of(slow, 4).moving == (6 * slow.main_every * 2 if policy == "aloha" else 20)
    assert limits_of(dataclasses.replace(slow, slot_ms=1.0), 4).moving >= 180  # half a second at least
