"""Exported tables against the bag they come from."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet
import pytest
from bag_helpers import flight_bag

from dtsa_agent.core import REASONS, decode_frame
from dtsa_agent.core.errors import ConfigError
from dtsa_bench.commands.cli import main
from dtsa_bench.commands.recordings import TABLES
from dtsa_bench.log import tables as module
from dtsa_bench.log.bag.errors import BagError, UnusableBag
from dtsa_bench.log.bag.reader import Bag
from dtsa_bench.log.record import SLOT_RECORD, load_log
from dtsa_bench.log.tables import COLUMNS

SLOTS, AGENTS = 120, 6


def export(bag: Path, directory: Path, kind: str = "parquet", tables: list[str] | None = None) -> list[Any]:
    return module.export(lambda: load_log(bag), directory, kind, tables)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("bags") / "flight"
    flight_bag(directory, slots=SLOTS, loss=0.2, agents=AGENTS, policy="aloha", seed=3)
    return directory


def read(directory: Path, kind: str) -> dict[str, pd.DataFrame]:
    how = {"parquet": pd.read_parquet, "csv": pd.read_csv}[kind]
    return {path.stem: how(path) for path in directory.glob(f"*.{kind}")}


@pytest.mark.parametrize("kind", ["parquet", "csv"])
def test_tables_have_the_documented_columns_and_the_bag_s_values(flight: Path, tmp_path: Path, kind: str) -> None:
    assert tuple(COLUMNS) == TABLES
    written = export(flight, tmp_path / "tables", kind)
    tables = read(tmp_path / "tables", kind)
    assert {one.path.stem: one.rows for one in written} == {name: len(table) for name, table in tables.items()}
    assert {name: list(table.columns) for name, table in tables.items()} == {
        name: [column for column, _, _ in columns] for name, columns in COLUMNS.items()
    }
    text = (tmp_path / "tables" / "columns.md").read_text(encoding="utf-8")
    for columns in COLUMNS.values():
        for name, _, meaning in columns:
            assert f"`{name}`" in text
            assert meaning in text
    with Bag(flight) as bag:
        records = [typed for _, typed in bag.typed([SLOT_RECORD])]
    receptions = decisions = records[:-1]
    outcomes = ["idle", "success", "collision"]
    assert tables["slots"]["slot"].tolist() == list(range(SLOTS))
    assert tables["slots"]["outcome"].tolist() == [outcomes[one.outcome] for one in receptions]
    assert tables["slots"]["senders"].tolist() == [len(one.sender) for one in receptions]
    assert np.allclose(tables["slots"]["time_s"], np.arange(SLOTS) * 0.01)
    frames = tables["frames"]
    assert frames["sender"].tolist() == [int(k) for one in receptions for k in one.sender]
    assert frames["lost"].tolist() == [int(k) for one in receptions for k in one.lost]
    for row in frames.itertuples():
        data = bytes.fromhex(row.data)
        heard = np.unpackbits(receptions[row.slot].received, bitorder="little")[:8].sum()
        frame = decode_frame(data)
        assert (frame.sender, frame.slot, len(data)) == (row.sender, row.slot, row.length)
        assert (row.position_x_m, row.position_y_m, row.position_z_m) == pytest.approx(frame.position, abs=1e-9)
        assert frame.c_r == row.c_r
        if len(receptions[row.slot].sender) == 1:
            assert row.received == heard
            assert row.received + row.lost == AGENTS - 1
    assert tables["decisions"]["chosen"].tolist() == [int(k) for one in decisions for k in one.chosen]
    names = [REASONS[k] for one in decisions for k in one.reason]
    assert tables["decisions"]["reason"].tolist() == names
    assert tables["decisions"]["digest"].astype("uint32").tolist() == [int(k) for one in decisions for k in one.digest]
    states = tables["states"]
    first = states[states["agent"] == 3].reset_index(drop=True)
    for slot in (1, 50, SLOTS - 1):
        track = records[slot].track.reshape(-1, 3, AGENTS)[-1, :, 2]
        row = first[np.isclose(first["time_s"], slot * 0.01)].iloc[0]
        assert [row["position_x_m"], row["position_y_m"], row["position_z_m"]] == pytest.approx(track, abs=1e-9)


def test_who_received_what_and_who_knew_what_with_and_without_losses(flight: Path, tmp_path: Path) -> None:
    export(flight, tmp_path / "tables", tables=["frames", "receptions", "ages", "ages_by_observer"])
    tables, run = read(tmp_path / "tables", "parquet"), load_log(flight)
    by_frame = tables["receptions"].groupby(["slot", "sender"])["received"]
    assert by_frame.sum().tolist() == tables["frames"].sort_values(["slot", "sender"])["received"].tolist()
    assert set(by_frame.count()) == {AGENTS - 1}
    for slot, sender, receiver, received in tables["receptions"][["slot", "sender", "receiver", "received"]].to_numpy():
        row = np.flatnonzero((run.sent_frames.row == slot) & (run.sent_frames.sender == sender))[0]
        assert run.received[row, receiver - 1] == received

    # Age by hand: slots since the last frame of the agent that the observer received.
    heard = tables["receptions"].query("received")
    known = tables["ages_by_observer"].set_index(["slot", "observer", "agent"])
    for observer, agent in ((1, 2), (3, 6), (5, 1)):
        times = heard.query("receiver == @observer and sender == @agent")["slot"].to_numpy()
        for slot in (times[0], times[0] + 1, times[-1], SLOTS - 1):
            assert known.loc[(slot, observer, agent), "age_slots"] == slot - times[times <= slot].max()
        assert (times[0] - 1, observer, agent) not in known.index
    counted = known[known["counted"]].groupby(["slot", "agent"])
    means = tables["ages"].dropna().set_index(["slot", "agent"])
    assert np.allclose(counted["age_slots"].mean(), means["age_slots"])
    assert np.allclose(counted["error_m"].mean(), means["error_m"])
    assert (counted.size() == means["observers"]).all()
    # One table stands for all agents there.
    flight_bag(tmp_path / "bag", slots=40, agents=4, moving=2, policy="tdma", seed=1)
    run = load_log(tmp_path / "bag")
    known = run.ages_by_observer
    last = known[known["slot"] == 39]
    assert len(last) == 4 * 3
    assert last.groupby("agent")["age_slots"].nunique().tolist() == [1] * 4
    assert last.groupby("agent")["counted"].sum().isin([0, 3]).all()
    ages = run.ages.query("slot == 39")
    assert sorted(ages["observers"]) == [0, 0, 3, 3]


def test_units_are_in_the_files_and_tables_larger_than_a_batch_are_whole(flight, tmp_path, monkeypatch):
    export(flight, tmp_path / "tables", tables=["states"])
    assert sorted(path.name for path in (tmp_path / "tables").iterdir()) == ["columns.md", "states.parquet"]
    schema = pyarrow.parquet.read_schema(tmp_path / "tables" / "states.parquet")
    assert schema.field("velocity_x_mps").metadata[b"unit"] == b"m/s"
    export(flight, tmp_path / "one")
    monkeypatch.setattr(module, "ROWS", 50)
    export(flight, tmp_path / "many")
    for name, table in read(tmp_path / "one", "parquet").items():
        assert table.equals(read(tmp_path / "many", "parquet")[name]), name


def test_bad_input_is_refused(flight: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for error, match, bag, out, words in (
        (ConfigError, "parquet or csv", flight, "a", {"kind": "xlsx"}),
        (ConfigError, ", ".join(TABLES), flight, "a", {"tables": ["slot"]}),
        (ConfigError, "empty or does not exist", flight, "", {}),
        (UnusableBag, None, tmp_path / "nothing", "a", {}),
        ((BagError, ConfigError), None, flight, "file/below", {}),
    ):
        with pytest.raises(error, match=match):
            export(bag, tmp_path / out, **words)
    assert not (tmp_path / "a").exists()


SMALL_DISK = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, -1))  # no file gets larger, as on a disk that is full
from dtsa_bench.commands.cli import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize("kind", ["parquet", "csv"])
def test_a_full_disk_leaves_no_half_table_and_no_half_page(flight: Path, tmp_path: Path, kind: str) -> None:
    (tmp_path / "mine").mkdir()
    for place in ("mine", "new"):
        for words, text in (
            (["export", flight, "--to", kind, "--out", tmp_path / place], "export to"),
            (["report", flight, "--out", tmp_path / place], "write"),
        ):
            if words[0] == "report" and place == "mine":
                continue
            done = subprocess.run([sys.executable, "-c", SMALL_DISK, *map(str, words)], capture_output=True, text=True)
            assert done.returncode == 1
            assert done.stderr.splitlines()[-1].startswith(f"dtsa: error: cannot {text} {tmp_path / place}: ")
            assert done.stderr.count("dtsa: error") == 1
    assert [path.name for path in tmp_path.rglob("*")] == ["mine"]  # was there before, and is empty as before


def test_json_says_what_was_written(flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(flight), "--tables", "slots", "--json", "--out", str(tmp_path / "a")]) == 0
    assert json.loads(capsys.readouterr().out) == [{"path": str(tmp_path / "a" / "slots.parquet"), "rows": SLOTS}]
    assert main(["recover", str(flight), "--json", "--out", str(tmp_path / "b")]) == 0
    saved = json.loads(capsys.readouterr().out)
    assert saved["saved"][SLOT_RECORD] == SLOTS + 1
    assert saved["directory"] == str(tmp_path / "b")
