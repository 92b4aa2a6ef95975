"""Integration: the package that `new-plugin` writes works as it is."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from dtsa_agent.core import ConfigError
from dtsa_bench.experiments.plugin_template import write_package


def test_the_package_installs_passes_its_test_and_flies(tmp_path: Path) -> None:
    target = tmp_path / "installed"
    simulated = ["simulate", "--agents", "4", "--policy", "my-policy", "--options", "my-policy.tdma_every=3"]
    files = write_package("my-policy", tmp_path / "package")
    assert {path.name for path in files} == {
        "README.md", "__init__.py", "pyproject.toml", "sweep.yaml", "test_policy.py",
    }  # fmt: skip
    assert not any("@" in path.read_text() for path in files)
    (tmp_path / "conftest.py").write_text("import no_such_module  # what a checkout's tests need, users may not have")
    (tmp_path / "pyproject.toml").write_text("[tool.pytest.ini_options]\nminversion = '1'\n")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-build-isolation"]
    subprocess.run([*pip, "--target", str(target), str(tmp_path / "package")], check=True, capture_output=True)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(target), *filter(None, sys.path)])}
    for words in (
        ["-m", "pytest", "-q", "-p", "no:cacheprovider", str(tmp_path / "package")],
        ["-m", "dtsa_bench", *simulated],
        ["-m", "dtsa_bench", "sweep", "--file", str(tmp_path / "package" / "sweep.yaml"), "--seeds", "1",
         "--set", "agents=6", "--set", "moving=2", "--set", "timeout_s=1", "--out", str(tmp_path / "runs")],
    ):  # fmt: skip
        ended = subprocess.run(
            [sys.executable, *words], env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=120
        )
        assert ended.returncode == 0, ended.stdout + ended.stderr


@pytest.mark.parametrize("name", ["", "My", "a b", "2fast", "a_b", "x" * 41, "../up", "lease", "genie-age", "for",
                                  "json", "concurrent", "numpy", "pytest", "agent", "channel-sim"])  # fmt: skip
def test_names_that_cannot_be_used_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="NAME"):
        write_package(name, tmp_path / "package")
    assert not (tmp_path / "package").exists()


def test_a_name_without_a_hyphen_is_found_beside_its_directory(tmp_path: Path) -> None:
    """As `pip install -e` does it: the directory of the same name must not hide the package."""
    write_package("myrule", tmp_path / "myrule")
    site = tmp_path / "site"
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-build-isolation"]
    command = [*pip, "--prefix", str(site), "-e", str(tmp_path / "myrule")]
    subprocess.run(command, check=True, capture_output=True, cwd=tmp_path)
    text = f"""
import pathlib, site
for directory in pathlib.Path({str(site)!r}).glob("**/*-packages"):
    site.addsitedir(str(directory))
from dtsa_bench.commands.cli import main
raise SystemExit(main(["simulate", "--agents", "4", "--policy", "myrule", "--options", "myrule.tdma_every=3"]))
"""
    ended = subprocess.run([sys.executable, "-c", text], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 0, ended.stderr


def test_what_is_there_stays(tmp_path: Path) -> None:
    (tmp_path / "package" / "src" / "my_policy").mkdir(parents=True)
    with pytest.raises(ConfigError, match="does not exist yet"):
        write_package("my-policy", tmp_path / "package")
