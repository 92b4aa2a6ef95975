"""Settings of the channel and of clocks: validation, YAML, round trips, the schedule."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dtsa_agent.core.errors import ConfigError
from dtsa_channel_sim import Change, Channel, ChannelConfig, ClockConfig, LinkLoss, make_clocks
from dtsa_channel_sim.model.schedule import Timeline
from dtsa_channel_sim.model.topology import parse_partition


@pytest.mark.parametrize(("settings", "field"), [
    ({"agents": 0}, "agents"), ({"slot_ns": 0}, "slot_ns"), ({"slot_ms": -1}, "slot_ms"),
    ({"slot_ms": 1, "slot_ns": 1}, "slot_ms"), ({"seed": -1}, "seed"), ({"loss": 1.01}, "loss"),
    ({"loss": -0.01}, "loss"), ({"loss": 0.5, "burst_length": 1.5}, "burst_length"),
    ({"loss": 0.05, "burst_length": 5, "p_good": 0.1}, "loss"),
    ({"loss": 0.1, "burst_length": 5, "p_good": 0.2, "p_bad": 0.1}, "p_bad"), ({"burst_scope": "swarm"}, "burst_scope"),
    ({"jam": "no"}, "jam"), ({"partition": [[1, 2], [3, 5]]}, "partition[1][1]"),
    ({"partition": "[[1, 2], [2, 3]]"}, "partition[1]"), ({"partition": [[1], []]}, "partition[1]"),
    ({"partition": "1-2 | 3-4"}, "partition"), ({"partition": 3}, "partition"),
    ({"interference_factor": 0.5}, "interference_factor"), ({"range_m": -1}, "range_m"), ({"los": 0.1}, "los"),
    ({"agents": 2, "loss_matrix": [[0, 1]]}, "loss_matrix"),
    ({"agents": 2, "loss_matrix": [[0, 2], [0, 0]]}, "loss_matrix[0][1]"),
    ({"agents": 2, "loss_matrix": "much"}, "loss_matrix"),
    ({"agents": 2, "loss_matrix": [[0, "1"], [0, 0]]}, "loss_matrix"),
    ({"agents": 2, "loss_matrix": [[0, True], [0.5, 0]]}, "loss_matrix"), ({"partition": np.eye(2)}, "partition"),
    ({"link_loss": {"from": 1}}, "link_loss"),
    ({"link_loss": [{"from": 1, "to": 2}]}, "link_loss[0].loss"),
    ({"link_loss": [{"from": 9, "to": 2, "loss": 1}]}, "link_loss[0].from"),
    ({"link_loss": [{"from": 1, "to": [2, "3-4"], "loss": 1}]}, "link_loss[0].to[1]"),
    ({"link_loss": [{"from": 1, "to": 2, "loss": 3}]}, "link_loss[0].loss"),
    ({"link_loss": [{"from": 1, "to": 2, "los": 3}]}, "link_loss[0].los"),
    ({"schedule": [{"jam": True}]}, "schedule[0].slot"), ({"schedule": [{"slot": 3}]}, "schedule[0]"),
    ({"schedule": [{"slot": 3, "at_s": 1, "jam": True}]}, "schedule[0].at_s"),
    ({"schedule": [{"slot": 3, "until": 3, "jam": True}]}, "schedule[0].until"),
    ({"schedule": [{"slot": 3, "seed": 3}]}, "schedule[0].seed"),
    ({"schedule": [{"slot": 3, "loss": 3}]}, "schedule[0].loss"),
    ({"schedule": [{"slot": 3, "partition": [[9]]}]}, "schedule[0].partition[0][0]"),
    ({"schedule": [{"slot": 3, "burst_length": 1.5}, {"slot": 5, "loss": 0.8}]}, "schedule: burst_length"),
])  # fmt: skip
def test_bad_settings_name_the_field(settings, field):
    with pytest.raises(ConfigError) as caught:
        ChannelConfig.from_dict({"agents": 4} | settings)
    assert caught.value.field == field
    assert "\n" not in str(caught.value)


FULL = {
    "agents": 12, "slot_ms": 20, "seed": 7, "loss": 0.1, "burst_length": 5,
    "link_loss": [{"from": 1, "to": [2, 3], "loss": 0.4, "both_ways": True}],
    "schedule": [
        {"slot": 100, "until": 200, "jam": True},
        {"at_s": 5.01, "partition": [[1, 2, 3], [4, 5]]},
        {"at_s": 8, "until_s": 9, "loss": 0.3},
    ],
}  # fmt: skip


def test_dict_round_trip_through_json():
    config = ChannelConfig.from_dict(FULL)
    assert config.slot_ns == 20_000_000
    assert [change.slot for change in config.schedule] == [100, 251, 400]
    assert config.schedule[1].values == (("partition", ((1, 2, 3), (4, 5), (6, 7, 8, 9, 10, 11, 12))),)
    assert config.link_loss == (LinkLoss((1,), (2, 3), 0.4, True),)
    assert ChannelConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    assert hash(config) == hash(ChannelConfig.from_dict(config.to_dict()))


def test_yaml(tmp_path):
    path = tmp_path / "radio.yaml"
    given_settings = "agents: 6, loss: 5e-2, partition: [[1, 2, 3], [4, 5, 6]]"
    path.write_text(f"channel: {{{given_settings}, schedule: [{{slot: 10, until: 20, jam: true}}]}}")
    config = ChannelConfig.from_yaml(path, seed=3, loss=None)
    assert (config.agents, config.seed, config.loss, config.partition) == (6, 3, 0.05, ((1, 2, 3), (4, 5, 6)))
    assert ChannelConfig.from_yaml(path, agents=7).partition == ((1, 2, 3), (4, 5, 6), (7,))
    with pytest.raises(ConfigError, match="partition"):
        ChannelConfig.from_yaml(path, agents=5)


@pytest.mark.parametrize(("text", "part"), [
    ("agents: 2001-13-45", "valid YAML"), ("agents: " + "9" * 5000, "valid YAML"), ("? [agents]\n: 3", "valid YAML"),
    ("[" * 3000, "valid YAML"), ("agents: !!bool maybe", "valid YAML"),
    ("", "No such file"), ("- 1\n- 2\n", "a mapping of settings"), ("agents: 3\nloss: lots\n", "loss: got 'lots'"),
])  # fmt: skip
def test_yaml_errors_are_one_line(tmp_path, text, part):
    path = tmp_path / "bad.yaml"
    if text:
        path.write_text(text)
    with pytest.raises(ConfigError, match=part) as caught:
        ChannelConfig.from_yaml(path)
    assert "\n" not in str(caught.value)


@given(st.lists(st.integers(0, 3), min_size=2, max_size=20))
def test_partition_round_trip(numbers):
    groups = [[i + 1 for i, n in enumerate(numbers) if n == k] for k in range(4)]
    groups = [group for group in groups if group]
    parsed = parse_partition(groups, len(numbers))
    assert parse_partition(json.dumps(parsed), len(numbers)) == parsed
    assert parsed == (tuple(map(tuple, groups)) if len(groups) > 1 else ())


@given(st.lists(st.tuples(st.integers(0, 12), st.one_of(st.none(), st.integers(1, 12)), st.integers(1, 9)), max_size=6))
def test_schedule_against_its_definition(entries):
    """In every slot the entry that began last and has not ended counts, of equals the later one."""
    schedule = [
        {"slot": slot, "loss": loss / 10, **({} if length is None else {"until": slot + length})}
        for slot, length, loss in entries
    ]
    timeline = Timeline(ChannelConfig(agents=2, schedule=tuple(schedule)))
    for slot in range(30):
        live = [(e["slot"], i) for i, e in enumerate(schedule) if e["slot"] <= slot < e.get("until", 10**9)]
        expected = schedule[max(live)[1]]["loss"] if live else 0.0
        epoch = timeline.at(slot)
        assert epoch.config.loss == expected
        assert epoch.first <= slot < epoch.end


def test_set_takes_effect_from_the_next_slot_and_replays():
    channel = Channel(ChannelConfig(agents=4, schedule=({"slot": 8, "jam": False},)))
    seen, changes = [], []
    for slot in range(12):
        if slot == 5:
            changes.append(channel.set(jam=True))
        if slot == 6:
            changes.append(channel.set(partition=[[1, 2], [3, 4]], loss=0.5))
        seen.append(channel.arbitrate(slot, (1,)).mask(4).tolist())
    assert seen[4] == [[False, True, True, True]]
    assert not any(seen[5][0])
    assert not any(seen[7][0])
    assert not any(seen[slot][0][2] for slot in range(5, 12))
    assert any(seen[slot][0][1] for slot in range(8, 12))
    assert [change.slot for change in changes] == [5, 6]
    replay = Channel(channel.config)
    for change in changes:
        assert replay.set(slot=change.slot, **dict(change.values)) == change
    assert [replay.arbitrate(slot, (1,)).mask(4).tolist() for slot in range(12)] == seen
    assert Change.from_dict(changes[1].to_dict(), channel.config, "change") == changes[1]


def test_set_refuses_and_changes_nothing():
    channel = Channel(ChannelConfig(agents=4, schedule=({"slot": 50, "loss": 0.8},)))
    channel.arbitrate(9, (1,))
    for bad in ({"loss": 2}, {"seed": 3}, {"partition": [[1, 9]]}, {}, {"slot": 9, "jam": True}, {"burst_length": 2.0}):
        with pytest.raises(ConfigError):
            channel.set(**bad)
    assert channel._timeline.at(10).config == channel.config.changed({})
    assert channel.set(burst_length=5.0).slot == 10
    assert channel._timeline.at(50).config.burst_length == 5.0


def test_the_example_is_usable():
    path = Path(__file__).parents[1] / "config" / "rough_radio.yaml"
    config = ChannelConfig.from_yaml(path, agents=12, slot_ns=20_000_000, seed=3)
    assert [change.slot for change in config.schedule] == [500, 1000, 1500]
    assert config.schedule[1].values == (("partition", ((1, 2, 3, 4, 5, 6), (7, 8, 9, 10, 11, 12))),)
    with pytest.raises(ConfigError, match=r"link_loss\[0\]\.to"):
        ChannelConfig.from_yaml(path, agents=6)


def test_clocks_depend_on_seed_and_agent_alone():
    config = ClockConfig(offset_ns=10**9, drift_ppm=50, jitter_ns=1000, seed=3)
    clocks = make_clocks(config, 200)
    assert make_clocks(config, 12) == clocks[:12]
    assert make_clocks(ClockConfig.from_dict(config.to_dict()), 200) == clocks
    drift = np.array([clock.drift_ppb for clock in clocks])
    assert np.abs(drift).max() <= 50_000
    assert abs(drift.mean()) < 4.5 * 50_000 / math.sqrt(3 * 200)
    assert np.abs(drift).max() > 45_000
    assert np.abs([clock.offset_ns for clock in clocks]).max() <= 10**9


@pytest.mark.parametrize(("name", "value"), [("offset_ns", -1), ("drift_ppm", 2000), ("jitter_ns", "x"), ("skew", 1)])
def test_bad_clock_settings(name, value):
    with pytest.raises(ConfigError) as caught:
        ClockConfig.from_dict({name: value})
    assert caught.value.field == name
