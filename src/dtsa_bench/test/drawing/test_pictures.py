"""Integration: pictures have settings of their own, and none decides whether a flight was good."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SETTINGS = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
FULL_DISK = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), -1))  # no file gets larger, as on a disk that is full
from dtsa_bench.commands.cli import main
sys.exit(main(sys.argv[2:]))
"""
FLY = ["fly", "--agents", "2", "--processes", "1", "--timeout-s", "0.5", "--out", "run"]


def dtsa(directory: Path, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "dtsa_bench", *words]
    return subprocess.run(command, cwd=directory, env=SETTINGS | environment, capture_output=True, text=True)


@pytest.mark.parametrize(("words", "picture"), [
    (["simulate", "--agents", "4", "--timeout-s", "0.5", "--picture", "a.png"], "a.png"),
    pytest.param(FLY, "run/trajectories.png", marks=pytest.mark.ros),
])  # fmt: skip
def test_a_users_latex_does_not_reach_a_picture_and_a_broken_matplotlib_costs_the_picture_alone(
    tmp_path: Path, words: list[str], picture: str
) -> None:
    settings = tmp_path / "matplotlib"
    settings.mkdir()
    (settings / "matplotlibrc").write_text("text.usetex: True\naxes.grid: False\nfigure.dpi: 20\n")
    latex = dtsa(tmp_path, *words, MPLCONFIGDIR=str(settings), PATH="")  # no LaTeX is found
    assert latex.returncode == 0, latex.stderr
    assert (tmp_path / picture).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    (tmp_path / picture).unlink()
    other = [word.replace("run", "other") for word in words]
    broken = dtsa(tmp_path, *other, MPLBACKEND="nonsense")
    assert broken.returncode == 0, broken.stderr
    assert f"dtsa: warning: no {Path(picture).name}: Key backend: 'nonsense'" in broken.stderr
    assert "Traceback" not in broken.stderr
    assert f"picture: {picture}" not in broken.stdout + broken.stderr


def test_a_full_disk_costs_no_results_and_leaves_no_half_picture(tmp_path: Path) -> None:
    words = ["simulate", "--agents", "4", "--timeout-s", "0.5", "--json", "--picture", "a.png"]
    results = []
    for limit, more, code in ((10, ["--out", "flown"], 1), (5000, [], 0)):
        command = [sys.executable, "-c", FULL_DISK, str(limit), *words, *more]
        done = subprocess.run(command, cwd=tmp_path, env=SETTINGS, capture_output=True, text=True)
        assert done.returncode == code, done.stderr
        results.append(json.loads(done.stdout)["slots"])
        assert [path.name for path in tmp_path.glob("*png*")] == []
    assert results[0] == results[1] == {"total": 50, "success": 50, "collision": 0, "idle": 0}
