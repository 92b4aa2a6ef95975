"""The protocol's table: its rows, its verdicts, its files."""

from __future__ import annotations

import csv
import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from dtsa_dev.protocol.cases import AGED, PROTOCOLS, cases, run_case
from dtsa_dev.protocol.plan import WORK, ProtocolPlan
from dtsa_dev.protocol.table import as_text, by_case, long_table, run_table, summarise
from dtsa_dev.registry import main

from dtsa_bench.experiments.batch import pool
from dtsa_bench.experiments.batch.journal import Journal
from dtsa_bench.experiments.batch.pool import run_all


def case(name: str):  # type: ignore[no-untyped-def]
    return next(row for row in cases() if row.name == name)


def test_names_are_unique() -> None:
    names = [row.name for row in cases()]
    assert len(set(names)) == len(names)


def test_all_moving_without_loss_is_exactly_tdma() -> None:
    row = case("12/12 moving, no loss")
    by_content = ("dtsa", "genie (error)")
    ages = {name: run_case(row, name, 1, 2000).age for name in PROTOCOLS if name not in by_content}
    assert ages == dict.fromkeys(ages, 5.5)
    assert all(run_case(row, name, 1, 2000).age > 5.5 for name in by_content)


@pytest.mark.parametrize(
    ("name", "ceiling"),
    [
        ("12/6 moving, no loss", 0.56),
        ("12/6 moving, 30 %", 0.4),
        ("12/2 moving, no loss", 0.15),
        ("12/2 moving, 10 %", 0.2),
        ("12/12 moving, 10 %", 0.9),
        ("70/35 moving, 10 %", 0.64),
        ("12/6, hoverers final, from the first slot on", 0.999),
        ("70 stop and go, pauses of 3000, no loss", 0.8),
        ("70 stop and go, pauses of 1000, no loss", 1.02),
        ("70 stop and go, pauses of 300, 10 %", 1.02),
    ],
)
def test_lease_is_younger_than_tdma(name: str, ceiling: float) -> None:
    row = case(name)
    slots = 8000 if "stop" in name else 4000
    lease, tdma = (run_case(row, protocol, 7, slots) for protocol in ("lease", "tdma"))
    assert lease.age < ceiling * tdma.age
    assert lease.broken == 0
    flown = [lease]
    if "stop" in name:  # a handful in a flight: their share takes several
        flown += [run_case(row, "lease", seed, slots) for seed in (8, 9)]
    for one in flown:
        assert one.collisions == one.open_collisions + one.adopted_collisions
    assert sum(one.collisions for one in flown) <= 0.001 * sum(one.slots for one in flown)


def test_plain_dtsa_falls_apart_with_the_first_losses() -> None:
    row = case("12/6 moving, 10 %")
    dtsa, tdma, lease = (run_case(row, protocol, 3, 4000) for protocol in ("dtsa", "tdma", "lease"))
    assert dtsa.collisions > 100
    assert dtsa.age > tdma.age > lease.age


def test_files_and_verdict(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_table(tmp_path, seeds=2, slots=4000, jobs=1, only="12, 12 moving, no") == 0
    printed = capsys.readouterr().out
    assert (tmp_path / "protocol.md").read_text() in printed + "\n"
    (row,) = json.loads((tmp_path / "protocol.json").read_text())
    assert row["case"] == "join of 1 of 12, 12 moving, no loss"
    assert row["ok"]
    assert 0 <= row["lease"]["first frame"]["max"] <= 84
    with (tmp_path / "protocol.csv").open() as file:
        runs = list(csv.DictReader(file))
    assert [(r["protocol"], r["seed"]) for r in runs] == [
        (p, s) for p in ("lease S=0", "lease") for s in ("1001", "1002")
    ]


def test_the_table_goes_on_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [case("join of 1 of 12, 12 moving, no loss"), case("12/6 moving, no loss")]
    plan = ProtocolPlan(rows, 2, 4000)
    whole = by_case(plan, run_all(plan, WORK))
    assert list(whole) == [(row.name, protocol) for row in rows for protocol in row.protocols]
    assert whole[rows[1].name, "lease"] == [run_case(rows[1], "lease", seed, 4000) for seed in (1001, 1002)]

    done: list[int] = []

    def stop(runs: int, cost: float) -> None:
        done.append(runs)
        if len(done) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(pool, "CHUNK_COST", 1.0)
    with pytest.raises(KeyboardInterrupt), closing(Journal(tmp_path, plan, WORK.code())) as journal:
        run_all(plan, WORK, journal, progress=stop)
    begun = len((tmp_path / "runs.jsonl").read_text().splitlines())
    assert begun == 3
    with closing(Journal(tmp_path, plan, WORK.code())) as again:
        finished = run_all(plan, WORK, again, jobs=2, progress=lambda runs, cost: done.append(runs))
    assert sum(done) == 3 + 18 - 3
    assert by_case(plan, finished) == whole


def test_a_directory_of_a_sweep_is_not_the_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["sweep", "--seeds", "1", "--jobs", "1", "--no-report", "--out", str(tmp_path)]
    assert main([*words, "--preset", "trajectories"]) == 0
    assert main(["protocol", "--seeds", "1", "--jobs", "1", "--out", str(tmp_path)]) == 2
    assert "this one holds sweep trajectories" in capsys.readouterr().err


def test_each_column_has_its_own_number_of_seeds_and_slots_unless_others_are_asked_for() -> None:
    rows = [case("12/6 moving, no loss"), case("join of 1 of 12, 12 moving, no loss")]
    own = [(t.seed, t.settings["slots"]) for t in ProtocolPlan(rows).tasks() if t.settings["protocol"] == "lease"]
    assert own == [*((seed, 6000) for seed in (1001, 1002, 1003)), *((seed, 20_000) for seed in range(1001, 1009))]
    asked = {t.settings["protocol"]: t.settings["slots"] for t in ProtocolPlan(rows, 2, 9000, 5).tasks()}
    assert asked == dict.fromkeys(PROTOCOLS, 9000)
    assert {t.seed for t in ProtocolPlan(rows, 2, 9000, 5).tasks()} == {5, 6}


def test_the_documented_table_is_the_one_that_the_preset_writes() -> None:
    rows = [row for row in cases() if row.kind in AGED]
    one = replace(run_case(rows[0], "tdma", 1, 700), age=5.554, true_age=110.4, first=(7,))
    found = {(row.name, name): [one] for row in rows for name in row.protocols}
    lines = long_table(summarise(rows, found)).splitlines()
    assert lines[2].endswith("|" + " 5.55 |" * 6 + " 1.00 |")
    assert sum(" 110 |" in line for line in lines) == 6
    page = (Path(__file__).parents[2] / "docs" / "evidence" / "protocol.md").read_text(encoding="utf-8").splitlines()
    begin = page.index(lines[0])
    shown = page[begin : begin + len(lines)]
    assert [line.split("|")[1] for line in shown] == [line.split("|")[1] for line in lines]
    assert page[begin + len(lines)] == ""


def test_show_tells_what_the_preset_runs(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["protocol", "--show"]) == 0
    shown = yaml.safe_load(capsys.readouterr().out)
    assert [row["name"] for row in shown["cases"]] == [row.name for row in cases()]
    assert shown["protocols"] == PROTOCOLS


def test_a_broken_rule_or_an_old_age_is_a_no() -> None:
    row = case("12/6 moving, no loss")
    good = {(row.name, name): [run_case(row, name, 1, 1500)] for name in PROTOCOLS}
    assert summarise([row], good)[0]["ok"]
    for column, change in (("lease", {"broken": 1}), ("lease", {"age": 9.0}), ("lease S=0", {"collisions": 1}),
                           ("lease", {"collisions": 2})):  # fmt: skip
        bad = {**good, (row.name, column): [replace(good[row.name, column][0], **change)]}
        table = summarise([row], bad)
        assert not table[0]["ok"], change
        assert "| NO |" in as_text(table)
