"""The demo: its numbers, its picture and its animation; and the flight in which an agent is killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from fly_helpers import children
from PIL import Image

from dtsa_agent.core import make_scenario
from dtsa_bench.commands import demo as command
from dtsa_bench.drawing.palette import AGENT_COLOURS
from dtsa_bench.experiments.tables import aligned
from dtsa_bench.pages.demo.flights import HEAD, KILLED, FinishedFlight, demo_steps, table_rows
from dtsa_bench.pages.demo.picture import draw_animation, draw_demo, killed_cells, killed_parts, step_text
from dtsa_bench.simulation.simulate import simulate

ROOT = Path(__file__).resolve().parents[4]
STEPS = demo_steps(1)


@pytest.fixture(scope="module")
def flights() -> dict[str, FinishedFlight]:
    """The flights of the demo without nodes: in lockstep they are the same, bit for bit."""
    found = {}
    for flight in (flight for step in STEPS for flight in step if not flight.live):
        flown = simulate(flight.run, log=True, observer=1)
        assert flown.log is not None
        track = flown.log.positions()[flight.run.swarm.steps - 1 :: flight.run.swarm.steps]
        position = np.concatenate((flown.scenario.start[None], track))
        error = np.linalg.norm(flown.log.estimate - track, axis=1).mean(axis=1)
        senders = tuple(flown.log.senders())
        found[flight.key] = FinishedFlight(flight, flown.summary(), flown.scenario, senders, position, error)
    return found | {"killed-lease": killed()}


def killed() -> FinishedFlight:
    """A flight in which agent 3 dies in slot 200, agent 4 uses its turns from slot 1200 on, and it is back in 1400."""
    (flight,) = STEPS[3]
    agents, slots = flight.run.swarm.agents, 1600
    senders: list[tuple[int, ...]] = [(slot % agents + 1,) for slot in range(slots)]
    for slot in range(KILLED - 1, slots, agents):
        if 200 <= slot < 1400:
            senders[slot] = (KILLED + 1,) if slot >= 1200 else ()
    scenario, place = make_scenario(flight.run.swarm), np.zeros((slots, 3, agents))
    return FinishedFlight(flight, {"seed": 1}, scenario, tuple(senders), place, np.zeros(slots))


def test_the_readme_has_the_numbers_of_the_demo_and_its_story_is_true(flights: dict[str, FinishedFlight]) -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    lines = [HEAD, *table_rows(STEPS, flights)]
    head, *rows = ["| " + " | ".join(line) + " |" for line in lines]
    table = "\n".join([head.replace("|  |", "| |"), "|---" * len(HEAD) + "|", *rows])
    assert table in text, table
    # What the sentences say without a number.
    value = {key: flown.summary for key, flown in flights.items()}
    assert value["all-tdma"]["estimate_error_mean_m"] < 0.1 * value["all-tdma-hold"]["estimate_error_mean_m"]
    assert value["two-dtsa"]["age_mean_slots"] < value["two-lease"]["age_mean_slots"] < 2.0
    assert value["two-tdma"]["age_mean_slots"] > 5.0
    assert value["loss-dtsa"]["agreement_share"] < 0.1
    assert value["loss-dtsa"]["slots"]["collision"] > 40
    assert value["loss-lease"]["slots"]["collision"] == 0
    assert value["loss-lease"]["estimate_error_mean_m"] < 0.5 * value["loss-tdma"]["estimate_error_mean_m"]
    assert value["loss-lease"]["estimate_error_mean_m"] < 0.05 * value["loss-dtsa"]["estimate_error_mean_m"]


def test_death_new_use_and_return_are_found(flights: dict[str, FinishedFlight]) -> None:
    live = flights["killed-lease"]
    death, used, back = killed_parts(live)
    turns = [
        [senders for _, own, senders in killed_cells(live, part[1]) if own == KILLED - 1]
        for part in (death, used, back)
    ]
    ends = [((KILLED,), ()), ((), (KILLED + 1,)), ((KILLED + 1,), (KILLED,))]
    assert [(turn[0], turn[-1]) for turn in turns] == ends
    assert "by 4" in used[0]
    assert "speaks 7.2 s after it was killed" in step_text(4, flights)[1]


def test_picture_has_all_colours_and_animation_is_small_and_moves(flights, tmp_path):
    draw_demo(tmp_path / "demo.png", STEPS, flights)
    with Image.open(tmp_path / "demo.png") as picture:
        assert picture.width > 1600
        seen = np.array(picture.getpalette()).reshape(-1, 3)
    for colour in AGENT_COLOURS:
        wanted = [int(colour[start : start + 2], 16) for start in (1, 3, 5)]
        assert np.abs(seen - wanted).max(axis=1).min() < 16, colour
    path = tmp_path / "demo.gif"
    draw_animation(path, flights, slots := 20)
    assert path.stat().st_size < 600_000 * slots / 80
    with Image.open(path) as film:
        assert film.n_frames == slots  # type: ignore[attr-defined]
        first = np.asarray(film.convert("RGB"))
        film.seek(slots - 1)
        last = np.asarray(film.convert("RGB"))
    assert (first[0, 0] == 255).all()
    assert (last[0, 0] == 255).all()
    assert (first != last).any(axis=2).mean() > 0.02


@pytest.mark.parametrize(("environment", "platform", "looks"), [
    ({"DISPLAY": ":0"}, "linux", True), ({"WAYLAND_DISPLAY": "wayland-0"}, "linux", True), ({}, "linux", False),
    ({}, "darwin", True), ({"DISPLAY": "localhost:10.0", "SSH_CONNECTION": "1 2 3 4"}, "linux", False),
    ({"DISPLAY": ":0", "CI": "true"}, "linux", False),
])  # fmt: skip
def test_a_page_opens_where_somebody_looks(environment: dict[str, str], platform: str, looks: bool) -> None:
    assert command.has_display(environment, platform) is looks


def test_no_open_is_obeyed(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr(command.webbrowser, "open", lambda url: opened.append(url) or True)
    assert not command.open_page(Path("page.html"), False)
    assert command.open_page(Path("page.html"), True)
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
@pytest.mark.realtime
@pytest.mark.skipif(not os.environ.get("CI"), reason="the whole demo takes most of a minute; once in CI")
def test_the_whole_demo(tmp_path: Path, flights: dict[str, FinishedFlight]) -> None:
    out = tmp_path / "demo"
    words = [sys.executable, "-m", "dtsa_bench", "demo", "--out", str(out)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("verified ") == 9
    assert (
        aligned([HEAD, *table_rows(STEPS, flights)], rule=True) in done.stdout
    )  # the nodes fly what the simulation flies
    assert done.stdout.splitlines()[-1] == str(out / "demo.html")
    assert (out / "demo.png").exists()
    assert json.loads((out / "demo.json").read_text())["killed-lease"]["returned_agents"] == [KILLED]
