"""Integration: rows of a sweep are used again for equal code only, that of plug-ins included."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from dtsa_bench.experiments import provenance

RULE = """
from {helper} import turn

class Mine:
    def __init__(self, config, agent):
        self.agents = config.agents

    def choose(self, table, slot):
        return turn(slot, self.agents)
"""
TDMA = "def turn(slot, agents):\n    return slot % agents + 1\n"
SLOWER = "def turn(slot, agents):\n    return slot // 2 % agents + 1\n"
LAYOUTS = {
    "package": ("mine_rule/__init__.py", "mine_rule/helper.py", "mine_rule", "mine_rule.helper"),
    "modules": ("mine_rule.py", "mine_helper.py", "mine_rule\nmine_helper", "mine_helper"),
    "re-exported": ("mine_rule/__init__.py", "mine_parts/__init__.py", "mine_rule\nmine_parts", "mine_parts"),
    "files alone": ("mine_rule.py", "mine_parts/__init__.py", "", "mine_parts"),  # as other builders install it
}


def install(directory: Path, layout: str) -> Path:
    """A plug-in as pip leaves one that is edited in place; returns the file that its rule comes from."""
    rule, helper, tops, module = LAYOUTS[layout]
    for name, text in ((rule, RULE.format(helper=module)), (helper, TDMA)):
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        (directory / name).write_text(text)
    about = directory / "mine-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[dtsa.policies]\nmine = mine_rule:Mine\n")
    if tops:
        (about / "top_level.txt").write_text(tops + "\n")
    else:
        (about / "RECORD").write_text(f"{rule},,\n{helper},,\nmine-1.0.dist-info/METADATA,,\n")
    return directory / helper


def sweep(directory: Path, policy: str = "mine") -> tuple[str, list[float], str]:
    """Flies a sweep by its command; returns what it says on stderr, the ages of its runs, and its code's digest."""
    file = directory / "mine.yaml"
    file.write_text(json.dumps({"base": {"agents": 6, "timeout_s": 1}, "axes": {"policy": [policy]}, "seeds": 2}))
    path = os.pathsep.join([str(directory), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
    words = ["sweep", "--file", str(file), "--out", str(directory / "runs"), "--no-report"]
    command = [sys.executable, "-m", "dtsa_bench", *words]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 0, ended.stderr
    content = json.loads((directory / "runs" / "results.json").read_text())
    return ended.stderr, [row["age_mean_slots"] for row in content["runs"]], content["code"]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_plug_in_that_has_changed_between_two_sweeps_flies_again(layout: str, tmp_path: Path) -> None:
    helper = install(tmp_path, layout)
    _, first, _ = sweep(tmp_path)
    said, again, _ = sweep(tmp_path)
    assert "2 of 2 runs are there already" in said
    assert again == first
    helper.write_text(SLOWER)
    said, changed, _ = sweep(tmp_path)
    assert "2 runs of other code are left aside" in said
    assert all(new > old for new, old in zip(changed, first, strict=True))


def test_a_plug_in_that_does_not_fly_does_not_count(tmp_path: Path) -> None:
    helper = install(tmp_path, "package")
    sweep(tmp_path, "tdma")
    helper.write_text(SLOWER)
    assert "2 of 2 runs are there already" in sweep(tmp_path, "tdma")[0]


def test_versions_data_and_the_compiled_kernel_count(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    digest = provenance.code_digest.__wrapped__
    digests = {digest()}
    monkeypatch.setattr(provenance.np, "__version__", "0.0")
    digests.add(digest())
    monkeypatch.setattr(provenance.platform, "python_version", lambda: "3.0.0")
    digests.add(digest())
    assert len(digests) == 3
    monkeypatch.syspath_prepend(str(tmp_path))
    package = tmp_path / "counted_package"
    (package / "__pycache__").mkdir(parents=True)
    counted = [package / name for name in ("__init__.py", "weights.npz", "_kernel.abi3.so")]
    for path in (*counted, package / "__pycache__" / "x.pyc", package / ".swap"):
        path.write_text("")
    assert sorted(provenance._files_of("counted_package")) == sorted(counted)
