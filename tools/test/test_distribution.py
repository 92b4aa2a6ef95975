"""Integration: the distribution `dtsa`: built, installed without a workspace, and used from there."""

from __future__ import annotations

import configparser
import json
import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest
from dtsa_dev.release import headers, parts
from dtsa_dev.release.running import clean_environment

import dtsa_bench
from dtsa_agent.core.errors import ConfigError
from dtsa_bench.commands import cli
from machine import layout

BACKEND = "import sys; sys.path.insert(0, sys.argv[1]); import backend; backend.build_{}(sys.argv[2])"
NEEDS_ROS = "dtsa: error: the Python package rclpy is missing: source an installation of ROS 2 Jazzy, "
# What the tests' environment has of ROS must not be found from the fresh one.
HIDDEN = "import sys\nfor name in ('rclpy', 'ament_index_python', 'dtsa_msgs'):\n    sys.modules[name] = None\n"


def run(*words: str | Path, cwd: Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        list(map(str, words)),
        cwd=cwd,
        env=clean_environment(),
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-c", BACKEND.format("wheel"), layout.ROOT / "tools" / "package", place, cwd=place)
    return next(place.glob("*.whl"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The programs of a fresh environment; what `dtsa` depends on is that of the tests."""
    place = tmp_path_factory.mktemp("environment")
    run(sys.executable, "-m", "venv", "--without-pip", place, cwd=place)
    program = place / "bin" / "python"
    run(sys.executable, "-m", "pip", "--python", program, "install", "-q", "--no-deps", "--no-index", wheel, cwd=place)
    site = Path(run(program, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=place).stdout.strip())
    (site / "others.pth").write_text(f"{sysconfig.get_path('purelib')}\n")
    (site / "sitecustomize.py").write_text(HIDDEN)
    return place / "bin"


def test_names_and_notices_of_the_wheel(wheel: Path) -> None:
    assert wheel.name.startswith(f"dtsa-{dtsa_bench.__version__}-cp310-abi3-linux_")
    assert wheel.stat().st_size < 3_000_000
    with zipfile.ZipFile(wheel) as file:
        names = file.namelist()
        info = f"dtsa-{dtsa_bench.__version__}.dist-info"
        said = Parser().parsestr(file.read(f"{info}/METADATA").decode())
        points = configparser.ConfigParser()
        points.read_string(file.read(f"{info}/entry_points.txt").decode())
    assert list(points["console_scripts"]) == ["dtsa"]
    assert len(points["dtsa.policies"]) == 14
    assert said["License-Expression"] == "Apache-2.0"
    notices = {name.rpartition("/")[2] for name in names if name.startswith(f"{info}/licenses/")}
    assert notices == {"LICENSE", "NOTICE"}
    extras = {"tables", "view", "cluster", "learning", "crazyflie", "serial", "all"}
    assert set(said.get_all("Provides-Extra", [])) == extras
    compiled = {name.rpartition("/")[2] for name in names if name.endswith(".so")}
    assert "_kernel.abi3.so" in compiled
    assert all(name.endswith(".abi3.so") for name in compiled)
    assert "dtsa_bench/recordings/bag/messages/Slot.msg" in names
    assert not [name for name in names if "/test/" in name or name.startswith(("test", "machine", "dtsa_dev"))]


def test_source_distribution_has_all_that_the_wheel_is_made_of(tmp_path: Path) -> None:
    run(sys.executable, "-c", BACKEND.format("sdist"), layout.ROOT / "tools" / "package", tmp_path, cwd=tmp_path)
    with tarfile.open(next(tmp_path.glob("*.tar.gz"))) as file:
        names = {name.partition("/")[2] for name in file.getnames()}
    assert {"pyproject.toml", "setup.py", "LICENSE", "NOTICE", "README.md", "CHANGELOG.md", "CITATION.cff"} <= names
    sources = {
        path.relative_to(layout.ROOT).as_posix()
        for path in (layout.SOURCES / "dtsa_agent" / "dtsa_agent").rglob("*.[ch]")
    }
    assert sources <= names


def test_works_without_a_workspace(installed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dtsa = installed / "dtsa"
    assert run(dtsa, "--version", cwd=tmp_path).stdout == f"dtsa {dtsa_bench.__version__}\n"
    where = run(installed / "python", "-c", "import dtsa; print(dtsa.__file__)", cwd=tmp_path).stdout
    assert where.startswith(str(installed.parent))
    plain = ("simulate", "--agents", "4", "--timeout-s", "3", "--json")
    there = json.loads(run(dtsa, *plain, "--picture", "first.png", cwd=tmp_path).stdout)
    assert (tmp_path / "first.png").stat().st_size > 10_000
    assert cli.main(plain) == 0
    here = json.loads(capsys.readouterr().out)
    for own in (there, here):
        del own["wall_time_s"], own["realtime_factor"]
    assert there == here


def test_says_in_one_line_what_needs_ros(installed: Path, tmp_path: Path) -> None:
    for words in (("demo",), ("fly", "--out", "flown")):
        error = run(installed / "dtsa", *words, cwd=tmp_path, code=2).stderr
        assert error.startswith(NEEDS_ROS), words
        assert error.count("\n") == 1
    error = run(installed / "dtsa", "view", cwd=tmp_path, code=2).stderr
    assert error.startswith(NEEDS_ROS.replace("rclpy", "dtsa_msgs"))


def test_agents_fly_on_the_loopback_interface_and_their_flight_is_kept(installed: Path, tmp_path: Path) -> None:
    dtsa = str(installed / "dtsa")
    group = f"239.68.84.83:{20_000 + os.getpid() % 20_000}"
    air = ["--agents", "2", "--interface", "lo", "--group", group, "--no-seal", "--slot-ms", "50"]
    agents = [
        subprocess.Popen(
            [dtsa, "agent", "--id", str(k), *air, "--duration-s", "6", "--out", f"cf{k}"],
            cwd=tmp_path, env=clean_environment(), stdout=subprocess.DEVNULL,
        )
        for k in (1, 2)
    ]  # fmt: skip
    assert [agent.wait(60) for agent in agents] == [0, 0]
    run(dtsa, "merge", "cf1", "cf2", "--out", "flight", cwd=tmp_path)
    assert "ok" in run(dtsa, "verify", "flight", cwd=tmp_path).stdout.lower()


def test_what_can_be_cited_has_the_version() -> None:
    text = (layout.ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: (.*)$", text, re.MULTILINE) == [dtsa_bench.__version__]


def test_release_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match=r"skip: got '3\.9'; allowed: 3\.10, 3\.11, 3\.12, 3\.13, aarch64"):
        parts.find({"3.9"})
    monkeypatch.setattr(parts.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(parts, "interpreter", lambda version: None if version == "3.12" else f"python{version}")
    monkeypatch.setattr(parts.shutil, "which", lambda name: None if name == parts.QEMU else name)
    with pytest.raises(ConfigError) as raised:
        parts.find(())
    assert "no Python 3.12 with venv; no qemu-aarch64-static (Debian: apt install qemu-user-static)" in str(
        raised.value
    )
    assert "or --skip 3.12 --skip aarch64" in str(raised.value)
    pythons, aarch64 = parts.find({"3.12", "aarch64"})
    assert (list(pythons), aarch64) == (["3.10", "3.11", "3.13"], False)


def test_sizes_in_the_headers_are_true_here(tmp_path: Path) -> None:
    source = tmp_path / "check.c"
    source.write_text(headers.check_source())
    run("cc", "-std=c11", f"-I{headers.include()}", "-c", source, "-o", tmp_path / "check.o", cwd=tmp_path)
    source.write_text(source.read_text().replace("sizeof(long) == 8", "sizeof(long) == 4"))
    run("cc", "-std=c11", f"-I{headers.include()}", "-c", source, "-o", tmp_path / "check.o", cwd=tmp_path, code=1)
