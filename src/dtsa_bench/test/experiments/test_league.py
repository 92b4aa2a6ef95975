"""Integration: the league: what is frozen, what an entry holds, what a check finds, who is ahead."""

from __future__ import annotations

import copy
import json
import math
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from cli_helpers import refused
from page_helpers import check_loads_nothing

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import POLICIES
from dtsa_bench.commands import cli
from dtsa_bench.experiments.league import (
    FIELDS,
    Entry,
    LeagueTable,
    check_entry,
    check_scheme,
    league,
    read_entries,
    scores,
)
from dtsa_bench.experiments.sweep import run_config

LEAGUE = league()
ROOT = Path(__file__).resolve().parents[4]
PUBLISHED = ROOT / "docs" / "evidence" / "league-1.json"
SMALL = ("--cells", "crazyflie,few", "--sample", "2", "--jobs", "1")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("league")
    for name in ("lease", "tdma"):
        assert cli.main(["league", "enter", name, *SMALL, "--out", str(directory / name)]) == 0
    return directory


def test_what_is_frozen_stays_and_all_built_in_schemes_fly_every_cell() -> None:
    assert LEAGUE.digest == "ed7a1d2694d06ac4"  # a change needs a league of another number: docs/how-to/sweep.md
    seeds = {LEAGUE.seed(cell, k) for cell in LEAGUE.cells for k in range(LEAGUE.seed_count)}
    assert len(seeds) == len(LEAGUE.cells) * LEAGUE.seed_count
    assert all(0 <= seed < 2**31 for seed in seeds)
    entered = {settings["policy"] for settings in LEAGUE.entrants.values()}
    own = {name for name, point in POLICIES.plug_ins().items() if point.module.startswith("dtsa_bench.")}
    assert entered >= {*POLICIES.rows, *own}
    for settings in LEAGUE.entrants.values():
        scheme = {key: value for key, value in settings.items() if key != "bound"}
        check_scheme(scheme)
        for cell in LEAGUE.cells:
            run_config(LEAGUE.settings(cell, scheme, 1))


def test_published_entries_are_whole_and_the_simulator_flies_as_it_did() -> None:
    """One flight of each entry: no published number has changed."""
    for number, published in enumerate(read_entries(PUBLISHED)):
        assert check_entry(LEAGUE, published, sample=1, seed=number, jobs=1) == (1, []), published["name"]
    table = LeagueTable(LEAGUE, read_entries(PUBLISHED))
    assert table.complete
    assert len(table.lines()) >= 21
    starred = {name for rank, name, *_ in table.lines() if rank.endswith("*")}
    assert {"sense", "dominance"} <= starred
    assert not starred & {"tdma", "dtsa", "lease", "csma"}
    assert len(PUBLISHED.read_text().splitlines()) <= 1000


def test_any_changed_value_is_found_and_named(flown: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = flown / "forged.json"
    content = json.loads((flown / "lease" / "entry.json").read_text())
    for place, field in enumerate(FIELDS):
        forged = copy.deepcopy(content)
        flight = forged["entries"][0]["flights"]["few"][1]
        value = flight[place]
        flight[place] = value + "x" if isinstance(value, str) else value * (1 + 1e-15) + 1e-15
        assert flight[place] != value
        path.write_text(json.dumps(forged))
        assert cli.main(["league", "check", str(path), "--all", "--jobs", "1"]) == 1
        text = capsys.readouterr().out
        assert f"differs: lease: few/1: {field} {flight[place]}; flown again {value}\n" in text
        assert "lease: 4 of 4 flights flown again; 1 differences" in text


def test_a_plug_in_in_a_directory_of_its_own_enters(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setenv("PYTHONPATH", "")
    target = tmp_path / "installed"
    shutil.copytree(ROOT / "examples" / "dtsa_plugins", tmp_path / "source")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-build-isolation"]
    subprocess.run([*pip, "--target", str(target), str(tmp_path / "source")], check=True, capture_output=True)
    words = ["--cells", "few", "--sample", "1", "--jobs", "1", "--name", "mine", "--out", str(tmp_path)]
    assert cli.main(["league", "enter", "least-known", "--path", str(target), *words]) == 0
    found = read_entries(tmp_path)[0]
    assert (found["name"], found["scheme"], found["bound"]) == ("mine", {"policy": "least-known"}, False)
    assert found["package"] == "dtsa-plugins 0.1.0"
    capsys.readouterr()
    assert cli.main(["league", "check", str(tmp_path), "mine", "--jobs", "1"]) == 0
    assert "1 of 1 flights flown again; 0 differences" in capsys.readouterr().out


@pytest.mark.parametrize(("words", "said"), [
    (["enter", "tdmaa"], "POLICY: got 'tdmaa'"), (["enter", "lease", "--cells", "moon"], "cells: got 'moon'"),
    (["enter", "lease", "--sample", "0"], "sample: got '0'"),
    (["enter", "lease", "--set", "loss=0"], "set.loss: got 0"),
    (["enter", "lease", "--set", "frame"], "set: got 'frame'"),
    (["enter", "lease", "--set", "options={v_max: 9}"], "set.options.v_max: got 9"),
    (["enter", "lease", "--name", "A b"], "name: got 'A b'"), (["enter", "lease", "--all"], "option --all: unknown"),
    (["enter"], "POLICY"), (["check", "/nowhere"], "FILE: got '/nowhere'"),
    (["check", str(Path(__file__))], "FILE: got"), (["check", str(PUBLISHED), "moon"], "NAME: got 'moon'"),
    (["table"], "FILE"), (["cells", "all"], "argument all: unknown"),
])  # fmt: skip
def test_wrong_input_is_refused_in_one_line(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert said in refused(["league", *words], capsys)


def test_an_entry_of_a_policy_that_is_not_here_is_not_checked(flown, tmp_path, capsys):
    text = (flown / "lease" / "entry.json").read_text().replace('"policy": "lease"', '"policy": "moon"')
    (tmp_path / "entry.json").write_text(text)
    assert cli.main(["league", "check", str(tmp_path)]) == 1
    assert capsys.readouterr().out.startswith("lease: not checked: policy: got 'moon'; allowed: ")


@pytest.mark.parametrize("broken", [
    {"fields": ["k"]}, {"frozen": "0" * 16}, {"entries": []}, {"entries": [{"name": 3}]}, {"flights": {"moon": []}},
    {"flights": {"few": [[0, 1]]}}, {"flights": {"few": 7}},
    {"flights": {"few": [["completed", math.nan, 1, 1, 1, 1, 1, ""]]}},
])  # fmt: skip
def test_what_is_no_entry_is_refused(broken: dict[str, Any], flown: Path, tmp_path: Path) -> None:
    content = json.loads((flown / "lease" / "entry.json").read_text())
    if "flights" in broken:
        content["entries"][0] |= broken
    else:
        content |= broken
    (tmp_path / "entry.json").write_text(json.dumps(content))
    with pytest.raises(ConfigError, match="FILE"):
        read_entries(tmp_path)


def test_the_table_is_lines_and_a_page(flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["league", "table", str(flown / "tdma"), str(flown / "lease"), "--out", str(tmp_path)]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in shown[1:3]] == [["1", "lease"], ["2", "tdma"]]  # the best first
    page = (tmp_path / "league.html").read_text()
    assert "Not all cells and seeds were flown" in page
    assert page.count("<svg") == 1
    check_loads_nothing(page)
    assert sorted(path.name for path in (tmp_path / "figures").iterdir()) == ["scores.png", "scores.svg"]
    other = read_entries(flown / "lease")[0]
    with pytest.raises(ConfigError, match="every name once"):
        LeagueTable(LEAGUE, [other, other])
    other["flights"]["few"].pop()
    with pytest.raises(ConfigError, match="same cells"):
        LeagueTable(LEAGUE, [read_entries(flown / "tdma")[0], other])


def made_up(name: str, ages: list[float], crashed: int = 0, bound: bool = False) -> Entry:
    """An entry of one cell, with these ages; the first flights crashed."""
    flights = [
        ["crashed" if k < crashed else "completed", 9, 1.0, age, age, 0.01, 0.3, ""] for k, age in enumerate(ages)
    ]
    return {"name": name, "bound": bound, "scheme": {"policy": "tdma"}, "flights": {"few": flights}}


def test_the_order_is_by_lost_flights_times_age_and_bounds_have_no_rank() -> None:
    entries = [
        made_up("all-knowing", [1.0] * 4, bound=True), made_up("many lost", [50.0] * 4, crashed=3),
        made_up("slow", [300.0] * 4, crashed=1), made_up("none lost, slow", [900.0] * 4),
        made_up("none lost", [100.0] * 4),
    ]  # fmt: skip
    table = LeagueTable(LEAGUE, entries)
    assert [line[:2] for line in table.lines()] == [
        ["1", "none lost"], ["2", "none lost, slow"], ["3", "slow"], ["4", "many lost"], ["bound", "all-knowing"],
    ]  # fmt: skip
    assert table.lines() == LeagueTable(LEAGUE, entries[::-1]).lines()
    found = scores(LEAGUE, made_up("x", [50.0, 5000.0, 200.0], crashed=1)["flights"])
    assert found.lost.count == 1
    assert found.age_ms[0] == pytest.approx((1200 * 1200 * 200) ** (1 / 3))  # a larger age counts no more than that
