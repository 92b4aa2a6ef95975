"""What flights, recordings, verifications and configurations say of themselves in a terminal and in a notebook."""

from __future__ import annotations

import os
import pickle
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
from flight_helpers import flight_bag

import dtsa
from dtsa_bench.drawing.card import as_html
from dtsa_bench.drawing.flight_paths import svg_from_above


def rows_of(shown: object) -> dict[str, str]:
    """The rows below the title, by name; checks that all fit in a few lines."""
    lines = repr(shown).splitlines()
    assert len(lines) <= 12
    assert max(map(len, lines)) <= 120
    return dict(re.split(r"\s{2,}", line.strip(), maxsplit=1) for line in lines[1:])


def picture_of(shown: object) -> list[str]:
    """Ids of the parts of the picture that a notebook shows, which takes nothing from elsewhere."""
    page: str = shown._repr_html_()  # type: ignore[attr-defined]
    assert not re.search(r"https?:|<script|<link|@import|url\(", page)
    assert page.count("<div") == page.count("</div>")
    return parts_of(re.search(r"<svg.*</svg>", page, re.DOTALL).group())  # type: ignore[union-attr]


def parts_of(picture: str) -> list[str]:
    """Ids of the parts of a picture without their numbers: way, craft, id, crash."""
    return re.findall(r'<g id="(?:hover-)?(way|craft|id|crash)(?:-\d+)?"', picture)


def test_a_flight_says_in_ten_lines_what_came_of_it() -> None:
    flight = dtsa.simulate(agents=12, moving=4, policy="lease", loss=0.1, seed=3)
    rows, summary = rows_of(flight), flight.summary
    assert repr(flight).splitlines()[0] == "Flight: lease, linear, orca; 12 agents, 4 of them moving (exchange); seed 3"
    assert rows["outcome"].startswith(f"completed after {summary['completion_time_s']:.2f} s, no crash")
    assert f"{summary['age_mean_slots']:.3g} slots ({summary['age_mean_ms']:.3g} ms) on average" in rows["ages"]
    assert f"{summary['age_max_slots']} slots" in rows["ages"]
    assert rows["distance"].startswith(f"{summary['min_distance_m']:.3f} m at least")
    assert rows["channel"].startswith("loss 0.1; ")
    assert "agent 1 knew" in rows["kept"]
    for name in rows["more"].partition(";")[0].split(", "):
        assert hasattr(flight, name)
    picture = picture_of(flight)
    assert [picture.count(name) for name in ("craft", "way", "id", "crash")] == [12, 4, 12, 0]


def test_a_crash_is_said_and_ringed_and_a_flight_without_trace_has_no_picture() -> None:
    settings = {"agents": 12, "loss": 0.4, "seed": 4, "collision_m": 0.4}
    flight = dtsa.simulate(**settings)
    first, second = flight.summary["collided_pair"]
    assert rows_of(flight)["outcome"].startswith(
        f"crashed after {flight.summary['flight_time_s']:.2f} s: agents {first} and {second}"
    )
    assert picture_of(flight).count("crash") == 1
    on = dtsa.simulate(**settings, stop_on_crash=False, trace=False)
    assert f"agents {first} and {second} crashed" in rows_of(on)["outcome"]
    assert "trace=False" in rows_of(on)["kept"]
    assert "<svg" not in on._repr_html_()


def test_flights_and_sweeps_can_be_pickled() -> None:
    flight = dtsa.simulate(agents=4, loss=0.1, timeout_s=0.5)
    copy = pickle.loads(pickle.dumps(flight))
    assert np.array_equal(copy.path, flight.path)
    assert copy.slots.equals(flight.slots)
    assert repr(copy) == repr(flight)
    result = dtsa.sweep(axes={"loss": [0.0, 0.2]}, base={"agents": 4, "timeout_s": 0.3}, seeds=2)
    assert pickle.loads(pickle.dumps(result)).table().equals(result.table())


def test_showing_a_flight_loads_no_plots_and_no_tables() -> None:
    program = (
        "import sys, dtsa; f = dtsa.simulate(agents=4, timeout_s=0.3); repr(f); "
        "print([name for name in ('matplotlib', 'pandas', 'pyarrow', 'rich') if name in sys.modules])"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_configurations_show_what_differs_from_the_defaults_and_can_be_read_back() -> None:
    names = {name: getattr(dtsa, name) for name in dtsa.__all__}
    for config in (
        dtsa.run_config(),
        dtsa.run_config(agents=5, policy="lease", loss=0.1, burst_length=3.0, seed=7, timeout_s=5),
        dtsa.run_config(agents=3, loss_matrix=((0.0, 1.0, 0.5),) * 3),
        dtsa.ClockConfig(drift_ppm=20.0),
    ):
        assert eval(repr(config), names) == config
        assert len(repr(config)) < 300
    assert repr(dtsa.SwarmConfig(moving=2, slot_ms=20)) == "SwarmConfig(moving=2, slot_ms=20.0)"


def test_a_recording_and_its_verification_say_what_is_in_it(tmp_path: Path) -> None:
    run = tmp_path / "a & <b>"
    flight_bag(run / "bag", slots=60, loss=0.1, agents=6, policy="lease", seed=3)
    recording = dtsa.read_bag(run)
    rows = rows_of(recording)
    assert repr(recording).startswith("Recording a & <b>: lease, linear, orca; 6 agents")
    assert rows["outcome"].startswith("stopped after 0.60 s")
    assert rows["recorded"].startswith("60 slots, ")
    assert rows["kept"] == str(recording.file)
    assert picture_of(recording).count("craft") == 6
    assert "<b>" not in recording._repr_html_()
    verification = dtsa.verify(run)
    assert repr(verification).startswith(f"{run}: ")
    assert re.search(r"^  checked +lockstep, ", repr(verification), re.MULTILINE)
    assert "<b>" not in verification._repr_html_()


def test_what_is_shown_is_escaped_and_positions_may_be_unknown() -> None:
    page = as_html("a < b", [("x & y", "<i>")], folded=[("<u>", [("p", "<q>")])])
    for word in ("a < b", "<i>", "<u>", "<q>", "x & y"):
        assert word not in page
    path = np.full((5, 3, 3), np.nan)
    path[2:, :, 0] = 1.0
    svg = svg_from_above(path, np.array([True, True, False]), "<a>", (1, 2))
    assert "<a>" not in svg
    assert [parts_of(svg).count(name) for name in ("craft", "crash")] == [1, 0]
    many = np.zeros((3, 3, 30))
    svg = svg_from_above(many, np.ones(30, np.bool_), "")
    assert [parts_of(svg).count(name) for name in ("way", "id")] == [30, 0]
    assert len(re.findall(r'<g id="way-\d+">\s*<path [^>]*stroke-dasharray', svg)) == 18  # colours come again
