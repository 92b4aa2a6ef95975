"""Integration: the set-up of a machine: what it asks for, remembers and rebuilds, and the `ros2` stand-in."""

from __future__ import annotations

import fcntl
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from xml.etree import ElementTree

import pytest
from tool_helpers import checkout

import dtsa_bench
from machine import checks, cmake_paths, layout, main, prepare, progress, wheels, workspace

__all__ = ["checkout"]  # a fixture
DTSA = layout.ROOT / "tools" / "dtsa"


def call(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(DTSA), *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
        check=False,
    )


def pretend_built(package: str) -> None:
    """Make the files by which a finished build is recognised."""
    share = layout.INSTALL / package / "share" / package
    packages = layout.INSTALL / package / "lib" / "python3" / "site-packages"
    for directory in (layout.BUILD / package, share, packages):
        directory.mkdir(parents=True)
    (share / "package.sh").touch()
    (packages / f"{package}.egg-link").touch()
    if package == "dtsa_agent":
        for path in workspace.compiled():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
    workspace.stamp(package)


def test_only_changed_packages_are_built(checkout: Path) -> None:
    assert workspace.changed_packages() == list(workspace.PACKAGES)
    for package in workspace.PACKAGES:
        pretend_built(package)
    assert workspace.changed_packages() == []

    source = checkout / "src" / "dtsa_bench" / "dtsa_bench" / "entry.py"
    source.write_text(source.read_text() + "\n")
    assert workspace.changed_packages() == []  # Python is linked, not copied

    message = checkout / "src" / "dtsa_msgs" / "msg" / "Slot.msg"
    os.utime(message, (1, 1))
    assert workspace.changed_packages() == []  # same content
    message.write_text(message.read_text() + "uint8 more\n")
    assert workspace.changed_packages() == ["dtsa_msgs"]

    next((checkout / "src" / "dtsa_agent" / "dtsa_agent" / "libdtsa").glob("*.h")).write_text("/* new */")
    (checkout / "src" / "dtsa_bench" / "setup.py").write_text("# new")
    assert workspace.changed_packages() == ["dtsa_msgs", "dtsa_agent", "dtsa_bench"]


def test_a_new_or_removed_file_needs_a_build(checkout: Path) -> None:
    for package in workspace.PACKAGES:
        pretend_built(package)
    (checkout / "src" / "dtsa_msgs" / "msg" / "New.msg").write_text("uint8 x\n")
    (checkout / "src" / "dtsa_channel_sim" / "setup.cfg").unlink()
    assert workspace.changed_packages() == ["dtsa_msgs", "dtsa_channel_sim"]


def test_missing_products_need_a_build(checkout: Path) -> None:
    for package in workspace.PACKAGES:
        pretend_built(package)
    for_one_python = workspace.kernel().with_name("_kernel.cpython-311-x86_64-linux-gnu.so")
    for_one_python.touch()
    workspace.remove_kernel()
    assert not any(path.exists() for path in (for_one_python, *workspace.compiled()))
    shutil.rmtree(layout.BUILD / "dtsa_bench")
    # A plain `colcon build` copies instead of linking.
    next((layout.INSTALL / "dtsa_channel_sim").rglob("*.egg-link")).unlink()
    assert workspace.changed_packages() == ["dtsa_agent", "dtsa_channel_sim", "dtsa_bench"]


def test_sets_of_requirements_are_remembered(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    assert wheels.missing_sets({"cflib"}) == ["runtime", "cflib"]
    monkeypatch.delenv("ROS_DISTRO")
    assert wheels.missing_sets({"cflib"}) == ["ros", "runtime", "cflib"]
    for name in ("ros", "runtime", "cflib"):
        layout.write(layout.VENV_STAMPS / name, wheels.set_key(name))
    assert wheels.missing_sets(set()) == []
    (checkout / "requirements" / "cflib.txt").write_text("cflib==0.0.1\n")
    assert wheels.missing_sets(set()) == ["cflib"]  # installed before: kept up to date
    assert wheels.missing_sets({"test"}) == ["cflib", "test"]


def test_a_moved_checkout_gets_a_new_environment(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    layout.PYTHON.parent.mkdir(parents=True)
    layout.PYTHON.touch()
    layout.write(layout.VENV_STAMPS / "venv", wheels.venv_key())
    assert wheels.has_venv()
    monkeypatch.setattr(layout, "ROOT", checkout / "elsewhere")
    assert not wheels.has_venv()


@pytest.mark.parametrize(
    ("given", "wanted"), [("", "-j3"), ("-s", "-s -j3"), ("-j8", "-j8"), ("--jobs=8 -l4", "--jobs=8 -l4")]
)
def test_the_build_has_a_number_of_jobs_and_no_limit_of_the_load(
    given: str, wanted: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MAKEFLAGS", given)
    monkeypatch.delenv("CMAKE_BUILD_PARALLEL_LEVEL", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1, 2})
    environment = workspace.build_environment()
    assert environment["MAKEFLAGS"] == wanted
    assert environment["CMAKE_BUILD_PARALLEL_LEVEL"] == "3"
    if importlib.util.find_spec("colcon_cmake"):
        from colcon_cmake.task.cmake.build import CmakeBuildTask

        assert CmakeBuildTask._get_make_arguments(None, environment) == []  # colcon adds none of its own


def test_every_pinned_set_is_complete() -> None:
    """Each package that is asked for is pinned, for every supported Python, with one version each."""
    for source in layout.REQUIREMENTS.glob("*.in"):
        wanted = [line for line in source.read_text().splitlines() if line and not line.startswith("#")]
        pinned = source.with_suffix(".txt").read_text()
        for version in ("3.10", "3.11", "3.12", "3.13"):
            lines = [line for line in pinned.splitlines() if ";" not in line or f'"{version}"' in line]
            names = [line.split("==")[0] for line in lines if not line.startswith("#")]
            assert len(names) == len(set(names))
            for line in wanted:
                assert line.split("==")[0].split("<")[0].split("[")[0] in names


def test_markers_choose_by_python_version() -> None:
    here = layout.python_version()
    text = f'# head\na==1\nb==2 ; python_version == "3.1"\nc==3 ; python_version == "{here}"\n'
    assert wheels.applicable(text) == ["a==1", "c==3"]


@pytest.mark.parametrize(
    ("file", "usable"),
    [
        ("ruamel_yaml-0.19.1-py3-none-any.whl", True),
        ("ruamel.yaml-0.19.1-py2.py3-none-any.whl", True),
        (f"ruamel_yaml-0.19.1-cp3{sys.version_info[1]}-cp3{sys.version_info[1]}-linux_x86_64.whl", True),
        ("ruamel_yaml-0.19.1-cp39-abi3-manylinux_2_17_x86_64.whl", True),
        ("ruamel_yaml-0.19.1-cp39-cp39-linux_x86_64.whl", False),
        ("ruamel_yaml-0.19.10-py3-none-any.whl", False),
        ("ruamel_yaml_clib-0.19.1-py3-none-any.whl", False),
    ],
)
def test_wheels_in_the_store_are_recognised(file: str, usable: bool, tmp_path: Path) -> None:
    (tmp_path / file).touch()
    assert wheels.stored(tmp_path, "ruamel-yaml==0.19.1") is usable


def test_cmake_paths_of_another_machine_are_mended(tmp_path: Path) -> None:
    file = tmp_path / "some_msgs" / "cmake" / "export.cmake"
    file.parent.mkdir(parents=True)
    python, numpy = tmp_path / "python3.12", tmp_path / "numpy"
    kept = '"${_IMPORT_PREFIX}/include/some_msgs"'
    file.write_text(f'X "/far/include/python3.12;/far/site-packages/numpy/_core/include" {kept}\n')
    assert cmake_paths.mend(tmp_path, str(python), str(numpy)) == 1
    assert file.read_text() == f'X "{python};{numpy}" {kept}\n'
    assert cmake_paths.mend(tmp_path, str(python), str(numpy)) == 0


@pytest.mark.parametrize(
    ("hidden", "package"),
    [(("cc", "gcc"), "gcc"), (("c++", "g++"), "g++"), (("cc", "gcc", "c++", "g++"), "gcc g++")],
)
def test_a_missing_compiler_is_named(
    hidden: tuple[str, ...], package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in {"cc", "gcc", "c++", "g++"} - set(hidden):
        (tmp_path / name).symlink_to(shutil.which(name) or "/nowhere")
    monkeypatch.setattr(os, "environ", {**os.environ, "PATH": str(tmp_path)})
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(checks, "try_compiler", lambda compiler: None)  # needs more of PATH than is left
    with pytest.raises(layout.SetupError, match=rf"sudo apt install {package.replace('+', '[+]')}$") as raised:
        checks.check()
    assert raised.value.code == 2


def test_missing_headers_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks.sysconfig, "get_path", lambda name: str(tmp_path))
    with pytest.raises(layout.SetupError, match=rf"Python.h.*apt install python{layout.python_version()}-dev"):
        checks.check()


def test_other_systems_are_told_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_DISTRO", raising=False)
    monkeypatch.setattr(checks.platform, "system", lambda: "Darwin")
    with pytest.raises(layout.SetupError, match=r"got Darwin .*source /opt/ros/jazzy/setup.bash"):
        checks.check()


@pytest.mark.parametrize("how", ["another machine", "not wanted"])
def test_without_wheels_of_ros_all_is_set_up_but_ros(how: str, checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_DISTRO", raising=False)
    monkeypatch.delenv("DTSA_ROS", raising=False)
    assert layout.kind() == "wheels"
    if how == "another machine":
        monkeypatch.setattr(layout.platform, "machine", lambda: "aarch64")
    else:
        monkeypatch.setenv("DTSA_ROS", "none")
    assert layout.kind() == "none"
    checks.check()
    assert layout.suffix(checkout) == "-no-ros"
    assert wheels.required_sets(set()) == ["build", "runtime"]
    assert workspace.changed_packages() == ["dtsa_agent", "dtsa_channel_sim", "dtsa_bench"]
    assert main.main(["ros2", "run", "dtsa_agent", "agent"]) == 2


def test_a_python_that_is_too_old_is_refused(tmp_path: Path) -> None:
    old = tmp_path / "python3"
    old.write_text("#!/bin/sh\nexit 1\n")
    old.chmod(0o755)
    result = call("setup", DTSA_PYTHON=str(old))
    assert result.returncode == 2
    assert "allowed: 3.10 to 3.13" in result.stderr
    assert result.stderr.count("\n") == 1


def test_a_failed_step_is_named_with_its_reason_and_log(checkout: Path) -> None:
    script = "echo compiling; echo 'fatal: no space left on device'; exit 3"
    with (
        pytest.raises(layout.SetupError, match=r"step 'build': fatal: no space left on device; log: .*build\.log"),
        progress.step("build", "workspace") as step,
    ):
        step.run(["sh", "-c", script], dict(os.environ))


@pytest.mark.parametrize("while_it_starts", [False, True])
def test_an_interrupted_step_ends_what_it_started(checkout: Path, while_it_starts: bool) -> None:
    began = checkout / "began"
    program = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from machine import layout, prepare, progress\nfrom pathlib import Path\nimport os, signal, subprocess\n"
        "layout.STEP_LOGS = Path(sys.argv[2])\n"
        "signal.signal(signal.SIGTERM, prepare.interrupt)\n"
        "start = subprocess.Popen\n"
        "def start_late(*arguments, **options):\n"  # returns when the command has run for a while, as on a busy machine
        "    process = start(*arguments, **options)\n"
        "    while not layout.read(Path(sys.argv[3])).strip(): pass\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "    return process\n"
        "subprocess.Popen = start_late if sys.argv[4] == 'True' else start\n"
        "with progress.step('build', 'workspace') as step:\n"
        "    step.run(['sh', '-c', 'sleep 60 & echo $! > ' + sys.argv[3] + '; wait'], os.environ)\n"
    )
    arguments = [str(DTSA.parent), str(checkout / "log"), str(began), str(while_it_starts)]
    process = subprocess.Popen([sys.executable, "-c", program, *arguments], stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 30
    while not layout.read(began).strip() and time.monotonic() < deadline:
        time.sleep(0.02)
    child = int(layout.read(began))
    process.terminate()
    process.wait(timeout=30)
    while time.monotonic() < deadline and alive(child):
        time.sleep(0.02)
    assert not alive(child)


def alive(process: int) -> bool:
    """Whether a process runs (one that has ended and waits for its parent does not)."""
    return layout.read(Path(f"/proc/{process}/stat")).rpartition(")")[2].split()[:1] not in ([], ["Z"], ["X"])


def test_one_set_up_at_a_time(checkout: Path) -> None:
    with prepare.lock(), (checkout / ".dtsa" / "lock").open() as other:
        with pytest.raises(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        assert other.read() == str(os.getpid())
    with (checkout / ".dtsa" / "lock").open() as other:
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)


def test_waiting_for_another_set_up_ends(
    checkout: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(prepare, "PATIENCE_S", 0.3)
    with prepare.lock():
        with pytest.raises(layout.SetupError, match=rf"set-up of process {os.getpid()} has not ended"), prepare.lock():
            pass
        assert f"waiting for the set-up of process {os.getpid()}" in capsys.readouterr().err
    with prepare.lock():
        pass


def test_a_wheel_gets_into_the_store_in_one_go(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = checkout / "store"
    store.mkdir()
    seen = []

    def run(step: progress.Step, command: list[object], environment: dict[str, str]) -> None:
        words = [str(word) for word in command]
        if "wheel" in words:
            part = Path(words[words.index("--wheel-dir") + 1])
            (part / "six-1.0-py3-none-any.whl").write_text("half")
            seen.append(wheels.stored(store, "six==1.0"))
            (part / "six-1.0-py3-none-any.whl").write_text("whole")

    monkeypatch.setattr(wheels, "wheel_store", lambda environment: store)
    monkeypatch.setattr(progress.Step, "run", run)
    with progress.step("install", "packages") as step:
        assert "--no-index" in wheels.fetch(step, ["six==1.0"], {})
    assert seen == [False]
    assert [file.name for file in store.iterdir()] == ["six-1.0-py3-none-any.whl"]
    assert (store / "six-1.0-py3-none-any.whl").read_text() == "whole"


@pytest.mark.parametrize("command", ["test", "clean", "shell", "setup"])
@pytest.mark.parametrize("word", ["--help", "-h"])
def test_help_of_a_command_does_nothing_else(
    command: str, word: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*arguments: object) -> None:
        raise AssertionError("something was done")

    monkeypatch.setattr(prepare, "prepare", refuse)
    monkeypatch.setattr(prepare, "lock", refuse)
    monkeypatch.setattr(shutil, "rmtree", refuse)
    assert main.main([command, word]) == 0
    assert capsys.readouterr().out.startswith(f"usage: tools/dtsa {command} ")


def test_all_tests_run_side_by_side_and_chosen_ones_as_pytest_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[list[str]] = []
    monkeypatch.setattr(prepare, "prepare", lambda extras: None)
    monkeypatch.setattr(os, "chdir", lambda place: None)
    monkeypatch.setattr(main, "start", lambda program, words: started.append(words) or 0)
    for cores, workers in ((1, "2"), (2, "3"), (64, "4")):
        monkeypatch.setattr(os, "sched_getaffinity", lambda process, cores=cores: set(range(cores)))
        assert main.main(["test"]) == 0
        side_by_side = ["--dist", "loadfile", "--no-loadscope-reorder", "--max-worker-restart", "0"]
        assert started.pop() == ["-m", "pytest", "-n", workers, *side_by_side]
    assert main.main(["test", "-k", "frame", "-x"]) == 0
    assert started == [["-m", "pytest", "-k", "frame", "-x"]]


def test_all_parts_have_one_version() -> None:
    assert call("--version").stdout == f"dtsa {dtsa_bench.__version__}\n"
    found = {}
    for package in workspace.PACKAGES:
        root = layout.SOURCES / package
        found[f"{package}/package.xml"] = ElementTree.parse(root / "package.xml").findtext("version")
        setup = layout.read(root / "setup.py")
        if setup:
            found[f"{package}/setup.py"] = re.findall(r'version="(.*?)"', setup)[0]
    assert len(found) == 7
    assert set(found.values()) == {dtsa_bench.__version__}, found


def test_help_lists_all_commands_without_a_set_up() -> None:

    from dtsa_dev.registry import COMMANDS as DEVELOPERS

    from dtsa_bench.commands.registry import COMMANDS

    result = call("--help")
    assert result.returncode == 0
    listed = {line.split()[0] for line in result.stdout.splitlines() if line.startswith("  ")}
    assert listed == {*COMMANDS, *DEVELOPERS} | {"setup", "shell", "test", "ros2", "clean"}


@pytest.mark.parametrize("words", [["nonsense"], ["setup", "--extra", "nonsense"], ["clean", "nonsense"]])
def test_wrong_words_are_one_line_and_exit_2(words: list[str]) -> None:
    result = call(*words)
    assert result.returncode == 2
    assert "got 'nonsense'; allowed: " in result.stderr
    assert result.stderr.count("\n") == 1


def test_built_executables_start() -> None:
    if not workspace.is_built("dtsa_bench"):
        pytest.skip("the workspace is not built by tools/dtsa")
    result = call("ros2", "run", "dtsa_bench", "dtsa", "--help")
    assert result.returncode == 0
    assert "usage: dtsa" in result.stdout
