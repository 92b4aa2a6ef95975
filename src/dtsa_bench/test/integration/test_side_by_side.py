"""The suite's own rules: it ends whatever its tests do, and says at once which of them have failed."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from checkout import SIDE_BY_SIDE

ROOT = Path(__file__).resolve().parents[4]

pytestmark = pytest.mark.skipif(not (ROOT / "conftest.py").exists(), reason="not in the source tree")

DIES = """
import os
import pytest

def test_before(): pass

@pytest.mark.alone
def test_dies():
    os._exit(1)

def test_afterwards(): pass
"""
FAILS = """
import time
import pytest

@pytest.mark.alone
def test_needs_the_machine_for_itself():
    time.sleep(0.5)

@pytest.mark.timeout(1)
def test_hangs():
    time.sleep(60)
"""
REACTS = """
from pathlib import Path
import pytest

@pytest.mark.realtime
def test_too_slow_beside_others(tmp_path_factory):
    mark = tmp_path_factory.getbasetemp().parent / "second"
    second = mark.exists()
    mark.touch()
    assert second

@pytest.mark.realtime
def test_always_fails():
    assert False
"""


def test_a_dead_worker_and_a_test_that_hangs_are_named_and_the_run_ends(tmp_path: Path) -> None:
    shutil.copy(ROOT / "conftest.py", tmp_path)
    own = (ROOT / "pyproject.toml").read_text().partition("[tool.pytest.ini_options]")[2].partition("\n[")[0]
    lines = [line for line in own.splitlines() if not line.startswith(("testpaths", "pythonpath"))]
    (tmp_path / "pyproject.toml").write_text("\n".join(("[tool.pytest.ini_options]", *lines, "")))
    (tmp_path / "test_dies.py").write_text(DIES)
    (tmp_path / "test_fails.py").write_text(FAILS)
    (tmp_path / "test_reacts.py").write_text(REACTS)
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")}
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-n", "2", *SIDE_BY_SIDE, "-p", "no:cacheprovider"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert run.returncode in (1, 2), run.stdout
    # Which worker gets which file is open.
    assert re.search(r"worker 'gw[01]' crashed while running 'test_dies\.py::test_dies'", run.stderr)
    assert "test_fails.py::test_hangs: Failed: Timeout" in run.stderr  # said when it happens, and at the end again
    assert "RERUN test_reacts.py::test_too_slow_beside_others" in run.stdout
    assert "FAILED test_reacts.py::test_always_fails" in run.stdout
    assert "3 failed, 3 passed, 2 rerun" in run.stdout
