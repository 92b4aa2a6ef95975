"""The bags in a full installation of Jazzy: its own tools must take them."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml
from bag_helpers import synthetic_bag

pytestmark = pytest.mark.skipif(
    shutil.which("ros2") is None
    or not (Path(os.environ.get("AMENT_PREFIX_PATH", "/").split(":")[-1]) / "share/ros2bag").is_dir(),
    reason="no `ros2 bag` on this machine: it comes with ROS 2 from apt, not from PyPI",
)


def ros2(*words: str, timeout: float = 60) -> str:
    """Output of `ros2 bag ...`."""
    environment = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    result = subprocess.run(["ros2", "bag", *words], capture_output=True, text=True, timeout=timeout, env=environment)
    assert result.returncode == 0, result.stderr
    return result.stdout + result.stderr


def test_info_shows_topics_and_counts(tmp_path: Path) -> None:
    run = synthetic_bag(tmp_path / "flight", slots=50)
    text = ros2("info", str(run.writer.directory))
    assert f"Messages:          {run.writer.message_count}" in text
    for topic, count in run.writer.counts.items():
        assert f"Topic: {topic} " in text
        assert f"Count: {count} " in text


def test_info_reads_the_file_alone(tmp_path: Path) -> None:
    run = synthetic_bag(tmp_path / "flight", slots=50)
    assert "/swarm/slot" in ros2("info", "--storage", "mcap", str(run.writer.path))


def test_play_ends_well(tmp_path: Path) -> None:
    run = synthetic_bag(tmp_path / "flight", slots=50)
    text = ros2("play", str(run.writer.directory), "--rate", "2")
    assert "error" not in text.lower()


def test_reindex_finds_the_same(tmp_path: Path) -> None:
    run = synthetic_bag(tmp_path / "flight", slots=50)
    path = run.writer.directory / "metadata.yaml"
    before = yaml.safe_load(path.read_text())["rosbag2_bagfile_information"]
    path.unlink()
    ros2("reindex", str(run.writer.directory), "--storage", "mcap")
    after = yaml.safe_load(path.read_text())["rosbag2_bagfile_information"]
    for key in ("message_count", "starting_time", "duration", "relative_file_paths"):
        assert after[key] == before[key]
