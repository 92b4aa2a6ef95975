"""Integration: the league: what is frozen, what an entry holds, what a check finds, who is ahead."""

from __future__ import annotations

import copy
import csv
import dataclasses
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import POLICIES
from dtsa_bench.commands import cli
from dtsa_bench.experiments.league import cells, flight, scores
from dtsa_bench.experiments.league.cells import check_scheme, commitment_of, entrants, league
from dtsa_bench.experiments.league.check import Checked, check_entry, found_share, sums
from dtsa_bench.experiments.league.entry import FIELDS, digest_of, read_entry
from dtsa_bench.experiments.league.flight import golden_digest
from dtsa_bench.experiments.league.scores import standings
from dtsa_bench.experiments.league.table import LeagueTable
from dtsa_bench.experiments.sweep.spec import run_config

Entry = dict[str, Any]
LEAGUE = league()
PLUGINS = Path(__file__).resolve().parents[4] / "examples" / "dtsa_plugins"
SMALL = ("--cells", "crazyflie,few", "--sample", "2", "--jobs", "1")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Directories of two entries of a few flights."""
    directory = tmp_path_factory.mktemp("league")
    for name in ("lease", "tdma"):
        assert cli.main(["league", "enter", name, *SMALL, "--out", str(directory / name)]) == 0
    return directory


@pytest.fixture
def entry(flown: Path) -> Entry:
    return read_entry(flown / "lease")


def checked(entry: Entry, sample: int | None = None) -> Checked:
    return check_entry(LEAGUE, entry, word=LEAGUE.practice, sample=sample, seed=1, jobs=1)


def test_the_simulator_flies_the_cells_as_they_were_frozen() -> None:
    # A change of what is computed needs a league of another number: docs/how-to/league.md.
    assert LEAGUE.digest == "57a6b9c7c9bd0cf1"
    assert golden_digest(LEAGUE) == LEAGUE.golden["digest"]


def test_seeds_follow_from_word_cell_and_number() -> None:
    assert LEAGUE.seed("practice", "few", 0) == 1926344029
    seeds = {LEAGUE.seed("practice", cell.name, k) for cell in LEAGUE.cells for k in range(LEAGUE.count)}
    assert len(seeds) == len(LEAGUE.cells) * LEAGUE.count
    assert all(0 <= seed < 2**31 for seed in seeds)
    with pytest.raises(ConfigError, match="secret"):
        LEAGUE.check_secret("practice")


def test_all_built_in_schemes_are_entrants_and_fly_every_cell() -> None:
    entered = {settings["policy"] for settings in entrants().values()}
    own = {name for name, point in POLICIES.plug_ins().items() if point.module.startswith("dtsa_bench.")}
    assert entered >= {*POLICIES.rows, *own}
    for settings in entrants().values():
        scheme = {key: value for key, value in settings.items() if key != "bound"}
        check_scheme(scheme)
        for cell in LEAGUE.cells:
            run_config(LEAGUE.settings(cell, scheme, 1))


def test_slots_of_a_crazyflies_radio_are_as_short_as_the_frames_allow() -> None:
    slots = {
        name: LEAGUE.settings(LEAGUE.cell("crazyflie"), {"policy": policy, "frame": frame}, 1)["slot_ms"]
        for name, policy, frame in (("tdma", "tdma", "auto"), ("lease", "lease", "auto"), ("dtsa", "dtsa", "auto"))
    }
    assert slots == {"tdma": 0.67, "lease": 1.18, "dtsa": 1.71}  # docs/evidence/league.md


def test_an_entry_flown_twice_has_equal_rows_and_digests(entry: Entry, tmp_path: Path) -> None:
    assert cli.main(["league", "enter", "lease", *SMALL, "--out", str(tmp_path)]) == 0
    again = read_entry(tmp_path / "entry.json")
    assert again["flights"] == entry["flights"]
    assert again["summary"] == entry["summary"]
    digests = [line[FIELDS.index("digest")] for lines in entry["flights"].values() for line in lines]
    assert len(set(digests)) == len(digests) == 4
    assert not entry["complete"]
    assert checked(entry) == Checked(4, 4, (), ())


def test_places_of_a_rows_fields_are_those_that_scores_take() -> None:
    places = [FIELDS.index(name) for name in ("status", "waking_age_mean_ms", "channel_load")]
    assert places == [scores._STATUS, scores._AGE, scores._AIR]


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Places of all numbers in nested values, and of all texts in rows."""
    if isinstance(value, (dict, list)):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from leaves(item, (*path, key))
    elif value is not None and (not isinstance(value, str) or path[0] == "flights"):
        yield path


def changed(entry: Entry, path: tuple[Any, ...]) -> Entry:
    """The entry with one value changed a little."""
    other = copy.deepcopy(entry)
    place: Any = other
    for key in path[:-1]:
        place = place[key]
    value = place[path[-1]]
    if isinstance(value, bool):
        place[path[-1]] = not value
    elif isinstance(value, str):
        place[path[-1]] = value + "x"
    else:
        place[path[-1]] = value + 1 if isinstance(value, int) else value * (1 + 1e-9) or 1e-9
    return other


def test_any_changed_number_is_found(entry: Entry) -> None:
    places = list(leaves(entry))
    assert len(places) > 80
    for path in places:
        other = changed(entry, path)
        assert any(text.startswith("digest") for text in checked(other, sample=0).differences), path


def test_a_forger_who_makes_the_digest_anew_is_found_by_sums_and_by_flying_again(entry: Entry) -> None:
    entry["flights"] = {"few": entry["flights"]["few"]}
    entry["summary"] = scores.summary_of(LEAGUE, entry["flights"])
    rows = [path for path in leaves(entry) if path[0] == "flights"]
    assert len(rows) == 2 * len(FIELDS)
    for path in [*rows, *(path for path in leaves(entry) if path[0] in ("summary", "complete"))]:
        other = changed(entry, path)
        other["digest"] = digest_of(other)
        found = check_entry(LEAGUE, other, word="practice", sample=0 if path[0] == "summary" else None, seed=1, jobs=1)
        assert found.differences, path
        assert not any(text.startswith("digest") for text in found.differences)


def test_what_a_sample_finds() -> None:
    assert found_share(336, 1, 24) == pytest.approx(24 / 336)
    assert found_share(336, 336, 1) == 1.0
    assert found_share(10, 1, 10) == 1.0
    assert found_share(336, 34, 24) > 0.9


def test_judged_seeds_need_the_word_of_the_commitment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    there = dataclasses.replace(LEAGUE, commitment=commitment_of("moon"))
    monkeypatch.setattr(cells, "league", lambda name="league-1": there)
    monkeypatch.setattr(flight, "check_golden", lambda league: None)
    (tmp_path / "secret").write_text("moon\n")
    (tmp_path / "wrong").write_text("sun\n")
    out = tmp_path / "lease"
    words = ["league", "enter", "lease", "--cells", "few", "--sample", "1", "--jobs", "1", "--out", str(out)]
    assert cli.main([*words, "--secret", str(tmp_path / "wrong")]) == 2
    assert "secret: got 'sun'" in capsys.readouterr().err
    assert cli.main([*words, "--secret", str(tmp_path / "secret")]) == 0
    entry = json.loads((out / "entry.json").read_text())
    assert entry["seeds"] == "judged"
    assert entry["commitment"] == commitment_of("moon")
    assert entry["flights"]["few"][0][1] == there.seed("moon", "few", 0)
    entry["commitment"] = None
    judged = check_entry(there, entry, word="moon", sample=0, seed=1, jobs=1)
    assert any(text.startswith("commitment") for text in judged.differences)
    assert any("0: seed" in text for text in check_entry(there, entry, word="m", sample=0, seed=1, jobs=1).differences)


def test_a_folder_with_a_plug_in_enters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setenv("PYTHONPATH", "")
    before = sorted(PLUGINS.rglob("*"))
    words = ["--cells", "few", "--sample", "1", "--jobs", "1", "--name", "mine", "--out", str(tmp_path)]
    assert cli.main(["league", "enter", str(PLUGINS), *words]) == 0
    found = read_entry(tmp_path)
    assert found["name"] == "mine"
    assert found["scheme"] == {"policy": "least-known"}
    package = found["package"]
    assert re.fullmatch("[0-9a-f]{64}", package.pop("digest"))
    given = {"distribution": "dtsa-plugins", "version": "0.1.0", "license": "Apache-2.0", "author": None}
    assert package == given  # its metadata name no author
    assert sorted(PLUGINS.rglob("*")) == before
    capsys.readouterr()
    assert cli.main(["league", "check", str(tmp_path), "--all", "--jobs", "1"]) == 0
    assert "1 of 1 flights flown again; 0 differences" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["enter", "tdmaa"], "PACKAGE: got 'tdmaa'"),
        (["enter", "lease", "--cells", "moon"], "cells: got 'moon'"),
        (["enter", "lease", "--sample", "0"], "sample: got '0'"),
        (["enter", "lease", "--set", "loss=0"], "set.loss: got 0"),
        (["enter", "lease", "--set", "frame"], "set: got 'frame'"),
        (["enter", "lease", "--set", "options={v_max: 9}"], "set.options.v_max: got 9"),
        (["enter", "lease", "--name", "A b"], "name: got 'A b'"),
        (["enter", "lease", "--secret", "/nowhere"], "secret: got '/nowhere'"),
        (["enter", "lease", "--all"], "all: got True"),
        (["check", "lease", "--judged"], "judged: got True"),
        (["enter"], "enter: got ''"),
        (["enter", str(Path(__file__).parent)], "PACKAGE: got"),
        (["check", "/nowhere"], "ENTRY: got '/nowhere'"),
        (["check", str(Path(__file__))], "ENTRY: got"),
        (["check", "a", "b"], "check: got 'a b'"),
        (["table"], "table: got ''"),
        (["cells", "all"], "cells: got 'all'"),
    ],
)
def test_wrong_input_is_refused_in_one_line(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["league", *words]) == 2
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    assert said in text


def test_an_entry_of_a_policy_that_is_not_here_cannot_be_checked(entry: Entry) -> None:
    entry["scheme"] = {"policy": "moon"}
    with pytest.raises(ConfigError, match="--package"):
        checked(entry)


@pytest.mark.parametrize(
    "broken",
    [
        {"fields": ["k"]}, {"frozen": "0" * 16}, {"seeds": "mine"}, {"summary": 3}, {"flights": {"moon": []}},
        {"flights": {"few": [[0, 1]]}}, {"flights": {"few": 7}},
        {"flights": {"few": [[0, 1, "completed", float("nan"), 1, 1, 1, 1, 1, "", ""]]}},
    ],
)  # fmt: skip
def test_what_is_no_entry_is_refused(broken: Entry, entry: Entry, tmp_path: Path) -> None:
    (tmp_path / "entry.json").write_text(json.dumps({**entry, **broken}))
    with pytest.raises(ConfigError, match=r"ENTRY|cells"):
        read_entry(tmp_path)


def test_the_table_is_a_page_figures_csv_and_latex(
    flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["league", "table", str(flown / "tdma"), str(flown / "lease"), "--out", str(tmp_path)]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert "lease" in shown[1]  # the best first
    page = (tmp_path / "league.html").read_text()
    assert "Not all cells and seeds were flown" in page
    assert page.count("<svg") == 2
    assert not re.search(r"<(script|link|img|iframe)|url\(http|@import", page)  # it opens without a network
    rows = list(csv.DictReader((tmp_path / "league.csv").read_text().splitlines()))
    assert [(row["name"], row["cell"]) for row in rows[:3]] == [
        ("lease", "all"),
        ("lease", "few"),
        ("lease", "crazyflie"),
    ]
    assert r"\bottomrule" in (tmp_path / "league.tex").read_text()
    names = sorted(path.name for path in (tmp_path / "figures").iterdir())
    assert names == ["cells.png", "cells.svg", "scores.png", "scores.svg"]
    other = read_entry(flown / "lease")
    other["summary"]["lost"] = 0.5
    (tmp_path / "forged.json").write_text(json.dumps(other))
    capsys.readouterr()
    assert cli.main(["league", "table", str(tmp_path / "forged.json"), "--out", str(tmp_path)]) == 2
    assert "follow from its flights" in capsys.readouterr().err
    other["flights"]["few"][0][1] += 1
    with pytest.raises(ConfigError, match="same cells and seeds"):
        LeagueTable(LEAGUE, [read_entry(flown / "tdma"), other])
    with pytest.raises(ConfigError, match="every name once"):
        LeagueTable(LEAGUE, [other, other])


def made_up(name: str, ages: list[float], crashed: int = 0, kind: str = "scheme") -> Entry:
    """An entry of one cell, with these ages; the first flights crashed."""
    lines = [
        [k, k, "crashed" if k < crashed else "completed", 9, 1.0, age, age, 0.01, 0.3, "", ""]
        for k, age in enumerate(ages)
    ]
    flights = {"few": lines}
    return {"name": name, "kind": kind, "flights": flights, "summary": scores.summary_of(LEAGUE, flights)}


def test_ranks_are_what_pairs_of_flights_leave_open() -> None:
    base = [100.0 + 10 * (k % 5) for k in range(24)]
    noisy = [age * (1.05 if k % 2 else 0.96) for k, age in enumerate(base)]
    entries = [
        made_up("worst", [age / 2 for age in base], crashed=20),  # less age, but of those that are left
        made_up("same", noisy),
        made_up("good", [age * 0.5 * (1 + 0.01 * (k % 3)) for k, age in enumerate(base)]),
        made_up("middle", base),
        made_up("all-knowing", [age / 9 for age in base], kind="bound"),
    ]
    found = standings(LEAGUE, entries)
    assert [place.name for place in found] == ["good", "middle", "same", "worst", "all-knowing"]
    assert [(place.rank, place.first, place.last) for place in found] == [
        (1, 1, 1), (2, 2, 3), (3, 2, 3), (4, 4, 4), (None, None, None),
    ]  # fmt: skip
    assert standings(LEAGUE, entries[::-1]) == found
    entries[2] = made_up("good", [age * 0.5 for age in base], crashed=1)  # one flight more decides nothing
    assert standings(LEAGUE, entries)[0].name == "good"


def test_a_lost_flight_counts_with_the_cells_age() -> None:
    summary = made_up("x", [50.0, 5000.0, 200.0], crashed=1)["summary"]
    assert summary["lost"] == 1
    assert summary["age_ms"] == pytest.approx((1200 * 1200 * 200) ** (1 / 3))  # a larger age counts no more than that
    assert summary["worst_cell"] == "few"


def test_the_published_word_is_the_one_of_the_commitment_and_of_the_judged_entries() -> None:
    word = LEAGUE.published()
    assert word is not None
    paths = sorted((PLUGINS.parents[1] / "docs" / "evidence" / "league-1").glob("*.json"))
    assert len(paths) >= 18
    for path in paths:
        entry = read_entry(path)
        if path.stem != "learned":  # its package is gone
            assert not check_entry(LEAGUE, entry, word=word, sample=0, seed=1, jobs=1).differences, path.name
        assert sums(LEAGUE, entry) == [], path.name
        assert all(
            line[1] == LEAGUE.seed(word, cell, line[0]) for cell, lines in entry["flights"].items() for line in lines
        )
