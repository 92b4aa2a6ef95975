"""The demo: its numbers, its picture, its page and its animation; and the flight in which an agent is killed."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from dtsa_dev.soak.chromium import CHROMIUM, MISSING, browsing
from dtsa_dev.soak.flights import children
from PIL import Image

from dtsa_bench.drawing.palette import AGENT_COLOURS
from dtsa_bench.experiments.batch.table import markdown
from dtsa_bench.pages import browser as opener
from dtsa_bench.pages.demo import live
from dtsa_bench.pages.demo.animation import SLOTS, draw_animation
from dtsa_bench.pages.demo.flown import Flown
from dtsa_bench.pages.demo.live import Killing, Times, Until
from dtsa_bench.pages.demo.page import write_page
from dtsa_bench.pages.demo.picture import draw_demo
from dtsa_bench.pages.demo.story import KILLED, story
from dtsa_bench.pages.demo.strips import cells, killed_windows, window
from dtsa_bench.pages.demo.table import HEAD, for_terminal, rows
from dtsa_bench.simulation.simulate import simulate

ROOT = Path(__file__).resolve().parents[4]
STEPS = story(1)


@pytest.fixture(scope="module")
def flights() -> dict[str, Flown]:
    """The flights of the demo without nodes: in lockstep they are the same, bit for bit."""
    found = {}
    for take in (take for step in STEPS for take in step.takes):
        if take.live:
            continue
        flight = simulate(take.run, trace=True)
        assert flight.trace is not None
        track = flight.trace.positions()[take.run.swarm.steps - 1 :: take.run.swarm.steps]
        position = np.concatenate((flight.scenario.start[None], track))
        error = np.linalg.norm(np.stack(flight.trace.estimates) - track, axis=1).mean(axis=1)
        scenario = flight.scenario
        found[take.key] = Flown(
            take, flight.summary(), tuple(flight.trace.senders), position, scenario.target, scenario.moving, error
        )
    found["killed-lease"] = killed()
    return found


def killed() -> Flown:
    """A flight in which agent 3 dies in slot 200, agent 4 uses its turns from slot 1200 on, and it is back in 1400."""
    take = STEPS[3].takes[0]
    agents, slots = take.run.swarm.agents, 1600
    senders: list[tuple[int, ...]] = [(slot % agents + 1,) for slot in range(slots)]
    for slot in range(KILLED - 1, slots, agents):
        if 200 <= slot < 1400:
            senders[slot] = (KILLED + 1,) if slot >= 1200 else ()
    place = np.zeros((slots, 3, agents))
    summary: dict[str, Any] = {"seed": 1}
    moving = np.ones(agents, dtype=bool)
    times = Times(200 * take.run.swarm.slot_s, 1400 * take.run.swarm.slot_s)
    return Flown(take, summary, tuple(senders), place, place[0], moving, np.zeros(slots), times)


def test_the_readme_has_the_numbers_of_the_demo(flights: dict[str, Flown]) -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    table = markdown(HEAD, rows(STEPS, flights))
    assert table in text, table


def test_the_story_is_true(flights: dict[str, Flown]) -> None:
    """What the sentences say without a number."""
    value = {key: flown.summary for key, flown in flights.items()}
    assert value["all-tdma"]["estimate_error_mean_m"] < 0.1 * value["all-tdma-hold"]["estimate_error_mean_m"]
    assert value["two-dtsa"]["age_mean_slots"] < value["two-lease"]["age_mean_slots"] < 2.0
    assert value["two-tdma"]["age_mean_slots"] > 5.0
    assert value["loss-dtsa"]["agreement_share"] < 0.1
    assert value["loss-dtsa"]["slots"]["collision"] > 40
    assert value["loss-lease"]["slots"]["collision"] == 0
    assert value["loss-lease"]["estimate_error_mean_m"] < 0.5 * value["loss-tdma"]["estimate_error_mean_m"]
    assert value["loss-lease"]["estimate_error_mean_m"] < 0.05 * value["loss-dtsa"]["estimate_error_mean_m"]


def test_every_cell_is_who_sent(flights: dict[str, Flown]) -> None:
    first, count = window([flights["loss-dtsa"]])
    shown = cells(flights["loss-dtsa"], first, count)
    assert [cell.senders for cell in shown] == list(flights["loss-dtsa"].senders[first : first + count])
    assert {len(cell.colours) for cell in shown} == {0, 1, 2}


def test_death_new_use_and_return_are_found(flights: dict[str, Flown]) -> None:
    death, used, back = killed_windows(flights["killed-lease"])
    row = [[cell.senders for cell in part.cells if cell.y == KILLED - 1] for part in (death, used, back)]
    for part, (before, after) in zip(
        row, [((KILLED,), ()), ((), (KILLED + 1,)), ((KILLED + 1,), (KILLED,))], strict=True
    ):
        assert part[0] == before
        assert part[-1] == after
    assert "by 4" in used.caption


def test_picture_and_page(flights: dict[str, Flown], tmp_path: Path) -> None:
    draw_demo(tmp_path / "demo.png", STEPS, flights)
    with Image.open(tmp_path / "demo.png") as picture:
        assert picture.width > 1600
        seen = np.array(picture.getpalette()).reshape(-1, 3)
    for colour in AGENT_COLOURS:
        wanted = [int(colour[start : start + 2], 16) for start in (1, 3, 5)]
        assert np.abs(seen - wanted).max(axis=1).min() < 16, colour
    write_page(tmp_path / "demo.html", STEPS, flights, [("again", "tools/dtsa <b>")])
    page = (tmp_path / "demo.html").read_text(encoding="utf-8")
    assert not re.search(r"(?:src|href)=|https?://(?!www\.w3\.org)|\{\{", page)
    assert "tools/dtsa &lt;b&gt;" in page
    data = json.loads(page.split('id="data">')[1].split("</script>")[0])
    assert data["flights"]["two-dtsa"]["senders"] == [list(sent) for sent in flights["two-dtsa"].senders]
    for step in STEPS:
        assert step.title in page


@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
def test_chromium_shows_and_plays_the_page(flights: dict[str, Flown], tmp_path: Path) -> None:
    write_page(tmp_path / "demo.html", STEPS, flights, [])
    first, count = window([flights["loss-dtsa"]])
    kinds = ["none", "", "both"]  # by number of senders; who hovers is another one
    with browsing() as browser:
        browser.open((tmp_path / "demo.html").as_uri())
        of_dtsa = "document.querySelectorAll('#c .flight')[1].querySelectorAll('.strip i')"
        shown = browser.run(f"[...{of_dtsa}].map(one => one.className)")
        wanted = [kinds[len(sent)] for sent in flights["loss-dtsa"].senders[first : first + count]]
        assert [kind.replace("hover", "") for kind in shown] == wanted
        turns = sum(len(part.cells) for part in killed_windows(flights["killed-lease"]))
        assert browser.run("document.querySelectorAll('.turn i').length") == turns
        assert browser.run("document.querySelectorAll('.chart path[stroke-width]').length") == 2
        assert browser.run("document.querySelectorAll('.view').length") == 8
        browser.run("document.querySelector('#b .play button').click()")
        browser.wait_for("parseFloat(document.querySelector('#b output').textContent) > 0.1")
        assert browser.run("document.querySelectorAll('#b .strip .now').length") == 3
        browser.run("document.querySelector('#b .play button').click()")
        assert browser.run("document.querySelector('#b .play button').textContent") == "▶ play"
        assert browser.run("document.querySelectorAll('#b .wave').length") > 0
        assert browser.complaints() == []


def test_animation_is_small_and_moves(flights: dict[str, Flown], tmp_path: Path) -> None:
    path = tmp_path / "demo.gif"
    draw_animation(path, flights, slots := 20)
    assert path.stat().st_size < 2_000_000 * slots / SLOTS
    with Image.open(path) as film:
        assert film.n_frames == slots  # type: ignore[attr-defined]
        first = np.asarray(film.convert("RGB"))
        film.seek(slots - 1)
        last = np.asarray(film.convert("RGB"))
    assert (first[0, 0] == 255).all()
    assert (last[0, 0] == 255).all()
    assert (first != last).any(axis=2).mean() > 0.02


def test_table_has_a_row_a_flight(flights: dict[str, Flown]) -> None:
    assert len(for_terminal(STEPS, flights).splitlines()) == 2 + 8


def test_the_agent_is_killed_once_and_the_flight_ends_when_it_is_back(monkeypatch: pytest.MonkeyPatch) -> None:
    shot: list[tuple[int, int]] = []
    monkeypatch.setattr(live.os, "kill", lambda pid, number: shot.append((pid, number)))
    now = [100.0]
    monkeypatch.setattr(live, "time", SimpleNamespace(monotonic=lambda: now[0]))
    killing = Killing(3)
    over = Until(SimpleNamespace(signal=0), lambda: killing.seen)  # type: ignore[arg-type]
    over._stop = False  # type: ignore[assignment]
    processes = [SimpleNamespace(agents=[id_], process=SimpleNamespace(pid=10 + id_)) for id_ in (2, 3)]
    killing.started(SimpleNamespace(all=processes))  # type: ignore[arg-type]
    status: Any = None
    killing.idle(status)
    killing.begun(100.0)
    killing.idle(status)
    assert not shot
    now[0] = 101.5
    killing.idle(status)
    killing.idle(status)
    assert shot == [(13, signal.SIGKILL)]
    killing.agents_back([2])
    assert killing.times() == Times(1.5, None)
    now[0] = 108.0
    killing.agents_back([3])
    assert not over
    now[0] = 110.0
    assert over
    assert killing.times() == Times(1.5, 8.0)


@pytest.mark.parametrize(
    ("environment", "platform", "looks"),
    [
        ({"DISPLAY": ":0"}, "linux", True),
        ({"WAYLAND_DISPLAY": "wayland-0"}, "linux", True),
        ({}, "linux", False),
        ({}, "darwin", True),
        ({"DISPLAY": "localhost:10.0", "SSH_CONNECTION": "1 2 3 4"}, "linux", False),
        ({"DISPLAY": ":0", "CI": "true"}, "linux", False),
    ],
)
def test_a_page_opens_where_somebody_looks(environment: dict[str, str], platform: str, looks: bool) -> None:
    assert opener.somebody_looks(environment, platform) is looks


def test_no_open_is_obeyed(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr(opener.webbrowser, "open", lambda url: opened.append(url) or True)
    assert not opener.open_page(Path("page.html"), False)
    assert opener.open_page(Path("page.html"), True)
    assert len(opened) == 1
    assert opened[0].startswith("file:///")


@pytest.mark.ros
def test_ctrl_c_ends_it_soon_and_leaves_no_process(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "dtsa_bench", "demo", "--no-open", "--out", str(tmp_path / "demo")]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(1.0)
    begin = time.monotonic()
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert time.monotonic() - begin < 10.0  # two seconds on a machine with little else to do
    assert not children(process.pid)


@pytest.mark.ros
@pytest.mark.alone
@pytest.mark.skipif(not os.environ.get("CI"), reason="the whole demo takes most of a minute; once in CI")
def test_the_whole_demo(tmp_path: Path, flights: dict[str, Flown]) -> None:
    out = tmp_path / "demo"
    words = [sys.executable, "-m", "dtsa_bench", "demo", "--out", str(out)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("verified ") == 9
    assert for_terminal(STEPS, flights) in done.stdout  # the nodes fly what the simulation flies
    assert done.stdout.splitlines()[-1] == str(out / "demo.html")
    assert (out / "demo.png").exists()
    assert json.loads((out / "demo.json").read_text())["killed-lease"]["returned_agents"] == [KILLED]
