"""Losses that were measured: chains of single links, and records that are replayed."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_agent.core.errors import ConfigError
from dtsa_channel_sim import Channel, ChannelConfig, MeasuredLosses
from dtsa_channel_sim.model.draws import STATE, WordBlocks, sender_factors, threshold
from dtsa_channel_sim.model.gilbert import Chains, GilbertElliott, LinkChains
from dtsa_channel_sim.model.loss_record import HEARD, LOST, UNKNOWN, LossRecord, pack, unpack

SLOT_NS = 10_000_000


def chains(*links, agents=4, **more):
    return {"agents": agents, "slot_ns": SLOT_NS, "links": [list(link) for link in links], **more}


def received(channel, slot, sender):
    return channel.arbitrate(slot, (sender,)).mask(channel.config.agents)[0]


@pytest.mark.parametrize(("p_good", "p_bad"), [(0.0, 1.0), (0.1, 0.8)])
def test_equal_chains_on_all_links_lose_what_bursts_of_links_lose(p_good, p_bad):
    model = GilbertElliott.from_means(0.3, 6.0, p_good, p_bad)
    losses = chains((0, 0, model.enter, model.leave, p_good, p_bad))
    bursts = {"loss": 0.3, "burst_length": 6.0, "burst_scope": "link", "p_good": p_good, "p_bad": p_bad}
    one = Channel(ChannelConfig(agents=9, seed=4, losses=losses))
    two = Channel(ChannelConfig(agents=9, seed=4, **bursts))
    for slot in (*range(0, 6000, 7), 3, 50_000):
        assert np.array_equal(received(one, slot, slot % 9 + 1), received(two, slot, slot % 9 + 1))


@pytest.mark.parametrize(("p_good", "p_bad"), [(0.0, 1.0), (0.1, 0.8)])
def test_equal_chains_of_all_receivers_lose_what_bursts_of_receivers_lose(p_good, p_bad):
    model = GilbertElliott.from_means(0.3, 6.0, p_good, p_bad)
    rows = [[0, receiver, model.enter, model.leave, p_good, p_bad] for receiver in range(1, 10)]
    losses = {"agents": 9, "scope": "receiver", "receivers": rows}
    bursts = {"loss": 0.3, "burst_length": 6.0, "p_good": p_good, "p_bad": p_bad}
    one = Channel(ChannelConfig(agents=9, seed=4, losses=losses))
    two = Channel(ChannelConfig(agents=9, seed=4, **bursts))
    for slot in (*range(0, 20_000, 7), 3, 50_000):
        assert np.array_equal(received(one, slot, slot % 9 + 1), received(two, slot, slot % 9 + 1))
    assert ChannelConfig.from_dict(one.config.to_dict()) == one.config


@given(seed=st.integers(0, 2**32), order=st.randoms(use_true_random=False))
@settings(max_examples=25, deadline=None)
def test_chains_of_links_looked_at_anywhere_are_the_chains_walked(seed, order):
    agents, end, sender = 60, 2500, 7
    draw = np.random.default_rng(seed)
    kept = draw.choice([0.0, 0.5, 0.95, 0.999], (agents, agents))
    share = draw.uniform(0.05, 0.9, (agents, agents))
    model = LinkChains(share, (1 - kept) * share, (1 - kept) * (1 - share))
    words, factors = WordBlocks(seed, STATE, agents), sender_factors(seed, STATE, agents)
    own, row = words.span(0, end) * factors[sender], sender - 1
    state = own[0] < threshold(share[row])
    walked = [state]
    for slot in range(1, end):
        enter, stay = own[slot] < threshold(model.enter[row]), own[slot] < threshold(1.0 - model.leave[row])
        walked.append(np.where(walked[-1], stay, enter))
    looked = Chains(model, words, factors)
    for slot in order.sample(range(end), 25):
        assert np.array_equal(looked.links(slot, sender)[0], walked[slot])


def test_each_link_has_its_own_losses_and_others_have_those_of_all_others():
    losses = chains((1, 2, 0, 1, 1, 1), (3, 0, 0, 1, 1, 1), (3, 1, 0, 1, 0, 0), others={
        "enter": 0, "leave": 1, "loss_good": 0, "loss_bad": 0,
    })  # fmt: skip
    channel = Channel(ChannelConfig(agents=5, losses=losses))
    mask = np.vstack([received(channel, 0, sender) for sender in range(1, 6)]).astype(int)
    assert mask.tolist() == [[0, 0, 1, 1, 1], [1, 0, 1, 1, 1], [1, 0, 0, 0, 0], [1, 1, 1, 0, 1], [1, 1, 1, 1, 0]]


def test_the_loss_comes_on_top():
    slots, losses = 40_000, chains((0, 0, 0, 1, 0.2, 0.2))
    links = ({"from": 1, "to": 2, "loss": 0.5},)
    channel = Channel(ChannelConfig(agents=3, seed=1, losses=losses, loss=0.1, link_loss=links))
    mask = np.array([received(channel, slot, 1) for slot in range(slots)])
    for receiver, loss in ((1, 1 - 0.8 * 0.9 * 0.5), (2, 1 - 0.8 * 0.9)):
        assert abs(1 - mask[:, receiver].mean() - loss) < 4.5 * np.sqrt(0.25 / slots)


def test_settings_come_back_from_plain_values():
    for losses in (chains((0, 0, 0.1, 0.2, 0, 1)), {"agents": 4, "record": RECORD}):
        config = ChannelConfig(agents=4, losses=losses)
        assert isinstance(config.losses, MeasuredLosses)
        again = ChannelConfig.from_dict(json.loads(json.dumps(config.to_dict())))
        assert again == config
        assert again.changed({"loss": 0.5}).losses is again.losses
    assert ChannelConfig(agents=4).to_dict()["losses"] == ""


SLOTS, SENDERS = np.array([2, 3, 5, 8]), np.array([1, 2, 1, 1])
OUTCOME = np.full((4, 5), UNKNOWN, np.uint8)
OUTCOME[0, 2:4] = HEARD, LOST
OUTCOME[1, [0, 1]] = LOST, HEARD
OUTCOME[2, 2] = LOST
OUTCOME[3, 2:4] = HEARD, HEARD
RECORD = pack(SLOTS, SENDERS, OUTCOME)


def test_a_record_is_replayed_slot_by_slot_and_repeats_itself():
    record = unpack(RECORD, 4)
    lost = {slot: record.lost(slot, 1)[0].astype(int).tolist() for slot in range(12)}
    # Between two frames a link does what it did last; nothing is known of agent 4, which loses nothing.
    assert lost[2] == lost[3] == lost[4] == [0, 0, 1, 0]
    assert lost[5] == lost[6] == lost[7] == [0, 1, 1, 0]
    assert lost[8] == [0, 0, 0, 0]
    assert [lost[slot] for slot in (9, 10, 11)] == [lost[slot] for slot in (2, 3, 4)]
    assert [lost[slot] for slot in (1, 0)] == [lost[slot] for slot in (8, 7)]
    # A listener that is no agent stands for those of which nothing else is known.
    assert record.lost(3, 2)[0].astype(int).tolist() == [0, 1, 1, 1]
    assert not record.lost(3, 3).any()


def test_a_record_on_the_channel_takes_away_what_was_lost_then():
    channel = Channel(ChannelConfig(agents=4, losses={"agents": 4, "record": RECORD}))
    assert received(channel, 2, 1).tolist() == [False, True, False, True]
    noisy = Channel(ChannelConfig(agents=4, loss=1.0, losses={"agents": 4, "record": RECORD}))
    assert not received(noisy, 2, 1).any()


@pytest.mark.parametrize("agents", [1, 7, 8, 9, 70])
def test_a_packed_record_is_the_record(agents):
    draw = np.random.default_rng(agents)
    slots = np.sort(draw.integers(0, 500, 300))
    senders = draw.integers(1, agents + 1, 300)
    outcome = draw.integers(0, 3, (300, agents + 1)).astype(np.uint8)
    plain, again = LossRecord(slots, senders, outcome), unpack(pack(slots, senders, outcome), agents)
    for slot in range(0, 1200, 7):
        for sender in range(1, agents + 1, 3):
            assert np.array_equal(plain.lost(slot, sender), again.lost(slot, sender))


@pytest.mark.parametrize(
    ("losses", "field"),
    [
        (3, "losses"),
        ("no/such/file.json", "losses"),
        ({"agents": 4}, "losses.links"),
        ({"agents": 4, "links": "all"}, "losses.links"),
        ({"agents": 4, "record": "AAAA"}, "losses.record"),
        ({"agents": 4, "record": RECORD[:-8]}, "losses.record"),
        ({"agents": 4, "record": "é"}, "losses.record"),
        (chains((0, 0, 0.5, 0.6, 0, 1)), r"losses.links\[0\].leave"),
        (chains((0, 0, 0.5, 0.5, 0, 1.5)), r"losses.links\[0\].loss_bad"),
        (chains((-1, 0, 0.5, 0.5, 0, 1)), r"losses.links\[0\].sender"),
        (chains((0, 0, 0.5, 0.5, 0)), r"losses.links\[0\]"),
        (chains((0, 0, 0.5, 0.5, 0, 1), (0, 0, 0.5, 0.5, 0, 1)), "each link once"),
        (chains((1, 2, 0.5, 0.5, 0, 1)), "without the link from 1 to 3"),
        (chains((0, 0, 0.5, 0.5, 0, 1), format="dtsa-losses 9"), "losses.format"),
        (chains((0, 0, 0.5, 0.5, 0, 1), others=3), "losses.others"),
        (chains((0, 0, 0.5, 0.5, 0, 1), scope="swarm"), "losses.scope"),
        ({"agents": 4, "scope": "receiver", "links": [[0, 0, 0, 1, 0, 0]]}, "losses.receivers"),
        ({"agents": 4, "scope": "receiver", "receivers": [[1, 2, 0, 1, 0, 0]]}, "sender 0: a receiver"),
        ({**chains((0, 0, 0.5, 0.5, 0, 1)), "slot_ns": 20_000_000}, "slots of 20 ms"),
        ({"agents": 3, "links": [{"sender": 0}]}, r"losses.links\[0\].receiver"),
    ],
)
def test_what_cannot_be_used_is_named(losses, field):
    with pytest.raises(ConfigError, match=field):
        ChannelConfig(agents=4, slot_ns=SLOT_NS, losses=losses)


def test_a_record_of_fewer_agents_and_a_second_model_of_bursts_are_refused():
    with pytest.raises(ConfigError, match="a record of 4 agents"):
        ChannelConfig(agents=5, losses={"agents": 4, "record": RECORD})
    with pytest.raises(ConfigError, match="burst_length"):
        ChannelConfig(agents=4, loss=0.1, burst_length=5.0, losses=chains((0, 0, 0, 1, 0, 0)))
