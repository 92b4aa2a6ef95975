"""Tables of who heard whom: columns, errors, and files that the setting `losses` takes."""

from __future__ import annotations

import json

import numpy as np
import pytest

from dtsa_agent.core.errors import ConfigError
from dtsa_channel_sim import Channel, ChannelConfig
from dtsa_channel_sim.model.loss_record import HEARD, LOST, UNKNOWN
from dtsa_channel_sim.model.loss_table import LossTable, read_table, write_table

TEXT = """slot,sender,receiver,heard,distance_m
7,2,1,0,1.5
5,1,2,1,
5,1,3,0,2.25
7,2,0,1,
"""


def test_rows_become_frames_in_order(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("\ufeff" + TEXT)
    table = read_table(path, 0)
    assert table.slots.tolist() == [5, 7]
    assert table.senders.tolist() == [1, 2]
    assert table.agents == 3
    assert table.outcome.tolist() == [[UNKNOWN, UNKNOWN, HEARD, LOST], [HEARD, LOST, UNKNOWN, UNKNOWN]]
    assert table.rssi_dbm is None
    assert table.distance_m[1, 1] == 1.5
    assert np.isnan(table.distance_m[0, 2])


def test_times_are_slots_of_a_length(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("time_s,sender,receiver,heard\n0.0199,1,2,1\n0.0201,1,2,0\n")
    assert read_table(path, 10_000_000).slots.tolist() == [1, 2]
    with pytest.raises(ConfigError, match="slot_ms"):
        read_table(path, 0)
    config = ChannelConfig(agents=2, slot_ns=10_000_000, losses=str(path))
    assert Channel(config).arbitrate(2, (1,)).lost == (1,)


def test_a_table_comes_back(tmp_path):
    draw = np.random.default_rng(1)
    slots, senders = np.arange(50), draw.integers(1, 6, 50)
    outcome = draw.integers(0, 3, (50, 6)).astype(np.uint8)
    outcome[np.arange(50), senders] = UNKNOWN
    outcome[0, senders[0] % 5 + 1], outcome[49, senders[49] % 5 + 1] = LOST, LOST
    rows = write_table(tmp_path / "t.csv", LossTable(slots, senders, outcome))
    assert rows == np.count_nonzero(outcome != UNKNOWN)
    again = read_table(tmp_path / "t.csv", 0)
    there = (outcome != UNKNOWN).any(axis=1)
    assert np.array_equal(again.slots, slots[there])
    assert np.array_equal(again.outcome, outcome[there])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "line 1.*column sender"),
        ("slot,sender,receiver\n", "line 1.*column heard"),
        ("sender,receiver,heard\n", "line 1.*a column slot, or a column time_s"),
        ("slot,time_s,sender,receiver,heard\n", "line 1.*a column slot, or a column time_s"),
        ("slot,sender,receiver,heard,colour\n", "line 1.*'colour'"),
        ("slot,slot,sender,receiver,heard\n", "line 1.*'slot'"),
        ("slot,sender,receiver,heard\n", "one row at least"),
        ("slot,sender,receiver,heard\n1,1,2\n", "line 2.*3 fields"),
        ("slot,sender,receiver,heard\n1,1,2,1\n\n2,0,2,1\n", "line 4: sender.*'0'"),
        ("slot,sender,receiver,heard\n1.5,1,2,1\n", "line 2: slot.*'1.5'"),
        ("slot,sender,receiver,heard\n-1,1,2,1\n", "line 2: slot"),
        ("slot,sender,receiver,heard\n1,1,70000,1\n", "line 2: receiver"),
        ("slot,sender,receiver,heard\n1,1,1,1\n", "line 2: receiver.*another agent"),
        ("slot,sender,receiver,heard\n1,1,2,yes\n", "line 2: heard.*'yes'.*0 or 1"),
        ("slot,sender,receiver,heard\n1,1,2,1\n1,1,2,1\n", "sender 1, receiver 2 twice"),
        ("slot,sender,receiver,heard,rssi_dbm\n1,1,2,1,nan\n", "line 2: rssi_dbm.*'nan'"),
        ("slot,sender,receiver,heard,distance_m\n1,1,2,1,-3\n", "line 2: distance_m.*'-3'"),
    ],
)
def test_errors_name_file_line_and_column(tmp_path, text, said):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(ConfigError, match=said) as caught:
        ChannelConfig(agents=2, losses=str(path))
    assert "bad.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_are_none_are_refused(tmp_path):
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "bytes.json").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "list.json").write_text("[1]")
    (tmp_path / "deep.json").write_text("[" * 100_000)
    for name in ("bytes.csv", "bytes.json", "list.json", "deep.json", "", "none.json"):
        with pytest.raises(ConfigError, match="losses"):
            ChannelConfig(agents=2, losses=str(tmp_path / name))


def test_a_file_of_chains_tells_its_name_and_its_hash(tmp_path):
    path = tmp_path / "chains.json"
    path.write_text(json.dumps({"agents": 2, "slot_ms": 10, "links": [[0, 0, 0, 1, 0.25, 0.25]]}))
    losses = ChannelConfig(agents=2, losses=str(path)).losses
    assert losses.name == "chains.json"
    assert len(losses.sha256) == 64
    assert str(losses).startswith("chains.json (")
