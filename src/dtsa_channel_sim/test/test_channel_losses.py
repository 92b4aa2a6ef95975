"""Losses: their statistics, that they depend on seed, slot and link alone, and files of measured ones."""

from __future__ import annotations

import hashlib
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_agent.core.errors import ConfigError
from dtsa_channel_sim import Channel, ChannelConfig, MeasuredLosses
from dtsa_channel_sim.model.draws import STATE, WordBlocks, threshold
from dtsa_channel_sim.model.gilbert import Chains, GilbertElliott

MODELS = {
    "independent": {"loss": 0.3},
    "bursts": {"loss": 0.3, "burst_length": 6},
    "links": {"loss": 0.3, "burst_length": 6, "burst_scope": "link"},
    "mixed": {"loss": 0.3, "burst_length": 6, "p_good": 0.1, "p_bad": 0.8},
}


def received(channel, slot, senders):
    return channel.arbitrate(slot, senders).mask(channel.config.agents)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("loss", [0.01, 0.1, 0.3])
def test_mean_loss(model, loss):
    agents, slots = 12, 30_000
    extra = {**MODELS[model], "loss": loss}
    if model == "mixed":
        extra |= {"p_good": loss / 2, "p_bad": 0.9}
    channel = Channel(ChannelConfig(agents=agents, seed=5, **extra))
    lost = sum((channel.arbitrate(slot, (slot % agents + 1,)).lost or (0,))[0] for slot in range(slots))
    frames = slots * (agents - 1)
    # Runs of losses at one receiver make fewer independent samples: variance grows by about 2 L.
    spread = math.sqrt(loss * (1 - loss) / frames * (1 + 2 * extra.get("burst_length", 0)))
    assert abs(lost / frames - loss) < 4.5 * spread


def test_receivers_and_links_are_independent():
    """Losses at two receivers, of two links to one receiver, and in neighbouring slots do not go together."""
    agents, slots, p = 8, 60_000, 0.2
    channel = Channel(ChannelConfig(agents=agents, loss=p, seed=2))
    lost = np.array([channel._losses.lost(slot, 1) for slot in range(slots)])
    other = np.array([channel._losses.lost(slot, 2) for slot in range(slots)])
    bound = 5.0 / math.sqrt(slots)
    correlation = np.corrcoef(np.hstack([lost, other, np.roll(lost, 1, axis=0)]).T)
    np.fill_diagonal(correlation, 0.0)
    assert np.abs(correlation).max() < bound
    # Three links to one receiver at once, as the words share one root.
    third = np.array([channel._losses.lost(slot, 3) for slot in range(slots)])
    for receiver in range(agents):
        together = np.mean(lost[:, receiver] & other[:, receiver] & third[:, receiver])
        assert abs(together - p**3) < 5.0 * math.sqrt(p**3 / slots)


@pytest.mark.parametrize("agents", [2, 70, 200])
def test_lost_per_slot_is_binomial(agents):
    slots, p = 4000, 0.1
    channel = Channel(ChannelConfig(agents=agents, loss=p, seed=11))
    counts = np.array([(channel.arbitrate(slot, (1,)).lost or (0,))[0] for slot in range(slots)])
    n = agents - 1
    variance = n * p * (1 - p)
    assert abs(counts.mean() - n * p) < 4.5 * math.sqrt(variance / slots)
    fourth = variance * (1 + 3 * (n - 2) * p * (1 - p))
    assert abs(counts.var() - variance) < 5 * math.sqrt((fourth - variance**2 + 1e-9) / slots) + variance / slots * 5


def runs(bad):
    """Lengths of the complete runs of True in a row of flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], bad.astype(int), [0]])))
    lengths = edges[1::2] - edges[::2]
    return lengths[1:-1]


@pytest.mark.parametrize(("loss", "length"), [(0.1, 10.0), (0.2, 5.0), (0.3, 3.0), (0.05, 30.0)])
@pytest.mark.parametrize("scope", ["receiver", "link"])
def test_bursts_have_their_mean_length_and_geometric_shape(loss, length, scope):
    agents, slots = 6, 20_000 if scope == "receiver" else 8_000
    config = ChannelConfig(agents=agents, loss=loss, burst_length=length, burst_scope=scope, seed=3)
    channel = Channel(config)
    bad = np.array([~received(channel, slot, (1,))[0] for slot in range(slots)])[:, 1:]
    lengths = np.concatenate([runs(column) for column in bad.T])
    spread = math.sqrt(length * (length - 1) / len(lengths))
    assert abs(lengths.mean() - length) < 4.5 * spread
    single = np.mean(lengths == 1)
    assert abs(single - 1 / length) < 4.5 * math.sqrt(1 / length / len(lengths))


def test_shortest_bursts_are_independent_losses():
    model = GilbertElliott.from_means(0.2, 1.25)
    assert model.enter == pytest.approx(0.2)
    assert 1 - model.leave == pytest.approx(0.2)
    with pytest.raises(ConfigError, match="burst_length"):
        GilbertElliott.from_means(0.2, 1.2)
    assert GilbertElliott.from_means(1.0, 3.0).bad_share == 1.0


def walked(model, words, end):
    """The chain as the textbooks have it, one slot after the other."""
    state = words[0] < threshold(model.bad_share)
    states = {0: state}
    for slot in range(1, end):
        enter = words[slot] < threshold(model.enter)
        stay = words[slot] < threshold(1.0 - model.leave)
        state = np.where(state, stay, enter)
        states[slot] = state
    return states


@given(
    seed=st.integers(0, 2**32), loss=st.floats(0.01, 0.6), stretch=st.floats(1.0, 200.0),
    order=st.randoms(use_true_random=False),
)  # fmt: skip
@settings(max_examples=40, deadline=None)
def test_chain_looked_at_anywhere_is_the_chain_walked(seed, loss, stretch, order):
    agents, end = 200, 900  # three blocks of words
    words = WordBlocks(seed, STATE, agents)
    model = GilbertElliott.from_means(loss, stretch / (1 - loss))
    all_words = words.span(0, end)
    expected = walked(model, all_words, end)
    by_link = walked(model, all_words * words.factors[7], end)
    chains = Chains(model, words)
    draw = np.random.default_rng(seed)  # measured losses: a chain of its own for each link
    kept, share = draw.choice([0.0, 0.5, 0.95, 0.999], (agents, agents)), draw.uniform(0.05, 0.9, (agents, agents))
    measured = GilbertElliott(share, (1 - kept) * share, (1 - kept) * (1 - share))
    row = GilbertElliott(measured.bad_share[6], measured.enter[6], measured.leave[6])
    by_measured_link, measured_chains = walked(row, all_words * words.factors[7], end), Chains(measured, words)
    for slot in order.sample(range(end), 25):
        assert np.array_equal(chains.bad(slot, 0), expected[slot])
        assert np.array_equal(chains.bad(slot, 7), by_link[slot])
        assert np.array_equal(measured_chains.bad(slot, 7), by_measured_link[slot])


@pytest.mark.parametrize("model", MODELS)
def test_draws_depend_on_seed_slot_and_link_alone(model):
    config = ChannelConfig(agents=9, seed=4, **MODELS[model])
    every = Channel(config)
    full = {slot: {s: received(every, slot, (s,))[0] for s in (1, 5, 9)} for slot in range(0, 30_000, 7)}
    again = Channel(config)
    for slot in (29_995, 14, 7_000, 7_007, 0, 21_000):
        assert np.array_equal(received(again, slot, (5,))[0], full[slot][5])
    for slot in (7_014, 7, 29_988):
        assert np.array_equal(received(Channel(config), slot, (9,))[0], full[slot][9])
    other = Channel(ChannelConfig(agents=9, seed=5, **MODELS[model]))
    assert any(not np.array_equal(received(other, slot, (1,))[0], full[slot][1]) for slot in list(full)[:50])


@pytest.mark.parametrize("model", MODELS)
def test_frames_of_one_slot_are_lost_as_if_alone(model):
    """Two frames that do not meet are lost where each of them would have been lost alone."""
    config = ChannelConfig(agents=10, seed=8, range_m=5.0, **MODELS[model])
    positions = np.zeros((3, 10))
    positions[0, 5:] = 100.0
    both, one, two = Channel(config), Channel(config), Channel(config)
    for slot in range(300):
        rows = both.arbitrate(slot, (2, 8), positions=positions)
        assert rows.collided == (0, 0)
        assert np.array_equal(rows.received[0], one.arbitrate(slot, (2,), positions=positions).mask(10)[0])
        assert np.array_equal(rows.received[1], two.arbitrate(slot, (8,), positions=positions).mask(10)[0])


def test_certain_and_impossible_losses_are_exact():
    for loss, expected in ((0.0, 0), (1.0, 3)):
        channel = Channel(ChannelConfig(agents=4, loss=loss, link_loss=({"from": 1, "to": 2, "loss": loss},)))
        for slot in range(3000):
            assert (channel.arbitrate(slot, (1,)).lost or (0,))[0] == expected
    assert int(threshold(1.0)) == 2**64 - 1
    assert int(threshold(0.0)) == 0
    assert int(threshold(0.5)) == 2**63


def test_links_may_be_asymmetric():
    links = ({"from": 1, "to": [2, 3], "loss": 1.0}, {"from": 4, "to": 1, "loss": 1.0, "both_ways": True})
    channel = Channel(ChannelConfig(agents=5, link_loss=links))
    mask = np.vstack([received(channel, 0, (sender,)) for sender in range(1, 6)]).astype(int)
    assert mask.tolist() == [[0, 0, 0, 0, 1], [1, 0, 1, 1, 1], [1, 1, 0, 1, 1], [0, 1, 1, 0, 1], [1, 1, 1, 1, 0]]


def test_losses_of_links_come_on_top_of_noise_and_of_what_was_measured():
    slots = 40_000
    matrix = [[0.0, 0.5, 0.2], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    good, bad, enter, leave = (np.full((3, 3), value).tolist() for value in (0.1, 1.0, 0.0, 1.0))
    losses = {"slot_ns": 10_000_000, "enter": enter, "leave": leave, "loss_good": good, "loss_bad": bad}
    link = {"from": 1, "to": 2, "loss": 0.5}
    for given_losses, expected in (
        ({"loss": 0.2, "loss_matrix": matrix}, (1 - 0.8 * 0.5, 1 - 0.8 * 0.8)),
        ({"loss": 0.2, "losses": losses, "link_loss": (link,)}, (1 - 0.8 * 0.9 * 0.5, 1 - 0.8 * 0.9)),
    ):
        channel = Channel(ChannelConfig(agents=3, seed=1, **given_losses))
        mask = np.array([received(channel, slot, (1,))[0] for slot in range(slots)])
        assert np.abs(1 - mask[:, 1:].mean(axis=0) - expected).max() < 4.5 * math.sqrt(0.25 / slots)


def test_a_change_of_the_loss_holds_from_its_first_slot():
    """After loss = 0 no old burst goes on, and a new loss holds from its first slot."""
    channel = Channel(ChannelConfig(agents=300, loss=0.9, burst_length=500, seed=1))
    assert channel.arbitrate(0, (1,)).lost[0] > 200
    channel.set(loss=0.0)
    assert channel.arbitrate(1, (1,)).lost is None
    channel.set(loss=0.5, burst_length=1000)
    lost = channel.arbitrate(2, (1,)).lost[0]
    assert abs(lost - 149.5) < 5 * math.sqrt(300 / 4)


def test_a_jam_does_not_disturb_the_draws_around_it():
    config = {"agents": 20, "loss": 0.2, "burst_length": 8, "seed": 6}
    plain, jammed = Channel(ChannelConfig(**config)), Channel(ChannelConfig(**config))
    for slot in range(200):
        if slot == 50:
            jammed.set(jam=True)
        if slot == 90:
            jammed.set(jam=False)
        one, two = received(plain, slot, (3,)), received(jammed, slot, (3,))
        assert np.array_equal(one, two) if not 50 <= slot < 90 else not two.any()


GOLDEN = {
    "independent": "0362d9ed79b65cfc", "bursts": "70d2a72610f651d7", "links": "9da96351be9a63ce",
    "mixed": "e3986e5b289480bd",
}  # fmt: skip


@pytest.mark.parametrize("model", MODELS)
def test_the_same_seed_gives_the_same_losses_for_ever(model):
    """Recorded flights are verified against these draws: they must not change from version to version."""
    channel = Channel(ChannelConfig(agents=18, seed=1, **MODELS[model]))
    digest = hashlib.sha256()
    for slot in range(0, 5000, 3):
        digest.update(np.packbits(received(channel, slot, (slot % 18 + 1,))).tobytes())
    assert digest.hexdigest()[:16] == GOLDEN[model]


SLOT_NS = 10_000_000


def loss_file(agents=4, enter=0.0, leave=1.0, loss_good=0.0, loss_bad=1.0, **more):
    """A file's content: matrices, or one number for all links."""
    numbers = {"enter": enter, "leave": leave, "loss_good": loss_good, "loss_bad": loss_bad}
    filled = {name: np.broadcast_to(value, (agents, agents)).tolist() for name, value in numbers.items()}
    return {"slot_ns": SLOT_NS, **filled, **more}


@pytest.mark.parametrize(("p_good", "p_bad"), [(0.0, 1.0), (0.1, 0.8)])
def test_equal_chains_on_all_links_lose_what_bursts_of_links_lose(p_good, p_bad):
    model = GilbertElliott.from_means(0.3, 6.0, p_good, p_bad)
    measured = loss_file(9, model.enter, model.leave, p_good, p_bad)
    bursts = {"loss": 0.3, "burst_length": 6.0, "burst_scope": "link", "p_good": p_good, "p_bad": p_bad}
    one = Channel(ChannelConfig(agents=9, seed=4, losses=measured))
    two = Channel(ChannelConfig(agents=9, seed=4, **bursts))
    for slot in (*range(0, 6000, 7), 3, 50_000):
        assert np.array_equal(received(one, slot, (slot % 9 + 1,))[0], received(two, slot, (slot % 9 + 1,))[0])


def test_each_link_has_its_own_losses_and_those_of_further_agents_do_not_count():
    good = np.zeros((6, 6))
    good[0, 1] = good[2, 1] = good[2, 3] = good[5, 0] = 1.0
    channel = Channel(ChannelConfig(agents=4, losses=loss_file(6, loss_good=good)))
    mask = np.vstack([received(channel, 0, (sender,))[0] for sender in range(1, 5)]).astype(int)
    assert mask.tolist() == [[0, 0, 1, 1], [1, 0, 1, 1], [1, 0, 0, 0], [1, 1, 1, 0]]


def test_settings_come_back_from_plain_values():
    config = ChannelConfig(agents=4, losses=loss_file(4, 0.1, 0.2))
    assert isinstance(config.losses, MeasuredLosses)
    again = ChannelConfig.from_dict(json.loads(json.dumps(config.to_dict())))
    assert again == config
    assert hash(again) == hash(config)
    assert again.changed({"loss": 0.5}).losses is again.losses
    assert ChannelConfig(agents=4).to_dict()["losses"] == ""


@pytest.mark.parametrize(("given_losses", "field"), [
    (3, "losses"), ({}, "losses.enter"), (loss_file(enter=0.5, leave=0.6), r"losses.leave\[0\]\[1\]"),
    (loss_file(loss_bad=1.5), r"losses.loss_bad\[0\]\[1\]"),
    ({**loss_file(), "leave": [[1.0]]}, r"losses.leave: got 'shape \(1, 1\)'"),
    ({**loss_file(), "loss_good": "all"}, "losses.loss_good"), (loss_file(format="dtsa-losses 1"), "losses.format"),
    (loss_file(slot_ns=20_000_000), "slots of 20 ms"), (loss_file(slot_ns=10**400), "losses.slot_ns"),
    ({**loss_file(), "loss_bad": [[10**400] * 4] * 4}, "losses.loss_bad"), (loss_file(3), "of 3 agents"),
])  # fmt: skip
def test_what_cannot_be_used_is_named(given_losses, field):
    with pytest.raises(ConfigError, match=field):
        ChannelConfig(agents=4, slot_ns=SLOT_NS, losses=given_losses)


def test_a_second_model_of_bursts_is_refused():
    with pytest.raises(ConfigError, match="burst_length"):
        ChannelConfig(agents=4, loss=0.1, burst_length=5.0, losses=loss_file())


def test_files_that_are_none_are_refused(tmp_path):
    (tmp_path / "bytes.json").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "list.json").write_text("[1]")
    (tmp_path / "deep.json").write_text("[" * 100_000)
    for name in ("bytes.json", "list.json", "deep.json", "", "none.json", "long" * 100, "nul\0"):
        with pytest.raises(ConfigError, match="losses"):
            ChannelConfig(agents=2, losses=str(tmp_path / name))


def test_a_file_tells_its_name_and_its_hash(tmp_path):
    path = tmp_path / "hall.json"
    path.write_text(json.dumps(loss_file(2, loss_good=0.25)))
    found = ChannelConfig(agents=2, losses=str(path)).losses
    assert found.name == "hall.json"
    assert len(found.sha256) == 64
    assert str(found).startswith("hall.json (")
