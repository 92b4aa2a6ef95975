"""The launch file in a full installation of Jazzy: a flight by `ros2 launch`."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest
from bag_helpers import ros_environment

from dtsa_bench.log.bag.reader import Bag
from dtsa_bench.log.verify.check import verify_bag

pytest.importorskip("launch_ros", reason="no `ros2 launch` on this machine: it comes with an installation of ROS 2")
pytest.importorskip("dtsa_msgs", reason="the workspace is not built")
pytestmark = pytest.mark.skipif(shutil.which("ros2") is None, reason="no `ros2` on this machine")


def start(tmp_path: Path, *words: str, file: str = "swarm_launch.py") -> subprocess.Popen[str]:
    return subprocess.Popen(
        ["ros2", "launch", "dtsa_bench", file, *words], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, env=ros_environment() | {"ROS_LOG_DIR": str(tmp_path / "log")},
    )  # fmt: skip


def launch(tmp_path: Path, *words: str, file: str = "swarm_launch.py") -> str:
    return start(tmp_path, *words, file=file).communicate(timeout=120)[0]


@pytest.mark.ros
@pytest.mark.parametrize("processes", ["per-agent", "2"])
def test_a_launched_flight_is_recorded_and_ends(processes: str, tmp_path: Path) -> None:
    out = tmp_path / "flight"
    text = launch(
        tmp_path, "agents:=4", "policy:=lease", "timeout_s:=1", f"processes:={processes}", "partition:=[[1,2],[3,4]]",
        f"out:={out}",
    )  # fmt: skip
    assert "has died" not in text, text
    assert text.count("has finished cleanly") == 1 + (4 if processes == "per-agent" else int(processes))
    assert json.loads((out / "summary.json").read_text(encoding="utf-8"))["end"] == "timed out"
    with Bag(out / "bag") as bag:
        assert bag.config["channel"]["partition"] == [[1, 2], [3, 4]]
        assert bag.topics["/cf4/odom"].count == 100


@pytest.mark.ros
def test_two_swarms_fly_on_one_domain_each_in_its_mode(tmp_path: Path) -> None:
    north, south = tmp_path / "north", tmp_path / "south"
    words = ["agents:=3", "policy:=lease", "timeout_s:=1.5", "processes:=1"]
    first = start(tmp_path, *words, "swarm_namespace:=/north", "mode:=realtime", "slot_ms:=20", f"out:={north}")
    second = launch(tmp_path, *words, "swarm_namespace:=/south", "seed:=2", f"out:={south}")
    texts = [first.communicate(timeout=120)[0], second]
    for out, text, slots in ((north, texts[0], 75), (south, texts[1], 150)):
        assert "has died" not in text, text
        summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
        assert summary["end"] == "timed out", text
        with Bag(out / "bag") as bag:
            assert bag.topics["/cf3/odom"].count == slots
            assert bag.topics["/swarm/configuration"].count == 1
    assert verify_bag(south).ok


def test_a_mission_without_a_configuration_is_refused(tmp_path: Path) -> None:
    text = launch(tmp_path, "mission:=true", file="crazyflie_launch.py")
    assert "config: got ''; allowed: the path of a swarm's YAML file" in text
    assert "process started" not in text


@pytest.mark.parametrize(
    ("word", "allowed"),
    [("policy:=nonsense", "tdma"), ("processes:=nonsense", "per-agent, or 1 to 4"),
     ("processes:=5", "per-agent, or 1 to 4"), ("mode:=nonsense", "")],
)  # fmt: skip
def test_wrong_arguments_are_named_before_anything_starts(word: str, allowed: str, tmp_path: Path) -> None:
    text = launch(tmp_path, "agents:=4", word, f"out:={tmp_path / 'flight'}")
    name, value = word.split(":=")
    assert (f"{name}: got '{value}'; allowed: {allowed}" if allowed else name) in text
    assert "Traceback" not in text
    assert "process started" not in text
    assert not (tmp_path / "flight").exists()


def test_all_settings_are_arguments(tmp_path: Path) -> None:
    text = launch(tmp_path, "--show-args")
    for name in ("agents", "policy", "loss", "partition", "timeout_s", "processes", "mode", "out", "channel_file"):
        assert f"'{name}':" in text
