"""The report: its numbers, that it is self-contained, and that a real browser draws it."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_helpers import flight_bag
from browser_helpers import CHROMIUM, MISSING, Browser, browsing, colours
from page_helpers import check_loads_nothing
from view_helpers import numbers

from dtsa_agent.core import REASONS
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import REASON_TEXTS
from dtsa_bench.commands.cli import main
from dtsa_bench.log.bag.errors import UnusableBag
from dtsa_bench.log.bag.reader import Bag
from dtsa_bench.log.bag.recover import recover
from dtsa_bench.log.bag.writer import BagWriter
from dtsa_bench.log.record import SLOT_RECORD, load_log
from dtsa_bench.log.verify.check import verify_bag
from dtsa_bench.pages.report.data import render, run_data, write_report
from dtsa_bench.pages.report.distances import pair_distances
from dtsa_bench.pages.report.tables import Part, write_tables
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.simulation.simulate import simulate

SLOTS = 429  # until a second after all have arrived, as in a simulated flight


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A clean flight and one on a lossy channel with collisions."""
    root = tmp_path_factory.mktemp("bags")
    flight_bag(root / "clean", slots=SLOTS, agents=6, moving=4, policy="dtsa", seed=2)
    flight_bag(root / "lossy", slots=200, loss=0.2, agents=6, policy="aloha", seed=3)
    return {"clean": root / "clean", "lossy": root / "lossy"}


@pytest.fixture(scope="module")
def data(flights: dict[str, Path]) -> dict[str, Any]:
    return {name: run_data(path) for name, path in flights.items()}


def test_everything_that_reads_a_run_takes_its_directory_its_bag_and_its_file(flights, tmp_path, capsys):
    shutil.copytree(flights["clean"], tmp_path / "a" / "bag")
    file = next((tmp_path / "a" / "bag").glob("*.mcap"))
    known = load_log(file)
    with Bag(file) as bag:
        assert load_log(bag).digest.tolist() == known.digest.tolist()
    for given in (tmp_path / "a", tmp_path / "a" / "bag", file):
        for path in (given, str(given)):
            assert load_log(path).digest.tolist() == known.digest.tolist()
            assert run_data(path)["agents"] == 6
            assert verify_bag(path).mode == "lockstep"
        assert recover(given, tmp_path / f"saved-{given.name}").count > 0
        assert main(["export", str(given), "--to", "csv", "--out", str(tmp_path / f"csv-{given.name}")]) == 0
    capsys.readouterr()


def test_results_of_a_run_directory_stay_in_it(flights, tmp_path, capsys):
    run = tmp_path / "a"
    shutil.copytree(flights["clean"], run / "bag")
    assert main(["report", str(run)]) == main(["export", str(run)]) == main(["recover", str(run)]) == 0
    assert "report.html" in capsys.readouterr().out
    assert {path.name for path in run.iterdir()} == {"bag", "report.html", "bag_tables", "bag_recovered"}
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    shutil.copytree(flights["clean"], tmp_path / "alone")
    assert main(["report", str(tmp_path / "alone")]) == 0
    assert (tmp_path / "report.html").is_file()


def test_results_are_those_of_the_simulator(data: dict[str, Any], flights: dict[str, Path]) -> None:
    with Bag(flights["clean"]) as bag:
        config = RunConfig.from_dict(bag.config)
    summary = simulate(config).summary()
    found = data["clean"]["summary"]
    assert found["slots"]["total"] == SLOTS
    for key, value in summary.items():
        if key in ("wall_time_s", "realtime_factor", "malformed", "foreign"):
            continue
        if isinstance(value, float):
            assert found[key] == pytest.approx(value, rel=1e-12), key
        else:
            assert found[key] == value, key


def test_slots_carry_sender_outcome_and_reason(data: dict[str, Any], flights: dict[str, Path]) -> None:
    for name, path in flights.items():
        slots = data[name]["slots"]
        with Bag(path) as bag:
            receptions = [typed for _, typed in bag.typed([SLOT_RECORD])][:-1]
        decisions = {typed.slot: typed for typed in receptions}
        rows = [(one.slot, int(k), one.outcome) for one in receptions for k in one.sender]
        kinds = [
            numbers(slots[key], kind).tolist() for key, kind in (("slot", "<u4"), ("sender", "<u2"), ("outcome", "u1"))
        ]
        assert list(zip(*kinds, strict=True)) == rows
        names = data[name]["decisions"]["names"]
        for (slot, sender, _), code in zip(rows, numbers(slots["reason"], "u1"), strict=True):
            decision = decisions[slot]
            assert names[code] == REASONS[decision.reason[sender - 1]]
        assert slots["count"] == len(receptions)


def test_shares_add_up_and_ages_follow_from_who_was_heard(data: dict[str, Any]) -> None:
    for run in data.values():
        assert np.allclose(np.sum(list(run["channel"]["share"].values()), axis=0), 1, atol=2e-4)
        assert np.allclose(np.sum(run["decisions"]["share"], axis=0), 1, atol=2e-3)
        assert sum(run["decisions"]["total"]) == run["agents"] * run["slots"]["count"]
    assert data["lossy"]["summary"]["lost_fraction"] > 0
    assert data["clean"]["summary"]["lost_fraction"] == 0
    assert data["lossy"]["decisions"]["disagree"] > 0
    assert data["clean"]["decisions"]["disagree"] == 0
    clean, lossy = (data[name]["summary"] for name in ("clean", "lossy"))
    assert 0 < clean["age_mean_slots"] <= clean["age_max_slots"]
    assert lossy["age_mean_slots"] > clean["age_mean_slots"]
    rows = data["clean"]["table"]
    assert [row["id"] for row in rows] == list(range(1, 7))
    assert sum(row["moving"] for row in rows) == 4
    assert all((row["age_mean"] is not None) == row["moving"] for row in rows)
    assert sum(row["sent"] for row in rows) == clean["frames"]


def test_figures_of_agents_are_means_over_the_pairs_of_the_results(flights, data):
    for name, path in flights.items():
        known = load_log(path).ages_by_observer.query("counted and slot >= 5")
        assert known.age_slots.mean() == pytest.approx(data[name]["summary"]["age_mean_slots"], rel=1e-12)
        of = known.groupby("agent")
        for row in data[name]["table"]:
            if row["moving"]:
                assert row["age_mean"] == pytest.approx(of.age_slots.mean()[row["id"]], abs=0.0051)
                assert row["error_mean"] == pytest.approx(of.error_m.mean()[row["id"]], abs=0.000051)


def test_distances_and_scene_are_those_of_the_positions(flights: dict[str, Path], data: dict[str, Any]) -> None:
    with Bag(flights["lossy"]) as bag:
        run = load_log(bag)
    found = pair_distances(run)
    assert found is not None
    n = run.agents
    brute = {
        (i + 1, j + 1): np.linalg.norm(run.path[:, :, i] - run.path[:, :, j], axis=1)
        for i in range(n)
        for j in range(i + 1, n)
    }
    assert np.allclose(found.least, np.min(list(brute.values()), axis=0))
    assert found.pairs == sorted(brute, key=lambda pair: brute[pair].min())[: len(found.pairs)]
    for pair, series in zip(found.pairs, found.series, strict=True):
        assert np.allclose(series, brute[pair])
    scene = data["clean"]["scene"]
    with Bag(flights["clean"]) as bag:
        run = load_log(bag)
    times = numbers(scene["time"], "<f4")
    places = numbers(scene["position"], "<i2").reshape(len(times), 3, -1) * scene["scale"]
    for frame in (0, len(times) // 2, len(times) - 1):
        row = np.abs(run.instants_s - times[frame]).argmin()
        assert np.abs(places[frame] - run.path[row]).max() <= 0.51 * scene["scale"]
    assert scene["scale"] < 0.001


@pytest.fixture(scope="module")
def crash(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """A flight in which several pairs crash, and which goes on."""
    directory = tmp_path_factory.mktemp("crash") / "crash"
    settings = {"agents": 16, "policy": "tdma", "estimator": "hold", "slot_ms": 20.0, "seed": 1003}
    flight_bag(directory, slots=120, **settings)
    return run_data(directory), directory


def test_crashes_have_their_agents_time_and_place(crash: tuple[dict[str, Any], Path], data: dict[str, Any]) -> None:
    clean, (data, directory) = data["clean"], crash
    found = data["crashes"]
    assert found[0]["ids"] == data["summary"]["collided_pair"]
    assert [one["time_s"] for one in found] == sorted(one["time_s"] for one in found)
    log = load_log(directory)
    for one in found:
        a, b = (log.path[:, :, number - 1] for number in one["ids"])
        near = np.flatnonzero(np.linalg.norm(a - b, axis=1) < 0.2)
        assert log.instants_s[near[0]] == pytest.approx(one["time_s"], abs=1e-3)
        assert one["place"] == pytest.approx(((a + b) / 2)[near[0]], abs=1e-3)
    assert len({tuple(one["ids"]) for one in found}) == len(found) > 1
    assert clean["crashes"] == []


@pytest.fixture(scope="module")
def hostile(data: dict[str, Any]) -> dict[str, Any]:
    """A run whose name and settings try to be HTML."""
    evil = "</script><img src=x onerror=\"document.title='broken'\"><!-- {{ script }}"
    return {**data["clean"], "name": evil, "config": [["swarm", evil, evil]], "notes": [evil]}


def test_the_page_fetches_nothing_and_names_and_settings_cannot_break_out(data, hostile):
    for page in (render([data["clean"], data["lossy"]]), render([hostile])):
        check_loads_nothing(page)
        addresses = set(re.findall(r"https?://[^\s\"'<>)]+", page)) - {"http://www.w3.org/2000/svg"}
        assert addresses == set()


def test_data_in_the_page_is_the_data(data: dict[str, Any]) -> None:
    page = render([data["clean"]])
    match = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)
    assert match is not None
    content = json.loads(match[1])
    assert content["runs"] == [json.loads(json.dumps(data["clean"]))]
    assert content["reasons"].keys() == set(REASONS)


def test_a_bag_without_a_usable_configuration_still_gives_a_page(tmp_path: Path, flights: dict[str, Path]) -> None:

    with (
        Bag(flights["clean"]) as bag,
        BagWriter(tmp_path / "strange", {"swarm": {"agents": 6, "policy": "of tomorrow"}}) as writer,
    ):
        channels = {
            name: writer.add_topic(name, t.type, list(t.profiles), t.definition) for name, t in bag.topics.items()
        }
        for message in bag.messages():
            writer.write(channels[message.topic], message.data, message.log_time_ns, message.publish_time_ns)
    found = run_data(tmp_path / "strange")
    assert found["ages"] is None
    assert "of tomorrow" in found["notes"][0]
    assert found["summary"]["slots"]["total"] == SLOTS
    assert found["summary"]["min_distance_m"] > 0
    assert render([found])


def test_equal_names_are_told_apart_and_bad_input_is_refused(flights: dict[str, Path], tmp_path: Path) -> None:
    path = write_report([flights["clean"], flights["clean"]], tmp_path / "deep" / "report.html")
    assert "clean (2)" in path.read_text(encoding="utf-8")
    assert [entry.name for entry in path.parent.iterdir()] == ["report.html"]
    with pytest.raises(ConfigError, match="1 to 8"):
        write_report([flights["clean"]] * 9, tmp_path / "many.html")
    with pytest.raises(ConfigError, match="directory"):
        write_report([flights["clean"]], tmp_path)
    with pytest.raises(UnusableBag):
        write_report([tmp_path / "nothing"], tmp_path / "none.html")
    assert not (tmp_path / "none.html").exists()


def drawn(browser: Browser, runs: list[dict[str, Any]], directory: Path, script: str = "") -> str:
    """The page after its script has run, as text, without a complaint."""
    page = directory / "report.html"
    page.write_text(render(runs).replace("</body>", f"<script>{script}</script></body>"), encoding="utf-8")
    browser.open(page.as_uri())
    browser.wait_for("document.documentElement.dataset.ready === ''")
    assert browser.complaints() == []
    shown = str(browser.run("document.documentElement.outerHTML"))
    headings = re.findall(r"<h2>([^<]+)</h2>", shown)
    expected = ["Flight", "Distances", "Slots", "Channel use", "Decisions", "Age", "Estimate error", "Agents"]
    assert [heading for heading in headings if heading in expected] == expected
    assert headings[-1] == "Configuration"
    # distances, channel, decisions, twice age, twice error; scene and two canvases for the slots
    assert shown.count('<svg class="plot"') == 7 * len(runs)
    assert shown.count("<canvas") == 3 * len(runs)
    shown = re.sub(r"<script.*?</script>", "", shown, flags=re.S)
    assert "NaN" not in shown
    return shown


@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
def test_chromium_draws_every_part_and_shows_hostile_names_as_text(data, hostile, tmp_path):
    with browsing() as browser:
        shown = drawn(browser, [hostile, data["lossy"]], tmp_path)
        assert "<title>broken" not in shown
        assert "<img" not in shown
        assert colours(browser.picture(), tmp_path) > 150  # text and lines alone have far fewer


PLAY = """
const told = [];
clock.set(0.5); clock.toggle(); clock.toggle(); told.push(clock.time); clock.toggle();
const waits = setInterval(() => {  // a busy machine may draw nothing for a while
  if (clock.time <= 0.5) return;
  clearInterval(waits);
  clock.toggle(); const stood = clock.time; clock.toggle(); clock.toggle();
  told.push(stood > 0.5, clock.time === stood);
  clock.set(DURATION); told.push(document.querySelector(".play").textContent);
  clock.toggle(); told.push(clock.time); clock.toggle();
  document.body.dataset.told = JSON.stringify(told);
}, 100);
"""


@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
def test_chromium_plays_on_from_where_it_stood_marks_crashes_and_prints(crash, tmp_path):
    data, _ = crash
    with browsing() as browser:
        shown = drawn(browser, [data], tmp_path, PLAY)
        browser.wait_for("document.body.dataset.told")
        assert browser.run("document.body.dataset.told") == '[0.5,true,true,"↻",0]'
        assert "A cross in a ring is a crash" in shown
        assert shown.count('class="mark"') == len(data["crashes"])
        for name in data["sent_for"]:
            assert REASON_TEXTS[name] in shown  # explained where they appear
        paper = browser.paper()
    assert paper.startswith(b"%PDF")
    assert 2 <= len(re.findall(rb"/Type\s*/Page\b", paper)) <= 12


HINT = """(title => {
  const heading = [...document.querySelectorAll("section h2")].find(node => node.textContent === title);
  const section = heading.parentElement;
  const box = section.querySelector(".scroll"), hint = section.querySelector(".hint");
  const state = () => [hint.hidden, hint.textContent], first = state();
  box.scrollTo(box.scrollWidth, box.scrollHeight);
  return new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done([first, state()]))));
})"""


@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
def test_a_table_says_how_much_of_it_is_out_of_sight(data, tmp_path):
    (tmp_path / "report.html").write_text(render([data["clean"]]), encoding="utf-8")
    heads = [f"column {k}" for k in range(60)]
    parts = [
        Part("Wide", heads=heads, rows=[["0.123456"] * 60] * 40),
        Part("Slim", heads=heads[:2], rows=[["0.1"] * 2] * 30),
    ]
    write_tables(tmp_path / "tables.html", "Sweep", "A sweep", parts, "")
    with browsing(390) as phone:
        phone.open((tmp_path / "report.html").as_uri())
        (hidden, text), (_, at_end) = phone.run(f"{HINT}('Agents')")
        assert not hidden
        assert re.fullmatch(r"[1-8] more columns →", text)
        assert at_end == ""
        assert phone.run("document.documentElement.scrollWidth === innerWidth")
    with browsing(1280) as browser:
        browser.open((tmp_path / "report.html").as_uri())
        assert browser.run(f"{HINT}('Agents')")[0] == [True, ""]
        browser.open((tmp_path / "tables.html").as_uri())
        (hidden, text), (_, at_end) = browser.run(f"{HINT}('Wide')")
        assert not hidden
        assert re.fullmatch(r"\d+ more columns →   \d+ more rows ↓", text)
        assert at_end == ""
        assert browser.run(f"{HINT}('Slim')")[0] == [True, ""]
        assert browser.complaints() == []
