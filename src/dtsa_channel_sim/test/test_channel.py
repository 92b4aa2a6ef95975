"""The channel: outcomes, reach, hidden senders, capture, jam, partition, airtimes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_agent.core.errors import LocalProtocolError
from dtsa_channel_sim import COLLISION, IDLE, SUCCESS, Channel, ChannelConfig

MS = 1_000_000


def test_outcomes_without_loss():
    channel = Channel(ChannelConfig(agents=4))
    idle = channel.arbitrate(0, ())
    assert (idle.outcome, idle.senders, idle.mask(4).shape) == (IDLE, (), (0, 4))
    one = channel.arbitrate(1, [3])
    assert (one.outcome, one.senders, one.received, one.lost, one.collided) == (SUCCESS, (3,), None, None, None)
    assert one.mask(4).tolist() == [[True, True, False, True]]
    assert channel.arbitrate(2, np.array([3])) is one
    two = channel.arbitrate(3, (4, 1))
    assert (two.outcome, two.senders, two.lost, two.collided) == (COLLISION, (4, 1), (0, 0), (3, 3))
    assert two.received.shape == (2, 4)
    assert not two.received.any()


@pytest.mark.parametrize("senders", [(0,), (5,), (-1,), (2, 2), (1, 5)])
def test_impossible_senders(senders):
    with pytest.raises(LocalProtocolError):
        Channel(ChannelConfig(agents=4)).arbitrate(0, senders)


def test_arguments_that_do_not_go_together():
    channel = Channel(ChannelConfig(agents=4))
    with pytest.raises(LocalProtocolError, match="slots count from 0"):
        channel.arbitrate(-1, ())
    with pytest.raises(LocalProtocolError, match="lengths: 2 values for 1"):
        Channel(ChannelConfig(agents=4, slot_ns=200_000)).arbitrate(0, (1,), lengths=[10, 10])
    with pytest.raises(LocalProtocolError, match="positions"):
        Channel(ChannelConfig(agents=4, range_m=1.0)).arbitrate(0, (1,))


def test_a_lonely_agent_sends_to_nobody():
    channel = Channel(ChannelConfig(agents=1, loss=0.5))
    verdict = channel.arbitrate(0, (1,))
    assert verdict.outcome == SUCCESS
    assert not verdict.mask(1).any()


@given(st.integers(2, 12), st.floats(0, 1), st.integers(0, 99), st.data())
@settings(max_examples=60, deadline=None)
def test_books_balance(agents, loss, seed, data):
    """Without limits of reach every receiver of every frame received it, lost it, or had it collide."""
    channel = Channel(ChannelConfig(agents=agents, loss=loss, seed=seed, jam=data.draw(st.booleans())))
    for slot in range(5):
        senders = data.draw(st.lists(st.integers(1, agents), unique=True, max_size=agents))
        verdict = channel.arbitrate(slot, senders)
        assert verdict.outcome == min(len(senders), 2)
        mask = verdict.mask(agents)
        assert mask.shape == (len(senders), agents)
        lost, collided = verdict.lost or (0,) * len(senders), verdict.collided or (0,) * len(senders)
        for row, sender in enumerate(senders):
            assert not mask[row, sender - 1]
            assert mask[row].sum() + lost[row] + collided[row] == agents - 1
        if len(senders) > 1:
            assert not mask.any()
            assert not any(lost)


def test_jam():
    channel = Channel(ChannelConfig(agents=4, schedule=({"slot": 5, "until": 7, "jam": True},)))
    verdicts = [channel.arbitrate(slot, (2,)) for slot in range(9)]
    assert [v.mask(4).sum() for v in verdicts] == [3, 3, 3, 3, 3, 0, 0, 3, 3]
    assert (verdicts[5].outcome, verdicts[5].lost, verdicts[5].collided) == (SUCCESS, (3,), (0,))
    assert channel.arbitrate(5, (1, 2)).outcome == COLLISION


def test_partition_and_merge():
    channel = Channel(ChannelConfig(agents=5, schedule=({"slot": 2, "until": 4, "partition": [[1, 2], [3, 4]]},)))
    assert channel.arbitrate(1, (1, 3)).outcome == COLLISION
    apart = channel.arbitrate(2, (1, 3))
    assert (apart.outcome, apart.lost, apart.collided) == (SUCCESS, (0, 0), (0, 0))
    assert apart.received.astype(int).tolist() == [[0, 1, 0, 0, 0], [0, 0, 0, 1, 0]]
    assert not channel.arbitrate(3, (5,)).mask(5).any()
    within = channel.arbitrate(3, (3, 4, 1))
    assert (within.outcome, within.collided) == (COLLISION, (1, 1, 0))
    assert within.received[2].tolist() == [False, True, False, False, False]
    assert channel.arbitrate(4, (1,)).received is None


def brute(config, positions, senders, partition):
    """Who receives what in lockstep, receiver by receiver, and how many lose each frame, from the definition alone."""
    count = config.agents

    def distance(a, b):
        return math.dist(positions[:, a - 1], positions[:, b - 1])

    def group(a):
        return next((i for i, g in enumerate(partition) if a in g), -1)

    rows, collided = [], []
    for frame in senders:
        row, reach = [], -1
        for receiver in range(1, count + 1):
            near = distance(frame, receiver) <= config.range_m and group(frame) == group(receiver)
            limit = config.range_m * config.interference_factor
            disturbing = [
                other
                for other in senders
                if other not in (frame, receiver)
                and distance(other, receiver) <= limit
                and group(other) == group(receiver)
            ]
            clear = not disturbing
            if disturbing and config.capture_db:
                noise = sum(distance(other, receiver) ** -config.path_loss_exponent for other in disturbing)
                signal = distance(frame, receiver) ** -config.path_loss_exponent if receiver != frame else 1.0
                clear = 10 * math.log10(signal / noise) >= config.capture_db
            row.append(near and clear and receiver not in senders)
            reach += near
        rows.append(row)
        collided.append(reach - sum(row))
    return rows, collided


@pytest.mark.parametrize("first", range(0, 2000, 500))
def test_against_the_definition(first):
    for seed in range(first, first + 500):
        check_against_the_definition(np.random.default_rng(seed))


def check_against_the_definition(rng):
    agents = int(rng.integers(2, 9))
    positions = rng.uniform(-6, 6, (3, agents))
    config = ChannelConfig(
        agents=agents, range_m=rng.uniform(1, 15), interference_factor=rng.choice([1.0, 1.7]),
        capture_db=rng.choice([0.0, rng.uniform(0.1, 20.0)]), path_loss_exponent=rng.choice([2.0, 2.5]),
    )  # fmt: skip
    split = int(rng.integers(0, agents)) * int(rng.integers(0, 2))
    partition = [tuple(range(1, split + 1)), tuple(range(split + 1, agents + 1))] if split else []
    channel = Channel(config)
    channel.set(partition=partition)
    senders = (1 + rng.permutation(agents)[: rng.integers(1, 5)]).tolist()
    verdict = channel.arbitrate(0, senders, positions=positions)
    received, collided = brute(config, positions, senders, partition)
    assert verdict.mask(agents).tolist() == received
    assert list(verdict.collided or (0,) * len(senders)) == collided
    assert not any(verdict.lost or ())
    assert verdict.outcome == (COLLISION if any(collided) else SUCCESS)


def test_a_long_frame_spills_into_short_slots_even_in_lockstep():
    channel = Channel(ChannelConfig(agents=3, slot_ns=200_000))
    assert channel.arbitrate(0, (1,), lengths=[60]).outcome == SUCCESS
    assert channel.arbitrate(1, (2,), lengths=[24]).outcome == COLLISION
    assert channel.arbitrate(2, ()).outcome == IDLE
    assert channel.arbitrate(5, (2,), lengths=[24]).outcome == SUCCESS


def test_a_tail_does_not_survive_a_look_back():
    channel = Channel(ChannelConfig(agents=3, slot_ns=200_000))
    assert channel.arbitrate(4, (1,), lengths=[60]).outcome == SUCCESS
    assert channel.arbitrate(0, (2,), lengths=[24]).outcome == SUCCESS
