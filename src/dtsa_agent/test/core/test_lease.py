"""Policy lease, agent by agent: who may send when, who gives turns away, and what each takes from the air."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from frame_helpers import encode_extended
from lease_helpers import FAR, STATEMENTS, Air, is_anchor, make, still

from dtsa_agent.core import REASONS, ConfigError, Scenario, Swarm, SwarmConfig, make_scenario
from dtsa_agent.core.frame import OPEN, ExtendedFrame, Frame, Gossip, decode_extended
from dtsa_agent.core.reference.lease import Memory, uses_open_turn
from dtsa_agent.core.reference.lease_issue import open_block
from dtsa_agent.core.reference.table import Rules

OWN = {"position": (0.0, 0.0, 0.0), "velocity": (0.0, 0.0, 0.0), "intent": (0.0, 0.0, 0.0)}


@STATEMENTS
@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_all_moving_is_tdma_bit_for_bit(loss: float, statement: Any) -> None:
    lease = Air(make(10, 10, statement=statement), loss).run(600)
    tdma = Air(make(10, 10, policy="tdma", frame="extended", statement=statement), loss).run(600)
    assert lease.sent == tdma.sent == [(slot % 10 + 1,) for slot in range(600)]
    np.testing.assert_array_equal(lease.swarm.sent_slot, tdma.swarm.sent_slot)
    np.testing.assert_array_equal(lease.swarm.sent_position, tdma.swarm.sent_position)


@STATEMENTS
@pytest.mark.parametrize(
    ("movers", "share", "some"), [(0, 0.75, False), (12, 0.75, False), (8, 0.5, False), (6, 0.5, True)]
)
def test_nothing_to_give_nobody_to_take_or_many_moving(movers: int, share: float, some: bool, statement: Any) -> None:
    air = Air(make(12, movers, lease_share=share, statement=statement)).run(600)
    assert bool(air.leases(0, 600)) is some


def test_who_may_get_another_goal_gives_away_little_by_little() -> None:
    swarm = make(12, 6, depth_rate=0.1, open_every=0)
    swarm.final[:] = 0
    air = Air(swarm).run(12 * 100)
    first = next(slot for slot in range(1200) if air.leases(slot, slot + 1))
    assert 12 * 10 <= first <= 12 * 12  # one turn after ten idle rounds
    assert air.leases(1000, 1200) > air.leases(200, 400) > 0


@STATEMENTS
def test_deaf_agents_give_nothing_away(statement: Any) -> None:
    air = Air(make(12, 6, statement=statement)).run(600)
    air.run(300, jam=True)
    # What is still said at first was given away before the jam.
    later = [slot for slot in range(600 + 16 * 12, 900) if slot in air.frames and any(air.frames[slot].leases)]
    assert later == []
    before = len(air.sent)
    air.run(600)
    assert all(len(senders) <= 1 for senders in air.sent[before:])
    assert air.leases(1200, 1500) > 0


def test_a_goodbye_frees_the_turns_at_once() -> None:
    air = Air(make(12, 12)).run(240)
    air.swarm.leave(3)
    air.run(12)
    last = next(slot for slot in range(240, 252) if air.sent[slot] == (4,))
    assert air.frames[last].leaving
    assert air.swarm.present[3] == 0
    air.run(120)
    turns = [slot for slot in range(last + 13, 372) if slot % 12 == 3]
    used = [slot for slot in turns if air.sent[slot]]
    assert used == [slot for slot in turns if not is_anchor(slot, 12)]
    assert air.frames[next(slot for slot in range(last + 1, 372) if air.sent[slot] == (5,))].c_s == 1


def test_a_dead_agents_turns_are_adopted() -> None:
    air = Air(make(12, 12), loss=0.1).run(300)
    air.swarm.present[3] = 0
    limit = 1000 + 2 * 3 * 12
    air.run(limit + 60)
    turns = [slot for slot in range(300 + limit, 360 + limit) if slot % 12 == 3 and not is_anchor(slot, 12)]
    assert all(len(air.sent[slot]) == 1 for slot in turns)
    assert all(len(senders) <= 1 for senders in air.sent)


@pytest.mark.parametrize("adoption", [False, True])
@pytest.mark.parametrize("restart_at", range(600, 660, 7))
def test_a_restarted_agent_uses_anchors_only_at_first(adoption: bool, restart_at: int) -> None:
    """It may have given turns away that it has forgotten."""
    swarm = make(12, 6, adoption=adoption, open_every=0)
    air = Air(swarm, loss=0.2).run(restart_at)
    swarm.restart(11)
    swarm.goal[0, 11] = FAR
    air.run(240)
    own = [slot for slot in range(restart_at, restart_at + 240) if 12 in air.sent[slot] and slot % 12 == 11]
    assert is_anchor(own[0], 12)
    assert own[0] - restart_at < 5 * 12
    assert any(not is_anchor(slot, 12) for slot in own)
    assert air.frames[own[0]].probation
    assert not swarm.lease_status(11)["probation"]
    assert all(len(senders) <= 1 for senders in air.sent)


def test_what_was_known_is_gone_after_an_absence() -> None:
    swarm = make(12, 6)
    air = Air(swarm).run(200)
    swarm.present[2] = 0
    air.run(1)
    swarm.present[2] = 1
    air.run(1)
    assert (np.delete(swarm.sent_slot[2], 2) < 0).sum() >= 8  # but for one frame and its gossip
    assert swarm.lease_status(2)["probation"]


def test_waking_takes_the_next_open_turn() -> None:
    swarm = make(40, 10)
    air = Air(swarm).run(2000)
    swarm.goal[0, 30] = FAR
    air.run(200)
    first = next(slot for slot in range(2000, 2200) if 31 in air.sent[slot])
    assert first - 2000 < 60
    assert swarm.lease_status(30)["woke"] == -1
    assert swarm.in_ap[:, 30].all()


def test_many_that_wake_together_get_out_of_each_others_way() -> None:
    swarm = make(40, 10)
    swarm.final[:] = 0
    air = Air(swarm).run(2000)
    swarm.goal[0, 20:] = FAR
    air.run(5 * 40)
    assert sum(len(senders) > 1 for senders in air.sent) <= 6
    assert (swarm.sent_slot[:, 20:] >= 2000).all()


@pytest.mark.parametrize("policy", ["lease", "tdma"])
def test_a_listener_believes_what_each_agent_believes_for_which_it_stands(policy: str) -> None:
    swarm, rows = make(12, 6, policy=policy, frame="extended"), [1, 4, 11]
    listener = Swarm(swarm.config, swarm.scenario, local=[], observers=[row + 1 for row in rows])
    air = Air(swarm, loss=0.3)
    air.also.append(lambda slot, data, mask: listener.hear(slot, data, mask[rows]))
    for _ in range(40):
        air.run(15)
        for name in ("sent_slot", "sent_position", "sent_velocity", "sent_intent", "in_ap", "last_turn"):
            if name != "last_turn" or policy == "lease":  # that of TDMA is noted by those that decide
                np.testing.assert_array_equal(getattr(listener, name), getattr(swarm, name)[rows], err_msg=name)


def frame_of(sender: int, slot: int, **more: Any) -> bytes:
    return encode_extended(ExtendedFrame(Frame(sender, slot, 1, **OWN), **more))


def test_gossip_replaces_only_what_is_older() -> None:
    swarm = make(4, 4)
    swarm.begin(50)

    def gossip(age: int, x: float) -> tuple[Gossip, ...]:
        return (
            Gossip(2, age, True, (x, 0.0, 0.0), (0.0, 0.0, 0.0)),
            Gossip(1, 1, True, (9.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        )

    swarm.hear(50, frame_of(3, 50, gossip=gossip(10, 1.0)))
    assert swarm.sent_slot[0, 1] == 40
    assert swarm.sent_position[0, 0, 1] == pytest.approx(1.0)
    for age, x, expected in ((10, 2.0, 1.0), (20, 3.0, 1.0), (9, 4.0, 4.0)):
        swarm.hear(50, frame_of(3, 50, gossip=gossip(age, x)))
        assert swarm.sent_position[0, 0, 1] == pytest.approx(expected)
    assert swarm.sent_slot[0, 0] == -1  # an agent knows better what it has said itself
    assert swarm.sent_slot[1, 0] == 49


def test_gossip_can_be_switched_off() -> None:
    with_gossip = Air(make(12, 12), loss=0.3).run(600)
    without = Air(make(12, 12, gossip=False), loss=0.3).run(600)
    assert all(not frame.gossip for frame in without.frames.values())
    assert (600 - with_gossip.swarm.sent_slot).mean() < (600 - without.swarm.sent_slot).mean()


@pytest.mark.parametrize("data", [
    frame_of(13, 100), frame_of(3, 98), frame_of(3, 101), frame_of(3, 100, c_s=12),
    frame_of(3, 100, leases=b"\x01" + bytes(10)), frame_of(5, 100, leases=b"\x0d" + bytes(10)),
    frame_of(5, 100, relay=((1, 13),)),
    frame_of(5, 100, gossip=(Gossip(13, 1, True, (0.0,) * 3, (0.0,) * 3),)),
])  # fmt: skip
def test_frames_of_others_are_counted_and_ignored(data: bytes) -> None:
    """Unknown agents, other times, and leases said in somebody else's turn (slot 100 is agent 5's)."""
    swarm = make(12, 6)
    swarm.begin(100)
    before = swarm.sent_slot.copy()
    assert not swarm.hear(100, data)
    assert swarm.foreign == 1
    np.testing.assert_array_equal(swarm.sent_slot, before)
    assert swarm.hear(100, frame_of(5, 100, leases=bytes([6, OPEN]) + bytes(9)))


def test_paper_frames_do_not_reach_an_extended_swarm_nor_the_other_way_round() -> None:
    lease, tdma = make(4, 4), make(4, 4, policy="tdma", frame="paper")
    lease.begin(0), tdma.begin(0)
    assert not lease.hear(0, tdma.frame(0))
    assert not tdma.hear(0, lease.frame(0))
    assert lease.malformed == tdma.malformed == 1
    with pytest.raises(ConfigError, match=r"^frame: got 'paper'"):
        SwarmConfig(policy="lease", frame="paper")


def test_the_chance_of_an_open_turn_halves_five_times_at_most() -> None:
    rules = Rules(agents=12, slot_s=0.01, anchor_every=3, main_every=15)
    taken = {}
    for attempts in (4, 5, 6, 200):
        memory = Memory(rules, 3, woke=0, attempts=attempts, probation=True)
        taken[attempts] = {slot for slot in range(6000) if uses_open_turn(memory, slot)}
    assert taken[5] == taken[6] == taken[200]
    assert 1.5 * len(taken[5]) < len(taken[4]) < 2.5 * len(taken[5])


def test_open_turns_visit_all_owners() -> None:
    for agents in range(2, 255):
        period = SwarmConfig(agents=agents, moving=0, policy="lease").open_period
        assert period == max(11, agents // 5)
        for resting in {1, agents // 3, agents} - {0}:
            blocks = [open_block(agents, period, resting, settled) for settled in (0, resting)]
            assert all(np.gcd(block, agents) == 1 for block in blocks)
            assert period * agents / resting <= blocks[0] <= blocks[1]
    assert SwarmConfig(policy="lease", open_every=0).open_period == 0
    assert open_block(12, 0, 6, 6) == open_block(12, 11, 0, 0) == 0


def test_open_turns_are_spaced_evenly() -> None:
    """So who wakes waits for one block at most, the odd one that is nobody's apart."""
    air = Air(make(40, 10, open_every=20)).run(3000)
    block = open_block(40, 20, 30, 30)
    opened = [slot for slot in range(3000, 3600) if REASONS[air.run(1).swarm.reason[0]] == "open"]
    assert len(opened) >= 0.9 * 600 / block
    assert max(np.diff(opened)) < 2 * block


def test_who_knows_that_it_will_rest_speaks_at_main_anchors_only() -> None:
    """Agent 12 does not know: it goes on speaking every M rounds."""
    swarm = make(12, 6)
    swarm.final[11] = 0
    air = Air(swarm).run(3000)
    main = Memory(Rules(agents=12, slot_s=0.01, main_every=15)).is_main
    for agent in range(7, 12):
        assert [slot for slot in range(1000, 3000) if (agent,) == air.sent[slot]] == [
            slot for slot in range(1000, 3000) if slot % 12 == agent - 1 and main(slot)
        ]
    assert all(air.sent[slot] == (12,) for slot in range(1000, 3000) if slot % 12 == 11 and is_anchor(slot, 12))
    assert all(len(senders) <= 1 for senders in air.sent)


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_who_has_arrived_hands_its_turns_on(loss: float) -> None:
    """Within reach all but the last one: it goes to those that move on; without OPEN turns nobody does that."""
    sent = {}
    for handing in (True, False):
        swarm = make(24, 4, open_every=11 if handing else 0, anchor_rest=1)
        swarm.final[3] = 0  # gives away none of its own turns for now
        air = Air(swarm, loss).run(900)
        swarm.goal[:, 3] = swarm.position[:, 3]
        air.run(72)
        sent[handing] = air.sent[912:972].count((4,))
        assert all(len(senders) <= 1 for senders in air.sent)
    assert 3 <= sent[True] <= 0.6 * sent[False]


def test_who_wakes_is_given_turns_by_those_that_have_plenty() -> None:
    """Owners have given theirs away for rounds to come: agent 5 has one turn of its own a round."""
    swarm = make(24, 4)
    swarm.final[4] = 0
    air = Air(swarm).run(905)
    swarm.goal[0, 4] = FAR
    air.run(120)
    assert air.sent[930:1020].count((5,)) >= 10  # three own turns, and a fair share is 18


@pytest.mark.parametrize("rests", [True, False])
def test_who_rests_is_thought_dead_later(rests: bool) -> None:
    """It may speak in its main anchors only: two of them lost mean nothing."""
    swarm = make(40, 10)
    air = Air(swarm).run(1200)
    quiet = 20 if rests else 2
    swarm.present[quiet - 1] = 0
    air.run(900)  # of 1000, and of 6 K M N
    assert not swarm.lease_status(0)["absent"]
    air.run(400)
    assert bool(swarm.lease_status(0)["absent"]) is not rests


def test_turns_are_spread_evenly_over_those_that_move() -> None:
    air = Air(make(12, 6)).run(3000)
    gaps = [np.diff([slot for slot in range(1500, 3000) if air.sent[slot] == (agent,)]) for agent in range(1, 7)]
    assert max(each.max() for each in gaps) <= 12
    ages = [((each**2).sum() / each.sum() - 1.0) / 2.0 for each in gaps]
    assert 2.5 <= np.mean(ages) < 3.1  # (6 - 1) / 2 is the bound


def test_who_knows_where_all_want_to_be_gives_turns_away_from_the_first_round_on() -> None:
    """But not to those who are known to stand at their targets, nor where nobody knows that."""
    for known in (False, True):
        plain = still(12)
        target = plain.target.copy()
        target[0, [4, 9]] += 20.0
        swarm = Swarm(
            SwarmConfig(agents=12, policy="lease", avoider="none"),
            Scenario(plain.start, target, plain.moving, goals_known=known),
        )
        swarm.active[:] = 0
        air = Air(swarm).run(36)
        assert air.sent[:12] == [(slot + 1,) for slot in range(12)]
        said = {byte for slot in range(12) for byte in air.frames[slot].leases} - {0, OPEN}
        assert said == {5, 10}
        first = [slot for slot in range(12) if any(air.frames[slot].leases)]
        assert (first[0] == 0) is known
        late = sum(air.sent[slot] in ((5,), (10,)) for slot in range(12, 36))
        assert (late >= 20) is known


@pytest.mark.parametrize(("agents", "every"), [(3, 5), (5, 2), (2, 8)])
def test_small_swarms_that_hear_late_relay_no_turn_that_nobody_gave_away(agents: int, every: int) -> None:
    """24 slots reach beyond their memory of (M + 2) N turns."""
    swarm = make(agents, 1, open_every=0, adoption=False, anchor_every=every)
    relayed, heard = set(), None
    for slot in range(200):
        senders = swarm.begin(slot)
        assert len(senders) < 2
        if heard is not None and slot % 3:
            swarm.hear(slot, heard)  # a slot late
        heard = swarm.frame(senders[0]) if senders else None
        if heard is not None:
            relayed |= {ahead for ahead, _ in decode_extended(heard).relay}
            if not slot % 3:
                swarm.hear(slot, heard)
        swarm.end(slot)
    assert 0 < max(relayed) < (every + 2) * agents


@STATEMENTS
def test_an_agent_that_may_get_another_goal_keeps_its_anchors_only(statement: Any) -> None:
    swarm = make(12, 4, statement=statement)
    swarm.final[:] = 0
    air = Air(swarm).run(12 * 60)
    hovering = [slot for slot in range(12 * 40, 12 * 60) if slot % 12 >= 4]
    assert [slot for slot in hovering if air.sent[slot] == (slot % 12 + 1,)] == [
        slot for slot in hovering if is_anchor(slot, 12)
    ]


def flight(**settings: Any) -> Air:
    config = SwarmConfig(policy="lease", agents=24, scenario="staggered", slot_ms=33, **settings)
    return Air(Swarm(config, make_scenario(config)), flying=True)


@pytest.mark.parametrize("seed", [1004, 1022])
def test_nobody_sets_out_unheard(seed: int) -> None:
    # Two wake in one slot, send in one OPEN turn, and both frames are lost.
    air, flown = flight(avoider="bvc", seed=seed), set()
    course = air.swarm.course
    assert course is not None
    for _ in range(900):
        air.run(1)
        for k in np.flatnonzero(air.swarm.active & (course.changed > 0)):
            assert np.delete(air.swarm.sent_slot[:, k], k).max() >= course.changed[k]
            flown.add(int(k))
    assert len(flown) >= 14
    assert any(len(senders) > 1 for senders in air.sent)
