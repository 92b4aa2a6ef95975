"""Integration: the distribution `dtsa`, built and used without a workspace, and the workspace's build by colcon."""

from __future__ import annotations

import argparse
import configparser
import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest
from dtsa_dev import release

import checkout
import dtsa_bench
from dtsa_agent.core.errors import ConfigError

# ROS of the tests' environment must not be found from the fresh one.
ROS = ("rclpy", "ament_index_python", "diagnostic_msgs", "dtsa_msgs")
HIDDEN = f"import sys\nfor name in {ROS}:\n    sys.modules[name] = None\n"
DIGEST = "import release_trial; print(release_trial.digest())"


def run(*words: str | Path, cwd: Path, code: int = 0, **more: str) -> subprocess.CompletedProcess[str]:
    environment = {**release.CLEAN, **more}
    done = subprocess.run(
        list(map(str, words)), cwd=cwd, env=environment, capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("wheel")
    run("uv", "build", "-q", "--no-build-isolation", "-o", place, checkout.ROOT, cwd=place)  # by way of the source
    return next(place.glob("*.whl"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The programs of a fresh environment; what `dtsa` depends on is that of the tests."""
    place = tmp_path_factory.mktemp("environment")
    run("uv", "venv", "-q", "--no-project", "--python", sys.executable, place / "venv", cwd=place)
    python = place / "venv/bin/python"
    run("uv", "pip", "install", "-q", "--offline", "--no-deps", "--python", python, wheel, cwd=place)
    site = next(place.glob("venv/lib/python3*/site-packages"))
    (site / "others.pth").write_text(f"{sysconfig.get_path('purelib')}\n")
    (site / "sitecustomize.py").write_text(HIDDEN)
    return python.parent


def test_what_is_in_the_wheel_and_in_the_source(wheel: Path) -> None:
    version = dtsa_bench.__version__
    assert wheel.name.startswith(f"dtsa-{version}-cp310-abi3-linux_")
    assert wheel.stat().st_size < release.MAX_WHEEL_BYTES
    with zipfile.ZipFile(wheel) as file:
        names = file.namelist()
        said = Parser().parsestr(file.read(f"dtsa-{version}.dist-info/METADATA").decode())
        points = configparser.ConfigParser()
        points.read_string(file.read(f"dtsa-{version}.dist-info/entry_points.txt").decode())
    assert list(points["console_scripts"]) == ["dtsa"]
    assert len(points["dtsa.policies"]) == 15
    assert len(points["dtsa.nodes"]) == 9
    assert said["License-Expression"] == "Apache-2.0"
    notices = {name.rpartition("/")[2] for name in names if name.startswith(f"dtsa-{version}.dist-info/licenses/")}
    assert notices == {"LICENSE", "NOTICE"}
    assert set(said.get_all("Provides-Extra", [])) == set(checkout.EXTRAS) - {"dev"}
    compiled = {name.rpartition("/")[2] for name in names if name.endswith(".so")}
    assert {"_kernel.abi3.so", "_endless.abi3.so"} <= compiled
    assert all(name.endswith(".abi3.so") for name in compiled)
    assert {"dtsa_bench/log/bag/messages/Slot.msg", "dtsa/__init__.pyi", "dtsa/_settings.pyi"} <= set(names)
    assert not [name for name in names if "/test/" in name or name.startswith(("test", "checkout", "dtsa_dev"))]
    with tarfile.open(next(wheel.parent.glob("*.tar.gz"))) as file:
        sources = {name.partition("/")[2] for name in file.getnames()}
    assert {"pyproject.toml", "LICENSE", "NOTICE", "README.md", "CHANGELOG.md", "CITATION.cff"} <= sources
    wanted = (checkout.ROOT / "src/dtsa_agent/dtsa_agent").rglob("*.[ch]")
    assert {path.relative_to(checkout.ROOT).as_posix() for path in wanted} <= sources


def test_works_without_a_workspace(installed: Path, tmp_path: Path) -> None:
    trial = json.loads(run(installed / "python", release.TRIAL, cwd=tmp_path).stdout)
    assert (trial["version"], trial["failures"]) == (dtsa_bench.__version__, [])
    (tmp_path / "here").mkdir()
    here = run(sys.executable, "-c", DIGEST, cwd=tmp_path / "here", PYTHONPATH=str(release.TRIAL.parent)).stdout
    assert trial["digest"] == here.strip()
    where = run(installed / "python", "-c", "import dtsa; print(dtsa.__file__)", cwd=tmp_path).stdout
    assert where.startswith(str(installed.parent))
    for words in (["demo"], ["relay", "relay.yaml"], ["replay", "a"], ["fly", "--out", "a"]):
        error = run(installed / "dtsa", *words, cwd=tmp_path, code=2).stderr
        assert "is missing: source an installation of ROS 2" in error
        assert error.count("\n") == 1
    assert not (tmp_path / "runs").exists()
    error = run(installed / "dtsa", "view", cwd=tmp_path, code=2).stderr
    assert error.startswith("dtsa: error: the Python package dtsa_msgs is missing: source an installation of ROS 2")
    assert error.count("\n") == 1


@pytest.mark.slow
def test_colcon_builds_the_packages_of_the_workspace(tmp_path: Path) -> None:
    """All but the messages, which take minutes with the type supports of C++; as `colcon build` finds them here."""
    ignore = shutil.ignore_patterns("__pycache__", "*.so", "*.egg-info", "build", "test")
    shutil.copytree(checkout.ROOT / "src", tmp_path / "src", ignore=ignore, symlinks=True)
    shutil.copy(checkout.ROOT / "pyproject.toml", tmp_path)
    (tmp_path / "install/dtsa_msgs/share/dtsa_msgs").mkdir(parents=True)
    (tmp_path / "install/dtsa_msgs/share/dtsa_msgs/package.sh").touch()
    colcon, more = Path(sys.executable).with_name("colcon"), {"AMENT_PREFIX_PATH": sys.prefix, "CFLAGS": "-O0"}
    listed = run(colcon, "list", "--names-only", cwd=tmp_path).stdout.split()
    assert sorted(listed) == ["dtsa_agent", "dtsa_bench", "dtsa_channel_sim", "dtsa_msgs"]
    run(colcon, "build", "--packages-skip", "dtsa_msgs", cwd=tmp_path, **more)
    made = {str(path.relative_to(tmp_path / "install")) for path in (tmp_path / "install").glob("*/lib/dtsa_*/*")}
    assert {"dtsa_agent/lib/dtsa_agent/agent", "dtsa_channel_sim/lib/dtsa_channel_sim/channel"} <= made
    assert len(made) == 9
    assert (tmp_path / "install/dtsa_bench/share/dtsa_bench/launch/swarm_launch.py").exists()
    paths = os.pathsep.join(map(str, (tmp_path / "install").glob("dtsa_*/lib/python3*/site-packages")))
    program = "import dtsa_agent.core._kernel as kernel; print(kernel.__file__)"
    assert str(tmp_path) in run(sys.executable, "-c", program, cwd=tmp_path, PYTHONPATH=paths).stdout
    command = tmp_path / "install/dtsa_bench/lib/dtsa_bench/dtsa"
    assert run(command, "--version", cwd=tmp_path, PYTHONPATH=paths).stdout == f"dtsa {dtsa_bench.__version__}\n"


def test_release_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(release, "python", lambda version: "" if version == "3.12" else f"python{version}")
    monkeypatch.setattr(release.shutil, "which", lambda name: None)
    with pytest.raises(ConfigError, match=r"without 3.12, aarch64'; .* or --skip 3.12 --skip aarch64$"):
        release.ReleaseCommand().run(argparse.Namespace(skip=[], out="dist"))
