"""Integration: flights, recordings, verifications and configurations as a terminal and a notebook show them."""

from __future__ import annotations

import os
import pickle
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
from bag_helpers import flight_bag

import dtsa
from dtsa_bench.drawing.card import as_html
from dtsa_bench.drawing.flight_paths import svg_from_above


def lines_of(shown: object) -> list[str]:
    lines = repr(shown).splitlines()
    assert len(lines) <= 12
    assert max(map(len, lines)) <= 120
    return lines


def parts_of(shown: object) -> list[int]:
    """Numbers of craft and crashes in a notebook's picture, which takes nothing from elsewhere."""
    page: str = shown._repr_html_()  # type: ignore[attr-defined]
    assert not re.search(r"https?:|<script|<link|@import|url\(", page)
    assert page.count("<div") == page.count("</div>")
    return count(re.search(r"<svg.*</svg>", page, re.DOTALL).group())  # type: ignore[union-attr]


def count(svg: str) -> list[int]:
    parts = re.findall(r'<g id="(?:hover-)?(craft|crash)(?:-\d+)?"', svg)
    return [parts.count(name) for name in ("craft", "crash")]


def test_flights_show_their_results_and_a_picture() -> None:
    flight = dtsa.simulate(agents=12, moving=4, policy="lease", loss=0.1, seed=3)
    lines = lines_of(flight)
    assert f"{flight.summary['completion_time_s']:.2f} s" in repr(flight)
    for name in lines[-1].split(maxsplit=1)[1].partition(";")[0].split(", "):
        assert hasattr(flight, name)
    assert parts_of(flight) == [12, 0]
    settings = {"agents": 12, "loss": 0.4, "seed": 4, "collision_m": 0.4}
    crashed = dtsa.simulate(**settings)
    assert lines_of(crashed)
    assert "agents {} and {}".format(*crashed.summary["collided_pair"]) in repr(crashed)
    assert parts_of(crashed)[1] == 1
    assert "<svg" not in dtsa.simulate(**settings, trace=False)._repr_html_()


def test_flights_and_sweeps_can_be_pickled_and_shown_without_plots_and_tables() -> None:
    flight = dtsa.simulate(agents=4, loss=0.1, timeout_s=0.5)
    copy = pickle.loads(pickle.dumps(flight))
    assert np.array_equal(copy.path, flight.path)
    assert copy.slots.equals(flight.slots)
    assert repr(copy) == repr(flight)
    result = dtsa.sweep(axes={"loss": [0.0, 0.2]}, base={"agents": 4, "timeout_s": 0.3}, seeds=2)
    assert pickle.loads(pickle.dumps(result)).table().equals(result.table())
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


def test_recordings_and_verifications_are_shown_and_escaped_also_where_positions_are_unknown(tmp_path: Path) -> None:
    run = tmp_path / "a & <b>"
    flight_bag(run / "bag", slots=60, loss=0.1, agents=6, policy="lease", seed=3)
    recording, verification = dtsa.open(run), dtsa.verify(run)
    assert "60 slots" in repr(recording)
    assert parts_of(recording)[0] == 6
    assert lines_of(recording)
    assert repr(verification).startswith(f"{run}: ")
    assert not [shown for shown in (recording, verification) if "<b>" in shown._repr_html_()]
    page = as_html("a < b", [("x & y", "<i>")], folded=[("<u>", [("p", "<q>")])])
    assert not [word for word in ("a < b", "<i>", "<u>", "<q>", "x & y") if word in page]
    path = np.full((5, 3, 3), np.nan)
    path[2:, :, 0] = 1.0
    assert count(svg_from_above(path, np.array([True, True, False]), "<a>", (1, 2))) == [1, 0]
