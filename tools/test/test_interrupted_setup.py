"""A set-up that is interrupted or killed at any moment: the same command again goes on and ends well."""

from __future__ import annotations

import csv
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tool_helpers import checkout

from machine import layout, leftovers, main, prepare, processes, wheels, workspace

__all__ = ["checkout"]  # a fixture
SOME = ("setuptools", "wheel", "numpy", "empy")  # of those that every machine installs: its wheels are in the store
INSTALL = """
import sys; sys.path.insert(0, sys.argv[1])
from machine import prepare, wheels
try:
    with prepare.lock():
        if not wheels.has_venv(): wheels.make_venv()
        wheels.note_interruption(set())
        wheels.install(wheels.missing_sets(set()))
except KeyboardInterrupt:
    sys.exit(130)
"""

pytestmark = pytest.mark.skipif(layout.has_ros_installation(), reason="the wheels of ROS are not used here")


@pytest.fixture
def small(checkout: Path) -> Path:
    """An empty checkout whose sets have few packages, with the tools in it."""
    shutil.copytree(Path(__file__).resolve().parents[2] / "tools", checkout / "tools")
    pins = [*wheels.pinned("ros"), *wheels.pinned("runtime")]
    lines = [next(pin for pin in pins if pin.split("==")[0] == name) for name in SOME]
    (layout.REQUIREMENTS / "ros.txt").write_text("\n".join(lines[:2]) + "\n")
    (layout.REQUIREMENTS / "runtime.txt").write_text("\n".join(lines[2:]) + "\n")
    return checkout


def start(place: Path) -> subprocess.Popen[bytes]:
    """Begin to install, in a process group of its own."""
    command = [sys.executable, "-I", "-S", "-c", INSTALL, str(place / "tools")]
    return subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL)


def broken() -> list[str]:
    """What is not as a set-up leaves it that nobody interrupted."""
    site = layout.site_packages()
    found = [str(path) for path in layout.VENV.rglob("~*")]
    listed = {info.name.removesuffix(".dist-info").replace("-", "=="): info for info in leftovers.infos()}
    for pin in [*wheels.pinned("ros"), *wheels.pinned("runtime")]:
        record = layout.read(listed[pin] / "RECORD") if pin in listed else ""
        rows = list(csv.reader(record.splitlines()))
        found += [pin] * (not rows)
        found += [path for path, _, size in rows if size and (site / path).stat().st_size != int(size)]
        found += [path for path, *_ in rows if not (site / path).exists()]
    names = [leftovers.name_of(info) for info in leftovers.infos()]
    found += wheels.missing_sets(set())
    return found + [name for name in names if names.count(name) > 1]


def ends_well(place: Path) -> None:
    assert start(place).wait(timeout=120) == 0
    assert broken() == []
    program = "import setuptools, wheel, numpy, em"
    assert subprocess.run([layout.PYTHON, "-c", program], check=False).returncode == 0


def half_swapped(name: str) -> None:
    """Leave a package as Ctrl-C does in the midst of its swap: moved away in part, the rest without a list."""
    (info,) = layout.site_packages().glob(f"{name}-*.dist-info")
    info.rename(info.with_name(f"~{info.name[1:]}"))
    (layout.site_packages() / name / "__init__.py").unlink()
    shutil.copytree(layout.site_packages() / name, layout.site_packages() / f"~{name[1:]}")
    shutil.copytree(info.with_name(f"~{info.name[1:]}"), info, ignore=shutil.ignore_patterns("RECORD"))
    (layout.site_packages() / name / "of_an_older_version.py").touch()
    with (info.with_name(f"~{info.name[1:]}") / "RECORD").open("a") as record:
        record.write(f"{name}/of_an_older_version.py,,\n")
    (layout.VENV / "~in").mkdir()


def test_a_half_swapped_package_is_healed_with_and_without_a_stamp(small: Path) -> None:
    ends_well(small)
    mine = layout.site_packages() / "of_a_user.py"
    mine.touch()
    for stamp in (wheels.UNFINISHED, ""):  # "": interrupted by a version that left no stamp
        half_swapped("setuptools")
        layout.write(layout.VENV_STAMPS / "ros", stamp)
        ends_well(small)
        assert not (layout.site_packages() / "setuptools" / "of_an_older_version.py").exists()
    assert mine.exists()  # the environment is mended, not made anew


def test_what_a_finished_set_has_stays_when_another_is_mended(small: Path) -> None:
    ends_well(small)
    shared = (layout.REQUIREMENTS / "runtime.txt").read_text()
    (layout.REQUIREMENTS / "test.txt").write_text(shared)
    (info,) = layout.site_packages().glob("numpy-*.dist-info")
    before = info.stat().st_ino
    layout.write(layout.VENV_STAMPS / "test", wheels.UNFINISHED)
    assert wheels.missing_sets(set()) == ["test"]  # any command mends it
    ends_well(small)
    assert info.stat().st_ino == before  # somebody may be flying with it


def test_interrupted_at_random_moments_it_goes_on(small: Path) -> None:
    """More of them, of whole set-ups with their build: `tools/dtsa soak setup`."""
    moments = random.Random("set-up")
    began = time.monotonic()
    ends_well(small)
    takes = time.monotonic() - began
    shutil.rmtree(layout.VENV)
    for number in (signal.SIGINT, signal.SIGKILL):
        process = start(small)
        time.sleep(moments.uniform(0.0, takes))
        os.killpg(process.pid, number)
        process.wait(timeout=60)
        ends_well(small)


def test_ctrl_c_at_the_very_beginning_gives_no_traceback() -> None:
    command = [str(layout.ROOT / "tools" / "dtsa"), "--help"]
    for moment in range(20):
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
            time.sleep(0.005 * moment)
            process.send_signal(signal.SIGINT)
            assert process.stderr is not None
            assert "Traceback" not in process.stderr.read()
        assert process.returncode in (0, 130, -signal.SIGINT)


@pytest.mark.parametrize("before", [signal.SIG_DFL, signal.SIG_IGN])
def test_ctrl_c_is_ignored_where_it_was_before(before: signal.Handlers) -> None:
    program = "import signal; print(signal.getsignal(signal.SIGINT) is signal.SIG_IGN)"
    command = [str(layout.ROOT / "tools" / "dtsa"), "shell", "-c", f"python -c '{program}'"]
    ended = subprocess.run(
        command,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        timeout=120,
        preexec_fn=lambda: signal.signal(signal.SIGINT, before),
    )
    assert ended.stdout.strip() == str(before == signal.SIG_IGN)


def test_an_environment_that_was_being_made_or_removed_is_made_anew(checkout: Path) -> None:
    subprocess.run([sys.executable, "-m", "venv", layout.VENV], check=True)
    assert wheels.usable()  # somebody else's is taken over
    wheels.disown_venv()
    assert not wheels.has_venv()
    assert not wheels.usable()  # one that we began is not


def test_what_a_killed_set_up_left_running_is_ended_before_anything_else(checkout: Path) -> None:
    command = [sys.executable, "-c", "print(flush=True); input()"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    others = processes.mark() | {processes.MARK: "/another/checkout"}
    with (
        subprocess.Popen(command, env={**os.environ, **processes.mark()}, **pipes) as orphan,
        subprocess.Popen(command, env={**os.environ, **others}, **pipes) as stranger,
    ):
        for process in (orphan, stranger):
            assert process.stdout is not None
            process.stdout.readline()
        with prepare.lock():
            assert orphan.wait(timeout=30) == -signal.SIGKILL
            assert stranger.poll() is None
        stranger.communicate(b"\n", timeout=30)


def test_an_interrupted_build_begins_anew(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A library that a killed linker left half is younger than its sources; it must not count as built."""
    for package in workspace.PACKAGES:
        layout.write(layout.BUILD / package / "made", "")
        workspace.stamp(package)
    monkeypatch.setattr(workspace, "products", lambda package: True)
    monkeypatch.setattr(workspace, "colcon", lambda: "false")
    assert workspace.changed_packages() == []
    with pytest.raises(layout.SetupError):
        workspace.build(["dtsa_agent"])
    assert workspace.changed_packages() == ["dtsa_agent"]
    assert (layout.BUILD / "dtsa_agent" / "made").exists()
    with pytest.raises(layout.SetupError):
        workspace.build(["dtsa_agent"])
    assert not (layout.BUILD / "dtsa_agent").exists()


def test_an_interrupted_clean_leaves_nothing_that_counts(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for package in workspace.PACKAGES:
        workspace.stamp(package)
    layout.write(layout.PYTHON, "")
    layout.write(layout.VENV_STAMPS / "venv", wheels.venv_key())
    monkeypatch.setattr(workspace, "products", lambda package: True)
    assert wheels.has_venv()
    assert not workspace.changed_packages()

    def interrupted(directory: Path, **options: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", interrupted)
        with pytest.raises(KeyboardInterrupt):
            main.run_clean(["--all"])
    assert not wheels.has_venv()
    assert not wheels.usable()
    assert workspace.changed_packages() == list(workspace.PACKAGES)


def test_an_old_part_of_a_download_is_removed_from_the_store(tmp_path: Path) -> None:
    for name, age in ((".part-old", 2 * wheels.PART_AGE_S), (".part-young", 0.0)):
        (tmp_path / name).mkdir()
        os.utime(tmp_path / name, (time.time() - age,) * 2)
    wheels.remove_parts(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [".part-young"]
