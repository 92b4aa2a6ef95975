"""Integration: the bags in a full installation of Jazzy: its own tools must take them."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
import yaml
from bag_helpers import SECOND, as_it_arrives, clock_ns, listen, ros_environment, synthetic_bag
from mcap.writer import CompressionType

from dtsa_bench.log.bag.metadata import ROOT
from dtsa_bench.log.bag.reader import Bag
from dtsa_bench.log.bag.recover import recover


def has_ros2_bag() -> bool:
    prefixes = filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep))
    return shutil.which("ros2") is not None and any(Path(prefix, "share/ros2bag").is_dir() for prefix in prefixes)


pytestmark = pytest.mark.skipif(
    not has_ros2_bag(), reason="no `ros2 bag` on this machine: it comes with an installation of ROS 2"
)


def ros2(*words: str, timeout: float = 60) -> str:
    result = subprocess.run(
        ["ros2", "bag", *words],
        stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=timeout, env=ros_environment(), check=False,
    )  # fmt: skip
    text = result.stdout + result.stderr
    assert result.returncode == 0, text
    assert "[ERROR]" not in text
    return text


def convert(source: Path, target: Path, **options: object) -> None:
    bag = {"uri": str(target), "storage_id": "mcap", "all_topics": True, **options}
    settings = target.with_suffix(".yaml")
    settings.write_text(yaml.safe_dump({"output_bags": [bag]}), encoding="utf-8")
    ros2("convert", "-i", str(source), "-o", str(settings))


def rows(path: Path) -> list[tuple[int, str, bytes]]:
    with Bag(path) as bag:
        return sorted((message.log_time_ns, message.topic, message.data) for message in bag.messages())


def test_info_shows_topics_and_counts(tmp_path: Path) -> None:
    run = synthetic_bag(tmp_path / "flight", slots=50)
    text = ros2("info", str(run.writer.directory))
    assert f"Messages:          {sum(run.writer.counts.values())}" in text
    assert "ROS Distro:        jazzy" in text
    assert "Duration:          0.500000000s" in text
    for topic, count in run.writer.counts.items():
        line = next(line for line in text.splitlines() if f"Topic: {topic} " in line)
        assert f"Count: {count} " in line
    assert "/swarm/slot" in ros2("info", "--storage", "mcap", str(run.writer.path))


@pytest.mark.parametrize("compression", list(CompressionType))
def test_play_ends_well(tmp_path: Path, compression: CompressionType) -> None:
    run = synthetic_bag(tmp_path / "flight", slots=50, compression=compression)
    text = ros2("play", str(run.writer.directory), "--rate", "2")
    assert "[WARN]" not in text


def play_into(graph: Any, bag: Path, *options: str) -> dict[str, list[tuple[int, str]]]:
    """What arrives in a test's graph while `ros2 bag play` plays a bag, which begins when the test knows its topics."""
    from rosbag2_interfaces.srv import Resume

    arrived = listen(graph, bag)
    client = graph.node.create_client(Resume, "/rosbag2_player/resume")
    words = ["ros2", "bag", "play", str(bag), "--start-paused", "--clock", "100", *options]
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with subprocess.Popen(words, text=True, env=graph.environment, **pipes) as player:
        graph.until(lambda: client.service_is_ready() and all(map(graph.node.count_publishers, arrived)))
        known_s = time.monotonic()
        graph.until(lambda: time.monotonic() > known_s + 1.5)
        client.call_async(Resume.Request())
        graph.until(lambda: player.poll() is not None)
        text = player.communicate()[0]
        assert player.returncode == 0, text
        assert "[ERROR]" not in text
    ended_s = time.monotonic()
    graph.until(lambda: time.monotonic() > ended_s + 2.0)
    return arrived


@pytest.mark.ros
@pytest.mark.alone
@pytest.mark.realtime
@pytest.mark.parametrize(
    ("options", "start_ns"), [((), 0), (("--rate", "2", "--start-offset", "0.4"), SECOND + 400_000_000)]
)
def test_a_subscriber_hears_what_is_played(tmp_path: Path, options: tuple[str, ...], start_ns: int) -> None:
    pytest.importorskip("dtsa_msgs", reason="the workspace is not built")
    run = synthetic_bag(tmp_path / "flight", slots=100)
    from node_helpers import ros_graph

    with ros_graph(tmp_path) as graph:
        arrived = play_into(graph, run.writer.directory, *options)
    for topic, written in run.written.items():
        found = [data for _, data in arrived[topic]]
        wanted = [as_it_arrives(data) for log_ns, _, data in written if log_ns >= start_ns]
        if topic.endswith("/odom"):  # best effort, as recorded
            assert set(found) <= set(wanted)
            assert len(found) >= 0.9 * len(wanted)
        else:
            assert found == wanted
    clocks = [clock_ns(data) for _, data in arrived["/clock"]]
    assert clocks == sorted(clocks)
    assert clocks[0] >= max(start_ns, SECOND)


def test_reindex_finds_the_same(tmp_path: Path) -> None:
    run = synthetic_bag(tmp_path / "flight", slots=50, custom_data={"number": "1.10", "text": '# "x": y\n'})
    path = run.writer.directory / "metadata.yaml"

    def content() -> dict[str, Any]:
        loaded = yaml.load(path.read_text(encoding="utf-8"), Loader=yaml.BaseLoader)[ROOT]
        topics = {entry["topic_metadata"]["name"]: entry for entry in loaded["topics_with_message_count"]}
        return {**loaded, "topics_with_message_count": topics}

    before = content()
    path.unlink()
    ros2("reindex", str(run.writer.directory), "--storage", "mcap")
    after = content()
    assert after.pop("files") in ([], before.pop("files"))  # rosbag2 0.26 leaves them out here
    assert after == before
    assert f"Messages:          {sum(run.writer.counts.values())}" in ros2("info", str(run.writer.directory))


def test_info_and_reindex_take_a_recovered_bag(tmp_path: Path) -> None:
    run = synthetic_bag(tmp_path / "flight", slots=100, chunk_size=20_000)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(run.writer.path.read_bytes()[: run.writer.path.stat().st_size // 2])
    result = recover(cut, tmp_path / "saved")
    for _ in range(2):
        assert f"Messages:          {result.count}\n" in ros2("info", str(tmp_path / "saved"))
        (tmp_path / "saved" / "metadata.yaml").unlink()
        ros2("reindex", str(tmp_path / "saved"))


@pytest.mark.parametrize(
    "options",
    [
        {"max_bagfile_duration": 1, "storage_preset_profile": "zstd_small"},
        {"compression_mode": "file", "compression_format": "zstd"},
        {"compression_mode": "message", "compression_format": "zstd", "compression_queue_size": 0},
    ],
    ids=["split", "packed", "packed messages"],
)
def test_bags_that_rosbag2_has_split_or_compressed_are_read(tmp_path: Path, options: dict[str, object]) -> None:
    run = synthetic_bag(tmp_path / "flight", slots=150)
    convert(run.writer.directory, tmp_path / "other", **options)
    recover(tmp_path / "other", tmp_path / "saved")
    for path in (tmp_path / "other", tmp_path / "saved"):
        assert rows(path) == rows(run.writer.directory)
