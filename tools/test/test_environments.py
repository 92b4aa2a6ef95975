"""Integration: environments of a checkout: one for each machine and Python, none taken away that is in use."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tool_helpers import checkout

from machine import checks, layout, main, prepare, processes, wheels

__all__ = ["checkout"]  # a fixture


def pretend_environment(directory: Path, stamp: str) -> None:
    """Make the files by which a virtual environment is recognised.

    :param stamp: version of Python and kind.
    """
    python = directory / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.symlink_to(sys.executable)
    layout.write(directory / ".dtsa" / "venv", f"{stamp} {directory.parent}")


def test_each_kind_of_machine_has_an_environment_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = layout.python_version()
    monkeypatch.delenv("ROS_DISTRO", raising=False)
    assert layout.suffix(tmp_path) == ""
    pretend_environment(tmp_path / ".venv", f"{here} wheels")
    assert layout.suffix(tmp_path) == ""
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    assert layout.suffix(tmp_path) == "-jazzy"
    pretend_environment(tmp_path / ".venv-jazzy", "3.9 system")
    assert layout.suffix(tmp_path) == f"-jazzy-{here}"


@pytest.mark.parametrize("stamp", ["3.9 wheels", f"{layout.python_version()} system"])
def test_an_environment_of_another_kind_is_left_alone(
    stamp: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("ROS_DISTRO", raising=False)
    pretend_environment(tmp_path / ".venv", stamp)
    assert layout.suffix(tmp_path) == f"-{layout.python_version()}"
    (tmp_path / ".venv" / "bin" / "python").unlink()  # the interpreter is gone: of no use to anybody
    assert layout.suffix(tmp_path) == ""


def test_an_environment_that_somebody_else_made_is_recognised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_DISTRO", raising=False)
    pretend_environment(tmp_path / ".venv", "")
    configuration = tmp_path / ".venv" / "pyvenv.cfg"
    configuration.write_text(f"home = /usr/bin\nversion = {layout.python_version()}.1\n")
    assert layout.suffix(tmp_path) == ""
    configuration.write_text("home = /usr/bin\nversion_info = 3.9.2.final.0\n")
    assert layout.suffix(tmp_path) == f"-{layout.python_version()}"


@pytest.fixture
def running(checkout: Path) -> Iterator[int]:
    """Id of a process that runs from the checkout's virtual environment."""
    layout.PYTHON.parent.mkdir(parents=True)
    layout.PYTHON.symlink_to(sys.executable)
    program = [str(layout.PYTHON), "-c", "print(flush=True); input()"]
    process = subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.readline()
    yield process.pid
    process.communicate(b"\n", timeout=30)


@pytest.mark.parametrize("remove", [wheels.make_venv, lambda: main.run_clean(["--all"])])
def test_an_environment_in_use_is_never_removed(running: int, remove: Callable[[], object]) -> None:
    with pytest.raises(layout.SetupError, match=rf"in use by process {running}; .*nothing was removed") as raised:
        remove()
    assert raised.value.code == 2
    assert layout.PYTHON.exists()


def test_a_waiting_set_up_does_not_use_the_environment(checkout: Path) -> None:
    layout.PYTHON.parent.mkdir(parents=True)
    layout.PYTHON.symlink_to(sys.executable)
    command = [str(layout.PYTHON), "-I", "-S", "-c", "print(flush=True); input()"]  # as tools/dtsa starts itself
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        assert processes.users_of([layout.VENV]) == []
        process.communicate(b"\n", timeout=30)


def test_what_is_missing_is_said_before_anything_is_removed(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    monkeypatch.setattr(checks, "check", lambda: None)
    monkeypatch.setattr(wheels, "system_distributions", lambda python: {"numpy", "pandas", "pyyaml"})
    kept = layout.VENV / "kept"
    kept.parent.mkdir()
    kept.touch()
    with pytest.raises(layout.SetupError, match=r"sudo apt install python3-matplotlib$"):
        prepare.prepare(set())
    assert kept.exists()
