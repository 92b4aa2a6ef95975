"""Losses that were measured: a chain for each link, and files of them."""

from __future__ import annotations

import json

import numpy as np
import pytest

from dtsa_agent.core.errors import ConfigError
from dtsa_channel_sim import Channel, ChannelConfig, MeasuredLosses
from dtsa_channel_sim.model.gilbert import GilbertElliott

SLOT_NS = 10_000_000


def losses(agents=4, enter=0.0, leave=1.0, loss_good=0.0, loss_bad=1.0, **more):
    """A file's content: matrices, or one number for all links."""
    numbers = {"enter": enter, "leave": leave, "loss_good": loss_good, "loss_bad": loss_bad}
    filled = {name: np.broadcast_to(value, (agents, agents)).tolist() for name, value in numbers.items()}
    return {"slot_ns": SLOT_NS, **filled, **more}


def received(channel, slot, sender):
    return channel.arbitrate(slot, (sender,)).mask(channel.config.agents)[0]


@pytest.mark.parametrize(("p_good", "p_bad"), [(0.0, 1.0), (0.1, 0.8)])
def test_equal_chains_on_all_links_lose_what_bursts_of_links_lose(p_good, p_bad):
    model = GilbertElliott.from_means(0.3, 6.0, p_good, p_bad)
    measured = losses(9, model.enter, model.leave, p_good, p_bad)
    bursts = {"loss": 0.3, "burst_length": 6.0, "burst_scope": "link", "p_good": p_good, "p_bad": p_bad}
    one = Channel(ChannelConfig(agents=9, seed=4, losses=measured))
    two = Channel(ChannelConfig(agents=9, seed=4, **bursts))
    for slot in (*range(0, 6000, 7), 3, 50_000):
        assert np.array_equal(received(one, slot, slot % 9 + 1), received(two, slot, slot % 9 + 1))


def test_each_link_has_its_own_losses_and_those_of_further_agents_do_not_count():
    good = np.zeros((6, 6))
    good[0, 1] = good[2, 1] = good[2, 3] = good[5, 0] = 1.0
    channel = Channel(ChannelConfig(agents=4, losses=losses(6, loss_good=good)))
    mask = np.vstack([received(channel, 0, sender) for sender in range(1, 5)]).astype(int)
    assert mask.tolist() == [[0, 0, 1, 1], [1, 0, 1, 1], [1, 0, 0, 0], [1, 1, 1, 0]]


def test_settings_come_back_from_plain_values():
    config = ChannelConfig(agents=4, losses=losses(4, 0.1, 0.2))
    assert isinstance(config.losses, MeasuredLosses)
    again = ChannelConfig.from_dict(json.loads(json.dumps(config.to_dict())))
    assert again == config
    assert hash(again) == hash(config)
    assert again.changed({"loss": 0.5}).losses is again.losses
    assert ChannelConfig(agents=4).to_dict()["losses"] == ""


@pytest.mark.parametrize(("given_losses", "field"), [
    (3, "losses"), ({}, "losses.enter"), (losses(enter=0.5, leave=0.6), r"losses.leave\[0\]\[1\]"),
    (losses(loss_bad=1.5), r"losses.loss_bad\[0\]\[1\]"),
    ({**losses(), "leave": [[1.0]]}, r"losses.leave: got 'shape \(1, 1\)'"),
    ({**losses(), "loss_good": "all"}, "losses.loss_good"), (losses(format="dtsa-losses 1"), "losses.format"),
    (losses(slot_ns=20_000_000), "slots of 20 ms"), (losses(slot_ns=10**400), "losses.slot_ns"),
    ({**losses(), "loss_bad": [[10**400] * 4] * 4}, "losses.loss_bad"), (losses(3), "of 3 agents"),
])  # fmt: skip
def test_what_cannot_be_used_is_named(given_losses, field):
    with pytest.raises(ConfigError, match=field):
        ChannelConfig(agents=4, slot_ns=SLOT_NS, losses=given_losses)


def test_a_second_model_of_bursts_is_refused():
    with pytest.raises(ConfigError, match="burst_length"):
        ChannelConfig(agents=4, loss=0.1, burst_length=5.0, losses=losses())


def test_files_that_are_none_are_refused(tmp_path):
    (tmp_path / "bytes.json").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "list.json").write_text("[1]")
    (tmp_path / "deep.json").write_text("[" * 100_000)
    for name in ("bytes.json", "list.json", "deep.json", "", "none.json", "long" * 100, "nul\0"):
        with pytest.raises(ConfigError, match="losses"):
            ChannelConfig(agents=2, losses=str(tmp_path / name))


def test_a_file_tells_its_name_and_its_hash(tmp_path):
    path = tmp_path / "hall.json"
    path.write_text(json.dumps(losses(2, loss_good=0.25)))
    found = ChannelConfig(agents=2, losses=str(path)).losses
    assert found.name == "hall.json"
    assert len(found.sha256) == 64
    assert str(found).startswith("hall.json (")
