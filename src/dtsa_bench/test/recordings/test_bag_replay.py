"""Playing bags: order, time, pausing, and a real subscriber in another process."""

from __future__ import annotations

import json
import os
import pty
import signal
import statistics
import subprocess
import sys
import time
from pathlib import Path

import pytest
from bag_helpers import SECOND, SyntheticRun, ros_environment, synthetic_bag

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.recordings.bag import schema
from dtsa_bench.recordings.bag.errors import BagError, UnusableBag
from dtsa_bench.recordings.bag.reader import Bag, Message
from dtsa_bench.recordings.bag.replay import Player, ros_profile


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> SyntheticRun:
    """A bag of 1 s and 3 agents."""
    return synthetic_bag(tmp_path_factory.mktemp("bags") / "flight", slots=100, agents=3, chunk_size=40_000)


class Listener:
    """Keeps what a player gives out."""

    def __init__(self) -> None:
        self.messages: list[Message] = []
        self.walls: list[int] = []
        self.clocks: list[int] = []
        self.clock_walls: list[int] = []

    def publish(self, message: Message) -> None:
        self.messages.append(message)
        self.walls.append(time.monotonic_ns())

    def clock(self, time_ns: int) -> None:
        self.clocks.append(time_ns)
        self.clock_walls.append(time.monotonic_ns())


def play(run: SyntheticRun, **options: object) -> tuple[Listener, Player]:
    """Play a bag as fast as may be."""
    listener = Listener()
    with Bag(run.writer.directory) as bag:
        player = Player(bag, listener, **{"rate": 50.0, **options})  # type: ignore[arg-type]
        player.play()
    return listener, player


def test_everything_is_played_once_in_order(run: SyntheticRun) -> None:
    listener, player = play(run)
    with Bag(run.writer.directory) as bag:
        assert listener.messages == list(bag.messages())
    assert player.message_count == len(listener.messages)


def test_the_clock_reaches_each_moment_before_its_messages_and_never_runs_back(run: SyntheticRun) -> None:
    listener, _ = play(run)
    assert listener.clocks == sorted(listener.clocks)
    assert listener.clocks[0] == listener.messages[0].log_time_ns
    assert {message.log_time_ns for message in listener.messages} <= set(listener.clocks)


def test_the_clock_goes_on_while_nothing_is_published(tmp_path: Path) -> None:
    run = SyntheticRun(tmp_path / "bag", agents=2)
    with run.writer:
        run.slot(0)
        run.slot(30)
    listener, _ = play(run, rate=1.0)
    gaps = [b - a for a, b in zip(listener.clocks, listener.clocks[1:], strict=False)]
    assert len(gaps) >= 10
    assert listener.clocks == sorted(listener.clocks)


@pytest.mark.parametrize(("rate", "gap_slots"), [(0.5, 30), (8.0, 800)])
def test_between_messages_the_clock_goes_on_at_the_rate(tmp_path: Path, rate: float, gap_slots: int) -> None:
    run = SyntheticRun(tmp_path / "bag", agents=2)
    with run.writer:
        run.slot(0)
        run.slot(gap_slots)
    began = time.monotonic_ns()
    listener, _ = play(run, rate=rate)
    first, last = listener.messages[0].log_time_ns, listener.messages[-1].log_time_ns
    between = set(listener.clocks) - {message.log_time_ns for message in listener.messages}
    assert len(between) >= 5
    assert listener.clocks == sorted(listener.clocks)  # a clock too fast would be ahead of the next message
    for clock, wall in zip(listener.clocks, listener.clock_walls, strict=True):
        assert clock - first <= (wall - began) * rate
    assert max(between) - first > (last - first) * 0.3  # one too slow would reach an eighth of the way


def test_topics_start_and_loop(run: SyntheticRun) -> None:
    listener, _ = play(run, topics=["/cf1/odom", "/swarm/slot"])
    assert {message.topic for message in listener.messages} == {"/cf1/odom", "/swarm/slot"}
    listener, _ = play(run, start_s=0.5)
    assert min(message.log_time_ns for message in listener.messages) == SECOND + SECOND // 2
    listener = Listener()
    with Bag(run.writer.directory) as bag:
        player = Player(bag, listener, rate=100.0, loop=True, topics=["/swarm/slot"])
        player.play(lambda playing: setattr(playing, "stopped", playing.round_count >= 2))
    slots = [message.log_time_ns for message in listener.messages]
    assert slots[:200] == 2 * [SECOND + k * 10_000_000 for k in range(100)]


@pytest.mark.alone
@pytest.mark.realtime
@pytest.mark.parametrize("rate", [1.0, 4.0])
def test_messages_keep_their_time(run: SyntheticRun, rate: float) -> None:
    listener, _ = play(run, rate=rate, topics=["/swarm/slot"])
    offsets = [
        (wall - listener.walls[0]) - (message.log_time_ns - SECOND) / rate
        for wall, message in zip(listener.walls, listener.messages, strict=True)
    ]
    assert statistics.median(abs(offset - statistics.median(offsets)) for offset in offsets) < 1_000_000


def test_a_pause_stops_messages_and_the_rest_keeps_its_distance(run: SyntheticRun) -> None:
    listener = Listener()
    paused: list[int] = []

    def poll(player: Player) -> None:
        begins = not paused and player.message_count > 200
        ends = player.paused and time.monotonic_ns() > paused[0] + 300_000_000
        if begins or ends:
            paused.append(time.monotonic_ns())
            player.paused = not player.paused

    with Bag(run.writer.directory) as bag:
        Player(bag, listener, rate=1.0).play(poll)
    assert len(paused) == 2
    assert not [wall for wall in listener.walls if paused[0] < wall < paused[1]]
    with Bag(run.writer.directory) as bag:
        assert listener.messages == list(bag.messages())
    length = listener.walls[-1] - listener.walls[0] - (paused[1] - paused[0])
    recorded = listener.messages[-1].log_time_ns - listener.messages[0].log_time_ns
    assert length >= recorded - 1_000_000
    assert listener.clocks == sorted(listener.clocks)


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), 1e9])
def test_impossible_rates_are_refused(run: SyntheticRun, rate: float) -> None:
    with pytest.raises(ConfigError, match="rate"):
        play(run, rate=rate)


def test_impossible_starts_and_topics_are_refused(run: SyntheticRun) -> None:
    for start in (-0.1, 1.5, float("nan")):
        with pytest.raises(ConfigError, match="start"):
            play(run, start_s=start)
    with pytest.raises(UnusableBag, match="no topic"):
        play(run, topics=["/swarm/nothing"])


def test_a_damaged_chunk_ends_the_playing_with_an_error(run: SyntheticRun, tmp_path: Path) -> None:
    data = bytearray(run.writer.path.read_bytes())
    with Bag(run.writer.path) as bag:
        data[bag._chunks[-1].chunk_start_offset + 100] ^= 1
    (tmp_path / "bad.mcap").write_bytes(data)
    with Bag(tmp_path / "bad.mcap") as bag, pytest.raises(UnusableBag, match="recover"):
        Player(bag, Listener(), rate=100.0).play()


# ---- with ROS ----


def need_ros() -> None:
    """Skip where nodes cannot run."""
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    pytest.importorskip("dtsa_msgs", reason="the workspace is not built")
    try:
        schema.installed("dtsa_msgs/msg/Slot")
    except BagError as error:
        pytest.skip(str(error))


REPLAY = [sys.executable, "-m", "dtsa_bench", "replay"]
SUBSCRIBER = """
import json, sys, time
import rclpy
from nav_msgs.msg import Odometry
from dtsa_msgs.msg import Slot
from rosgraph_msgs.msg import Clock
from rclpy.qos import qos_profile_sensor_data
rclpy.init()
node = rclpy.create_node("listener")
found = {"slot": [], "odom": [], "clock": []}
def slot(data):
    found["slot"].append((time.monotonic_ns(), data.hex()))
def odom(data):
    found["odom"].append(data.hex())
node.create_subscription(Slot, "/swarm/slot", slot, 100, raw=True)
node.create_subscription(Odometry, "/cf2/odom", odom, qos_profile_sensor_data, raw=True)
node.create_subscription(Clock, "/clock", lambda m: found["clock"].append(m.clock.sec * 10**9 + m.clock.nanosec),
                         qos_profile_sensor_data)
print("ready", flush=True)
end = time.monotonic() + 40
while time.monotonic() < end and len(found["slot"]) < int(sys.argv[1]):
    rclpy.spin_once(node, timeout_sec=0.05)
for _ in range(20):
    rclpy.spin_once(node, timeout_sec=0.02)
print(json.dumps(found), flush=True)
rclpy.try_shutdown()
"""


def filled(data: bytes) -> str:
    """A message as it arrives, hexadecimal."""
    return (data + bytes(-len(data) % 4)).hex()


@pytest.mark.ros
@pytest.mark.alone
@pytest.mark.realtime
def test_another_process_hears_the_recorded_bytes_in_time(run: SyntheticRun) -> None:
    need_ros()
    environment = ros_environment()
    listener = subprocess.Popen(
        [sys.executable, "-c", SUBSCRIBER, "100"], stdout=subprocess.PIPE, text=True, env=environment
    )
    try:
        assert listener.stdout is not None
        assert listener.stdout.readline() == "ready\n"
        player = subprocess.run(
            [*REPLAY, str(run.writer.directory), "--wait-for-subscriber", "--delay", "1.5"],
            capture_output=True,
            text=True,
            env=environment,
            timeout=60,
        )
        assert player.returncode == 0, player.stderr
        assert f"played {run.writer.message_count} messages" in player.stdout
        found = json.loads(listener.communicate(timeout=60)[0])
    finally:
        listener.kill()
        listener.wait()
    # The middleware fills the last word of a message up with zeros.
    assert [data for _, data in found["slot"]] == [filled(row[2]) for row in run.written["/swarm/slot"]]
    assert set(found["odom"]) <= {filled(row[2]) for row in run.written["/cf2/odom"]}
    assert len(found["odom"]) >= 90  # best effort, as recorded
    assert found["clock"] == sorted(found["clock"])
    assert found["clock"][0] >= SECOND
    offsets = [wall - 10_000_000 * k for k, (wall, _) in enumerate(found["slot"])]
    middle = statistics.median(offsets)
    assert statistics.median(abs(offset - middle) for offset in offsets) < 1_000_000


@pytest.mark.ros
def test_space_pauses_and_q_ends_in_a_terminal(run: SyntheticRun) -> None:
    need_ros()
    control, terminal = pty.openpty()
    player = subprocess.Popen(
        [*REPLAY, str(run.writer.directory), "--loop", "--delay", "0"],
        stdin=terminal,
        stdout=subprocess.PIPE,
        stderr=terminal,
        text=True,
        env=ros_environment(),
    )
    seen = ""

    def read_until(text: str) -> None:
        nonlocal seen
        end = time.monotonic() + 30
        while text not in seen and time.monotonic() < end:
            seen += os.read(control, 4096).decode("utf-8", "replace")
        assert text in seen
        seen = ""

    try:
        os.close(terminal)
        read_until(" messages ")
        os.write(control, b" ")
        read_until("paused")
        os.write(control, b" ")
        read_until("messages         ")
        os.write(control, b"q")
        assert player.wait(timeout=30) == 0
        assert player.stdout is not None
        assert "played" in player.stdout.read()
    finally:
        player.kill()
        player.wait()
        os.close(control)
        if player.stdout:
            player.stdout.close()


@pytest.mark.ros
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_a_player_cleanly(run: SyntheticRun, number: signal.Signals) -> None:
    need_ros()
    player = subprocess.Popen(
        [*REPLAY, str(run.writer.directory), "--loop"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ros_environment(),
    )
    assert player.stdout is not None
    assert player.stdout.readline().startswith("playing ")
    player.send_signal(number)
    out, error = player.communicate(timeout=30)
    assert player.returncode == 0, error
    assert "played" in out
    assert "Traceback" not in error


def test_recorded_qos_becomes_that_of_the_publisher() -> None:
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

    from dtsa_bench.recordings.bag.metadata import PROFILES

    latched = ros_profile([PROFILES["latched"]])
    assert (latched.reliability, latched.durability) == (ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)
    assert latched.depth == 1
    sensor = ros_profile([PROFILES["sensor_data"]])
    assert (sensor.reliability, sensor.depth) == (ReliabilityPolicy.BEST_EFFORT, 5)
    mixed = ros_profile([PROFILES["reliable"], PROFILES["best_effort"]])
    assert mixed.reliability == ReliabilityPolicy.BEST_EFFORT
    depths = [
        ros_profile([PROFILES["reliable"] | {"depth": depth} for depth in pair]).depth for pair in ((3, 7), (7, 3))
    ]
    assert depths == [7, 7]


@pytest.mark.ros
def test_a_type_that_has_changed_since_is_refused(tmp_path: Path) -> None:
    need_ros()
    from bag_helpers import definition

    from dtsa_bench.recordings.bag.writer import BagWriter

    kind = "nav_msgs/msg/Odometry"
    other = schema.Definition(kind, definition(kind).text, "RIHS01_" + 64 * "0")
    with BagWriter(tmp_path / "bag", {}) as writer:
        writer.add_topic("/odom", kind, "reliable", other)
    result = subprocess.run(
        [*REPLAY, str(tmp_path / "bag")],
        capture_output=True,
        text=True,
        env=ros_environment(),
    )
    assert result.returncode == 1
    assert "differs from the installed one" in result.stderr
    assert "Traceback" not in result.stderr
