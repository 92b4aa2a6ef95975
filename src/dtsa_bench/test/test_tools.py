"""The set-up of a machine: what it asks for, what it remembers, what it rebuilds, and the `ros2` stand-in."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from machine import checks, cmake_paths, layout, main, prepare, progress, ros2, wheels, workspace

DTSA = layout.ROOT / "tools" / "dtsa"


def call(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(DTSA), *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
        check=False,
    )


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty place that stands for the checkout: sources are copied, nothing is built."""
    for package in workspace.PACKAGES:
        ignore = shutil.ignore_patterns("__pycache__", "*.so", "*.egg-info", "test")
        shutil.copytree(layout.SOURCES / package, tmp_path / "src" / package, ignore=ignore)
    shutil.copytree(layout.REQUIREMENTS, tmp_path / "requirements")
    places = {
        "ROOT": ".", "SOURCES": "src", "REQUIREMENTS": "requirements", "BUILD": "build", "INSTALL": "install",
        "VENV": ".venv", "PYTHON": ".venv/bin/python", "VENV_STAMPS": ".venv/.dtsa",
        "STATE": ".dtsa", "STEP_LOGS": ".dtsa/log",
    }  # fmt: skip
    for name, place in places.items():
        monkeypatch.setattr(layout, name, tmp_path / place)
    return tmp_path


def pretend_built(package: str) -> None:
    """Make the files by which a finished build is recognised."""
    share = layout.INSTALL / package / "share" / package
    packages = layout.INSTALL / package / "lib" / "python3" / "site-packages"
    for directory in (layout.BUILD / package, share, packages):
        directory.mkdir(parents=True)
    (share / "package.sh").touch()
    (packages / f"{package}.egg-link").touch()
    if package == "dtsa_agent":
        (layout.SOURCES / package / package / "core" / "_kernel.cpython-3.so").touch()
    workspace.stamp(package)


def test_only_changed_packages_are_built(checkout: Path) -> None:
    assert workspace.changed_packages() == list(workspace.PACKAGES)
    for package in workspace.PACKAGES:
        pretend_built(package)
    assert workspace.changed_packages() == []

    source = checkout / "src" / "dtsa_bench" / "dtsa_bench" / "cli.py"
    source.write_text(source.read_text() + "\n")
    assert workspace.changed_packages() == []  # Python is linked, not copied

    message = checkout / "src" / "dtsa_msgs" / "msg" / "Slot.msg"
    os.utime(message, (1, 1))
    assert workspace.changed_packages() == []  # same content
    message.write_text(message.read_text() + "uint8 more\n")
    assert workspace.changed_packages() == ["dtsa_msgs"]

    next((checkout / "src" / "dtsa_agent" / "dtsa_agent" / "core" / "_kernel").glob("*.h")).write_text("/* new */")
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
    workspace.remove_kernel()
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


def test_other_machines_are_told_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_DISTRO", raising=False)
    monkeypatch.setattr(checks.platform, "machine", lambda: "aarch64")
    with pytest.raises(layout.SetupError, match=r"got Linux aarch64 .*source /opt/ros/jazzy/setup.bash"):
        checks.check()


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


def test_an_interrupted_step_ends_what_it_started(checkout: Path) -> None:
    began = checkout / "began"
    program = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from machine import layout, prepare, progress\nfrom pathlib import Path\nimport os, signal\n"
        "layout.STEP_LOGS = Path(sys.argv[2])\n"
        "signal.signal(signal.SIGTERM, prepare.interrupt)\n"
        "with progress.step('build', 'workspace') as step:\n"
        "    step.run(['sh', '-c', 'sleep 60 & echo $! > ' + sys.argv[3] + '; wait'], os.environ)\n"
    )
    arguments = [str(DTSA.parent), str(checkout / "log"), str(began)]
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


def test_help_lists_all_commands_without_a_set_up() -> None:
    from dtsa_bench.registry import available

    result = call("--help")
    assert result.returncode == 0
    listed = {line.split()[0] for line in result.stdout.splitlines() if line.startswith("  ")}
    assert listed == {name for name, _ in available()} | {"setup", "shell", "test", "ros2", "clean"}


@pytest.mark.parametrize("words", [["nonsense"], ["setup", "--extra", "nonsense"], ["clean", "nonsense"]])
def test_wrong_words_are_one_line_and_exit_2(words: list[str]) -> None:
    result = call(*words)
    assert result.returncode == 2
    assert "got 'nonsense'; allowed: " in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.fixture
def prefix(tmp_path: Path) -> dict[str, str]:
    """Two small prefixes with packages as an ament index has them; the first hides part of the second."""
    for name, package in (("first", "one"), ("second", "one"), ("second", "two")):
        root = tmp_path / name
        index = root / ros2.INDEX
        (index / "packages").mkdir(parents=True, exist_ok=True)
        (index / "packages" / package).touch()
        library = root / "lib" / package
        library.mkdir(parents=True)
        script = library / f"{package}_of_{name}"
        script.write_text('#!/bin/sh\necho "$0" "$@"\n')
        script.chmod(0o755)
        (library / "notes.txt").touch()
    (tmp_path / "second" / ros2.INDEX / "rosidl_interfaces").mkdir()
    (tmp_path / "second" / ros2.INDEX / "rosidl_interfaces" / "two").write_text(
        "msg/Outer.idl\nmsg/Outer.msg\nmsg/Inner.msg\n"
    )
    messages = tmp_path / "second" / "share" / "two" / "msg"
    messages.mkdir(parents=True)
    (messages / "Outer.msg").write_text("# Head\nuint8 LIMIT=3\nInner[<=LIMIT] parts # m\nstring name\n")
    (messages / "Inner.msg").write_text("# Not shown\nfloat64 x\n")
    return {"AMENT_PREFIX_PATH": f"{tmp_path / 'first'}{os.pathsep}{tmp_path / 'second'}"}


def test_stand_in_lists_executables(prefix: dict[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    assert ros2.main(["pkg", "executables"], prefix) == 0
    assert capsys.readouterr().out == "one one_of_first\ntwo two_of_second\n"
    assert ros2.main(["pkg", "executables", "two"], prefix) == 0
    assert capsys.readouterr().out == "two two_of_second\n"


def test_stand_in_shows_nested_interfaces(prefix: dict[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    assert ros2.main(["interface", "list"], prefix) == 0
    assert capsys.readouterr().out == "two/msg/Inner\ntwo/msg/Outer\n"
    assert ros2.main(["interface", "show", "two/msg/Outer"], prefix) == 0
    assert capsys.readouterr().out == ("# Head\nuint8 LIMIT=3\nInner[<=LIMIT] parts # m\n\tfloat64 x\nstring name\n")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run", "three", "x"], "package: got 'three'"),
        (["run", "two", "x"], "executable: got 'x'; allowed: two_of_second"),
        (["interface", "show", "two/msg/None"], "interface: got 'two/msg/None'"),
        (["launch", "dtsa_bench", "swarm_launch.py"], "ros2: got 'launch dtsa_bench swarm_launch.py'"),
    ],
)
def test_stand_in_says_what_is_wrong(words: list[str], message: str, prefix: dict[str, str]) -> None:
    with pytest.raises(layout.SetupError) as raised:
        ros2.main(words, prefix)
    assert str(raised.value).startswith(message)
    assert raised.value.code == 2


@pytest.mark.parametrize("distribution", ["", "humble", "jazzy"])
def test_stand_in_makes_way_for_the_command_of_jazzy_only(
    distribution: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DISTRO", distribution)
    assert not main.has_ros2({"PATH": str(tmp_path)})
    (tmp_path / "ros2").write_text("#!/bin/sh\n")
    (tmp_path / "ros2").chmod(0o755)
    assert main.has_ros2({"PATH": str(tmp_path)}) == (distribution == "jazzy")


def test_stand_in_agrees_with_the_ament_index() -> None:
    index = pytest.importorskip("ament_index_python.packages")
    if not os.environ.get("AMENT_PREFIX_PATH"):
        pytest.skip("the workspace is not sourced")
    assert {name: str(path) for name, path in ros2.packages(os.environ).items()} == dict(
        index.get_packages_with_prefixes()
    )
    assert [path.name for path in ros2.executables("dtsa_agent", os.environ)] == [
        "agent", "crazyflie_agents", "crazyflie_bridge", "swarm_host"
    ]  # fmt: skip


def test_built_executables_start() -> None:
    if not workspace.is_built("dtsa_bench"):
        pytest.skip("the workspace is not built by tools/dtsa")
    result = call("ros2", "run", "dtsa_bench", "dtsa", "--help")
    assert result.returncode == 0
    assert "usage: dtsa" in result.stdout
