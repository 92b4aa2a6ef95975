"""Integration: the set-up of a checkout and the start of its commands."""

from __future__ import annotations

import importlib.metadata
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from xml.etree import ElementTree

import pytest
from dtsa_dev.registry import COMMANDS as DEVELOPERS

import checkout
import dtsa_bench
from dtsa_bench.commands.registry import COMMANDS

DTSA = checkout.ROOT / "tools/dtsa"
UV_CACHE = os.environ.get("UV_CACHE_DIR") or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "uv"
NO_FURTHER = "raise RuntimeError('a module that is not meant')\n"


def call(*words: str, tool: Path = DTSA, cwd: Path | None = None, **more: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, **more}
    return subprocess.run([tool, *words], cwd=cwd, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture
def empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the checkout in which nothing is set up, seen by the functions under test."""
    for name in ("pyproject.toml", "requirements.txt", "README.md", "LICENSE", "NOTICE", "MANIFEST.in"):
        shutil.copy(checkout.ROOT / name, tmp_path)
    ignore = shutil.ignore_patterns("__pycache__", "*.so", "*.egg-info", "test", "build")
    for name in ("src", "tools"):
        shutil.copytree(checkout.ROOT / name, tmp_path / name, ignore=ignore, symlinks=True)
    for name, place in (("ROOT", tmp_path), ("VENV", tmp_path / ".venv"), ("LOGS", tmp_path / ".dtsa")):
        monkeypatch.setattr(checkout, name, place)
    return tmp_path


def test_help_and_version_need_nothing() -> None:
    assert call("--version").stdout == f"dtsa {dtsa_bench.__version__}\n"
    result = call("--help")
    listed = {line.split()[0] for line in result.stdout.splitlines() if line.startswith("  ")}
    assert listed == {*COMMANDS, *DEVELOPERS, *checkout.COMMANDS}


@pytest.mark.parametrize("command", ["test", "clean", "shell", "setup"])
@pytest.mark.parametrize("word", ["--help", "-h"])
def test_help_of_a_command_does_nothing_else(command, word, monkeypatch, capsys):
    monkeypatch.delattr(checkout, "prepare")
    monkeypatch.delattr(checkout, "lock")
    assert checkout.main([command, word]) == 0
    assert capsys.readouterr().out.startswith(f"usage: tools/dtsa {command}")


@pytest.mark.parametrize("words", [["nonsense"], ["setup", "--extra", "nonsense"], ["clean", "nonsense"]])
def test_wrong_words_are_one_line_and_exit_2(words: list[str]) -> None:
    result = call(*words)
    assert result.returncode == 2
    assert "got 'nonsense'; allowed: " in result.stderr
    assert result.stderr.count("\n") == 1


def test_the_version_is_the_same_everywhere_and_all_that_is_wanted_is_pinned() -> None:
    found = {path: ElementTree.parse(path).findtext("version") for path in checkout.ROOT.glob("src/*/package.xml")}
    assert len(found) == 4
    text = (checkout.ROOT / "CITATION.cff").read_text(encoding="utf-8")
    versions = {
        *found.values(), *re.findall(r"^version: (.*)$", text, re.MULTILINE), importlib.metadata.version("dtsa"),
    }  # fmt: skip
    assert versions == {dtsa_bench.__version__}
    pins = re.findall(r"(?m)^(\S+)==(\S+)(.*)((?:\n +--hash.*)*)", (checkout.ROOT / "requirements.txt").read_text())
    assert all("--hash=sha256:" in hashes for *_, hashes in pins)
    names = {name.partition("[")[0] for name, *_ in pins}
    wanted = re.findall(
        r'^    "([\w-]+)', (checkout.ROOT / "pyproject.toml").read_text().split("[tool.")[0], re.MULTILINE
    )
    assert len(wanted) > 40
    assert set(wanted) - {"Development", "Intended", "Operating", "Programming", "Topic"} <= names


def test_a_python_that_is_too_old_is_refused(tmp_path: Path) -> None:
    (tmp_path / "python3").write_text("#!/bin/sh\n[ $1 = -V ] && echo Python 3.9.1\nexit 1\n")
    (tmp_path / "python3").chmod(0o755)
    result = call("setup", DTSA_PYTHON=str(tmp_path / "python3"))
    assert result.returncode == 2
    assert "got Python 3.9.1; allowed: 3.10 to 3.13" in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("missing", ["cc", "c++"])
def test_a_missing_compiler_is_named(missing: str, empty: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (empty / "bin").mkdir()
    for name in {"sh", "cc", "c++"} - {missing}:
        (empty / "bin" / name).symlink_to(shutil.which(name) or "/nowhere")
    monkeypatch.setattr(os, "environ", {"PATH": str(empty / "bin")})
    with pytest.raises(checkout.SetupError, match=r"^missing: a C.*: sudo apt install (gcc|g\+\+)") as raised:
        checkout.check_system()
    assert raised.value.code == 2


def test_missing_headers_and_venv_are_named(empty: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkout.sysconfig, "get_path", lambda name: str(empty))
    monkeypatch.setattr(checkout.importlib.util, "find_spec", lambda name: None)
    version = checkout.VERSION
    with pytest.raises(
        checkout.SetupError, match=rf"Python's headers.* apt install python{version}-venv python{version}-dev$"
    ):
        checkout.check_system()


def test_the_environment_of_others_is_left_alone_and_another_python_has_its_own(empty: Path) -> None:
    (empty / ".venv/bin").mkdir(parents=True)
    (empty / ".venv/bin/python").symlink_to("somebody/else/python3")
    result = call("simulate", tool=empty / "tools/dtsa")
    assert result.returncode == 2
    assert ".venv was not made by tools/dtsa" in result.stderr
    assert result.stderr.count("\n") == 1
    assert call("clean", "--all", tool=empty / "tools/dtsa").returncode == 0
    assert (empty / ".venv/bin/python").is_symlink()
    program = "import checkout; print(checkout.VENV.name)"
    environment = {**os.environ, "PYTHONPATH": str(DTSA.parent), "DTSA_PYTHON": sys.executable}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == f".venv-{checkout.VERSION}\n"


def test_what_is_made_again_when_a_file_changes(empty: Path) -> None:
    before, messages = checkout.keys()
    (empty / "src/dtsa_bench/dtsa_bench/__main__.py").write_text("# Python takes effect at once")
    with (empty / "pyproject.toml").open("a") as file:
        file.write("# a linter's settings\n")
    assert checkout.keys() == (before, messages)
    next(empty.glob("src/dtsa_agent/dtsa_agent/libdtsa/*.h")).write_text("/* new */")
    (empty / "src/dtsa_agent/dtsa_agent/core/_kernel.abi3.so").touch()
    changed, same = checkout.keys()
    assert (changed != before, same) == (True, messages)
    (empty / "src/dtsa_agent/dtsa_agent/core/_kernel.abi3.so").unlink()
    (empty / "src/dtsa_msgs/msg/New.msg").write_text("uint8 x\n")
    assert checkout.keys()[0] not in (before, changed)
    assert checkout.keys()[1] != messages


@pytest.mark.parametrize(("lines", "reason"), [
    (("compiling", "fatal: full"), "fatal: full"), (("warning: failed to link", "fatal: full"), "fatal: full"),
    (("error: failed to install", "cause: No space left on device (os error 28)"), "cause: No space .*28.*"),
])  # fmt: skip
def test_a_failed_step_is_named_with_its_reason_and_log(lines, reason, empty, capsys):
    with checkout.lock(), pytest.raises(checkout.SetupError, match=rf"'build' failed: {reason}; log: .*build\.log"):
        checkout.run("build", "all", ["sh", "-c", 'printf "%s\n" "$@"; exit 3', "sh", *lines])
    assert capsys.readouterr().err == "dtsa: all ...\ndtsa: all ... failed\n"


def test_what_a_killed_set_up_left_running_is_waited_for(empty: Path) -> None:
    """The lock is inherited by what the steps start."""
    start = "import sys, checkout; from pathlib import Path; checkout.LOGS = Path(sys.argv[1])\nwith checkout.lock(): "
    environment = {**os.environ, "PYTHONPATH": str(DTSA.parent)}
    words = [sys.executable, "-c", start + "checkout.run('a', 'a', ['sleep', '2'])", str(empty)]
    with subprocess.Popen(words, env=environment, stderr=subprocess.PIPE) as killed:
        assert killed.stderr is not None
        killed.stderr.readline()
        time.sleep(0.2)
        killed.kill()
    words = [sys.executable, "-c", start + "print('mine')", str(empty)]
    other = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
    assert (other.stdout, other.stderr) == ("mine\n", "dtsa: waiting for another set-up of this checkout ...\n")


def test_what_is_cached_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def interrupted(place: Path) -> None:
        place.mkdir()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        checkout.cached("messages", interrupted)
    assert list((tmp_path / "dtsa").iterdir()) == []
    assert checkout.cached("messages", Path.mkdir) == tmp_path / "dtsa/messages"
    assert checkout.cached("messages", interrupted).is_dir()


def test_uv_has_the_package_index_of_pip(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    listed = "global.index-url='https://mirror.example/simple'\\nglobal.find-links='/a\\n/b'\\n:env:.index-url='file:///c'\\n"
    for name, text in (("uv", "uv 0.9.0"), ("python3", listed.replace("\\n", "\n").replace("/a\n", "/a\\n"))):
        (tmp_path / name).write_text(f"#!/bin/sh\ncat <<'X'\n{text}\nX\n")
        (tmp_path / name).chmod(0o755)
    environment = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "UV_HTTP_TIMEOUT": "7"}
    monkeypatch.setattr(os, "environ", environment)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python3"))
    assert checkout.find_uv() == str(tmp_path / "uv")
    assert (environment["UV_DEFAULT_INDEX"], environment["UV_FIND_LINKS"]) == ("file:///c", "/a /b")
    assert environment["UV_HTTP_TIMEOUT"] == "7"


def test_a_folder_that_cannot_be_made_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    result = call("shell", "-c", "echo $ROS_LOG_DIR $XDG_CACHE_HOME; python -c 'import matplotlib.pyplot'",
                  ROS_LOG_DIR="/proc/nothing/log", XDG_CACHE_HOME="/dev/null/cache")  # fmt: skip
    assert result.returncode == 0
    assert [os.access(path, os.W_OK) for path in result.stdout.split()] == [True, True]
    assert result.stderr.count("\n") == 2
    assert "ROS_LOG_DIR is" in result.stderr
    result = call("shell", "-c", "echo $ROS_LOG_DIR", ROS_LOG_DIR="~nobody.of.that.name/log")
    assert (result.returncode, os.access(result.stdout.strip(), os.W_OK)) == (0, True)


def test_a_command_whose_standard_output_is_closed_does_its_work(tmp_path: Path) -> None:
    words = ["sh", "-c", '"$@" >&-', "sh", DTSA, "simulate", "--agents", "2", "--timeout-s", "1", "--out"]
    result = subprocess.run([*words, tmp_path / "a"], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    assert (tmp_path / "a/summary.json").exists()


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    for name in ("numpy", "yaml", "dtsa_bench", "rclpy"):
        (tmp_path / f"{name}.py").write_text(NO_FURTHER)
    return tmp_path


def test_modules_in_the_current_folder_or_of_another_ros_are_not_seen(foreign: Path) -> None:
    words = ("simulate", "--agents", "4", "--timeout-s", "2")
    assert (
        call(*words, PYTHONPATH=str(foreign), ROS_DISTRO="humble", AMENT_PREFIX_PATH="/opt/ros/humble").returncode == 0
    )
    result = call(*words, cwd=foreign)
    assert result.returncode == 0, result.stderr


@pytest.mark.slow
def test_a_set_up_that_is_interrupted_at_any_moment_is_finished_by_the_same_command(tmp_path, empty):
    """From nothing, in a path that is neither ASCII nor free of spaces; packages are in uv's cache."""
    place = tmp_path / "Prüfung von außen"
    place.mkdir()
    for entry in [entry for entry in empty.iterdir() if entry != place]:
        entry.rename(place / entry.name)
    more = {"XDG_CACHE_HOME": str(tmp_path / "cache"), "UV_CACHE_DIR": str(UV_CACHE), "CFLAGS": "-O0"}
    environment = {**os.environ, **more}
    moments, command = random.Random("set-up"), [place / "tools/dtsa", "setup"]
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        with subprocess.Popen(
            command, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True
        ) as process:
            time.sleep(moments.uniform(0.1, 12.0))
            os.killpg(process.pid, number)
            assert process.stderr is not None
            assert "Traceback" not in process.stderr.read()
        # -SIGINT: Python had not come to its own handler yet; a shell says 130, too.
        assert process.returncode in (130, -signal.SIGINT, -signal.SIGKILL)
    result = call("setup", tool=command[0], **more)
    assert result.returncode == 0, result.stderr
    assert "ready" in result.stderr
    assert call("setup", tool=command[0], **more).stderr == "dtsa: ready\n"
    flight = call("fly", "--agents", "2", "--timeout-s", "1", "--out", "a", tool=command[0], cwd=place, **more)
    assert flight.returncode == 0, flight.stderr
    nodes = call("ros2", "pkg", "executables", tool=command[0], **more).stdout
    assert "dtsa_agent agent\n" in nodes
    # What cannot be installed is not asked for again, and what cannot be copied is a line.
    offline = {**more, "UV_OFFLINE": "1"}
    wanted = call("setup", "--extra", "learning", tool=command[0], **{**offline, "UV_CACHE_DIR": str(tmp_path / "no")})
    assert (wanted.returncode, "step 'packages' failed" in wanted.stderr) == (1, True)
    result = call("shell", "-c", "python -c 'import pettingzoo'", tool=command[0], **offline)
    assert "ModuleNotFoundError" in result.stderr
    backend = place / "tools/package/backend.py"
    backend.write_text(f"{backend.read_text()}# changed\n")
    messages = next((tmp_path / "cache/dtsa").glob("messages-*"))
    messages.rename(tmp_path / "aside")
    messages.touch()
    result = call("setup", tool=command[0], **offline)
    assert (result.returncode, "step 'package' failed" in result.stderr) == (1, True)
    assert "Traceback" not in result.stderr


def test_ctrl_c_in_a_soak_waits_for_the_tests_to_end_what_they_started(tmp_path: Path) -> None:
    (tmp_path / "slow_end.py").write_text(
        "import pathlib, sys, time\n"
        "def pytest_sessionstart():\n    print('begun', flush=True)\n    time.sleep(60)\n"
        f"def pytest_unconfigure():\n    time.sleep(1)\n    pathlib.Path({str(tmp_path / 'ended')!r}).touch()\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "PYTEST_ADDOPTS": "-s -p slow_end"}
    with subprocess.Popen(
        [sys.executable, "-m", "dtsa_dev", "soak", "statements"],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, start_new_session=True,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert any(line == "begun\n" for line in process.stdout)
        os.killpg(process.pid, signal.SIGINT)
        process.wait(60)
    assert (tmp_path / "ended").exists()
