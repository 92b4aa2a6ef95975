"""Integration: rules of policy lease that a slip in both statements would break alike, judged by what is sent."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from frame_helpers import encode_extended
from lease_helpers import FAR, STATEMENTS, Air, is_anchor, make

from dtsa_agent.core.frame import ExtendedFrame, Frame

MAIN = 15  # K M of the default settings
NOTHING = ExtendedFrame(Frame(1, 0, 0, (0.0,) * 3, (0.0,) * 3, (0.0,) * 3))


def fly(statement: Any, agents: int, movers: int, **settings: Any) -> Air:
    return Air(make(agents, movers, statement=statement, **settings))


def claim(flight: Air, of: int, by: int) -> int:
    """Agent ``by`` says once that it thinks the ids before it dead, back to ``of``; the slot of that frame."""
    slots: list[int] = []

    def lie(slot: int, frame: ExtendedFrame) -> ExtendedFrame:
        if frame.own.sender != by or slots:
            return frame
        slots.append(slot)
        return replace(frame, c_s=(by - of) % len(flight.swarm.ids), leases=bytes(len(frame.leases)))

    while not slots:
        flight.run(1, changed=lie)
    return slots[0]


@STATEMENTS
def test_without_adoption_nobody_is_claimed(statement: Any) -> None:
    flight = fly(statement, 6, 6, adoption=False).run(60)
    flight.swarm.present[3] = 0
    flight.run(1600)
    assert {frame.c_s for frame in flight.frames.values()} == {0}


@STATEMENTS
def test_who_was_claimed_waits_until_everybody_has_spoken_twice(statement: Any) -> None:
    """2 K M N slots after the claim, where the next one alive is not heard to say otherwise."""
    flight = fly(statement, 6, 6).run(200)
    at = claim(flight, of=5, by=6)
    flight.run(3 * MAIN * 6, deaf={5: {6}})
    other = [slot for slot in flight.own(5, at) if not is_anchor(slot, 6)]
    assert at + 2 * MAIN * 6 <= other[0] <= at + 2 * MAIN * 6 + 2 * 6
    assert all(is_anchor(slot, 6) for slot in flight.own(5, at) if slot < other[0])
    assert len([slot for slot in flight.own(5, at) if slot < other[0]]) >= 4


@STATEMENTS
def test_who_missed_four_turns_is_given_none(statement: Any) -> None:
    flight = fly(statement, 12, 3).run(600)
    assert any(1 in frame.leases for slot, frame in flight.frames.items() if slot > 500)
    flight.swarm.present[0] = 0
    flight.run(MAIN * 12 + 120)  # until then frames repeat what was given away before
    begin = flight.slot
    flight.run(500)
    assert not flight.swarm.lease_status(5)["absent"]
    frames = [frame for slot, frame in flight.frames.items() if slot >= begin]
    assert any(2 in frame.leases for frame in frames)
    assert not any(1 in frame.leases or 1 in [lessee for _, lessee in frame.relay] for frame in frames)


def handed_on(flight: Air) -> int:
    """Number of turns handed on by those to whom they were given, none to its owner, while some rest and some move."""
    handed = 0
    for stage in range(12):
        flight.swarm.goal[0, :] = 0.0
        moving = [(stage * 5 + k) % 12 for k in range(4)]
        here = np.array(flight.swarm.position)
        flight.swarm.goal[:] = here
        flight.swarm.goal[0, moving] = FAR
        given: dict[int, int] = {}  # lessee of each turn, as its owner said
        for slot in range(flight.slot, flight.slot + 200):
            flight.run(1)
            frame = flight.frames.get(slot)
            if frame is None:
                continue
            for ahead, lessee in frame.relay:
                turn = slot + ahead
                assert lessee != turn % 12 + 1, (slot, turn)
                handed += given.get(turn, 0) == frame.own.sender != lessee
                given[turn] = lessee
    return handed


@STATEMENTS
@pytest.mark.parametrize("without", [{}, {"open_every": 0}, {"adoption": False}], ids=["", "OPEN turns", "adoption"])
def test_turns_are_handed_on_with_open_turns_and_adoption_only(statement: Any, without: dict[str, Any]) -> None:
    handed = handed_on(fly(statement, 12, 6, **without))
    assert handed == 0 if without else handed > 20


@STATEMENTS
def test_a_relay_of_somebody_else_changes_no_entry(statement: Any) -> None:
    """Of a turn leased to one mover, an agent that has nothing to do with it says that it is another's."""
    flight = fly(statement, 12, 2).run(600)
    told: list[tuple[int, int]] = []  # turn, its lessee

    def lie(slot: int, frame: ExtendedFrame) -> ExtendedFrame:
        known = [(ahead, lessee) for ahead, lessee in frame.relay if lessee in (1, 2) and ahead > 2]
        fits = [(ahead, lessee) for ahead, lessee in known if frame.own.sender not in (lessee, (slot + ahead) % 12 + 1)]
        if not fits or told:
            return frame
        ahead, lessee = fits[0]
        told.append((slot + ahead, lessee))
        relay = tuple((a, 3 - b if a == ahead else b) for a, b in frame.relay)
        return replace(frame, relay=relay)

    flight.run(12, changed=lie)
    (turn, lessee) = told[0]
    flight.run(max(0, turn - flight.slot + 1))
    assert flight.chosen[turn] == [lessee] * 12
    assert flight.sent[turn] == (lessee,)


@STATEMENTS
def test_who_hears_nobody_gives_no_turns_of_the_dead_away(statement: Any) -> None:
    flight = fly(statement, 6, 6).run(60)
    flight.swarm.present[3] = 0
    flight.run(1600)
    assert any(any(flight.frames[slot].leases) for slot in flight.own(5, 1500))  # turns of agent 4
    jam = flight.slot
    flight.run(60, deaf={agent: set(range(1, 7)) for agent in range(1, 7)})
    said = [flight.frames[slot] for slot in range(jam + 12, jam + 60) if slot in flight.frames]
    assert len([frame for frame in said if frame.own.sender == 5]) == 8
    assert not any(any(frame.leases) for frame in said)


@STATEMENTS
def test_an_own_entry_holds_nothing_that_was_sent_in_an_open_turn_unheard(statement: Any) -> None:
    """Two that wake in one slot take the first OPEN turn, and nobody hears them."""
    flight = fly(statement, 24, 4).run(600)
    woke, both = flight.slot, [11, 17]
    flight.swarm.goal[0, both] = FAR
    while len(flight.run(1).sent[-1]) < 2:
        assert flight.slot < woke + 200
    assert flight.sent[-1] == (12, 18)
    assert all(flight.swarm.sent_slot[k, k] < woke for k in both)
    flight.run(400)
    assert all(flight.swarm.sent_slot[k, k] >= woke for k in both)  # heard by now


@STATEMENTS
def test_a_relay_leaves_out_own_turns_that_the_same_frame_names(statement: Any) -> None:
    flight = fly(statement, 12, 3).run(800)
    naming = {slot: frame for slot, frame in flight.frames.items() if any(frame.leases)}
    assert len(naming) > 50
    for slot, frame in naming.items():
        turns = [slot + ahead for ahead, _ in frame.relay]
        assert not [turn for turn in turns if turn % 12 == frame.own.sender - 1]


@STATEMENTS
def test_an_agent_that_has_just_turned_is_heard_again_soon(statement: Any) -> None:
    """By the turns of others: its waits are shorter than theirs while its velocity changes from frame to frame."""
    flight = fly(statement, 18, 6).run(200)
    sent: list[tuple[int, ...]] = []
    for slot in range(300):
        flight.swarm.velocity[0, 2] = 0.5 if slot // 5 % 2 else -0.5  # agent 3
        sent += flight.run(1).sent[-1:]
    assert sent.count((3,)) > 1.2 * max(sent.count((agent,)) for agent in (1, 2, 4, 5, 6))
    assert min(sent.count((agent,)) for agent in (1, 2, 4, 5, 6)) >= 300 / 18  # nobody waits for longer than a round


@STATEMENTS
def test_a_turn_comes_back_to_the_agent_that_handed_it_on(statement: Any) -> None:
    """Two that turn one after the other hand a turn to and fro, and its last lessee sends in it."""
    flight = fly(statement, 18, 3).run(200)
    back = 0
    lessees: dict[int, list[int]] = {}  # of each turn, as its lessees said
    for slot in range(flight.slot, flight.slot + 300):
        flight.swarm.velocity[0, :3] = 0.3 * np.random.default_rng([slot // 4, 3]).normal(size=3)
        flight.run(1)
        frame = flight.frames.get(slot)
        for ahead, lessee in frame.relay if frame is not None else ():
            chain = lessees.setdefault(slot + ahead, [])
            if not chain or (frame is not None and chain[-1] == frame.own.sender != lessee):
                chain.append(lessee)
        chain = lessees.pop(slot, [])
        back += len(set(chain)) < len(chain)
        assert not chain or chain[-1] == 255 or flight.sent[slot] == (chain[-1],)
    assert back > 5


@STATEMENTS
def test_a_frame_older_than_the_own_last_one_brings_no_turn_back(statement: Any) -> None:
    """Agent 1 hands a turn on to 2; a frame of 2 that was sent before it heard that still says it is agent 1's."""
    flight = fly(statement, 18, 3).run(400)
    while True:  # until a mover hands a turn on to another one
        before = dict(flight.frames.get(flight.slot - 1, NOTHING).relay)
        frame = flight.run(1).frames.get(flight.slot - 1)
        flight.swarm.velocity[0, 1] = 0.5 if flight.slot // 4 % 2 else -0.5
        handed = [
            (flight.slot - 1 + ahead, lessee)
            for ahead, lessee in (frame.relay if frame else ())
            if before.get(ahead + 1) == frame.own.sender != lessee <= 3 and ahead > 4
        ]
        if handed:
            break
        assert flight.slot < 1400
    assert frame is not None
    turn, heir = handed[0]
    sender, slot = frame.own.sender, flight.slot  # the one after the frame
    stale = replace(frame, own=replace(frame.own, sender=heir, slot=slot - 1), relay=((turn - slot + 1, sender),))
    swarm = flight.swarm
    swarm.begin(slot)
    assert swarm.hear(slot, encode_extended(replace(stale, leases=b"", far=(), far_lessee=0)))
    swarm.end(slot)
    flight.slot += 1
    flight.sent.append(())
    flight.chosen.append([])
    flight.run(turn - flight.slot + 1)
    assert flight.chosen[turn][sender - 1] != sender
