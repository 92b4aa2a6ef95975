"""Integration: the stand-in for the `ros2` command on machines that have the wheels of ROS only."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from machine import layout, main, ros2


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
