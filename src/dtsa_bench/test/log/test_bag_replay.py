"""Playing bags: order, time, pausing, and a real subscriber in another process."""

from __future__ import annotations

import os
import pty
import re
import signal
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import yaml
from bag_helpers import (
    SECOND,
    SyntheticRun,
    as_it_arrives,
    cdr,
    clock_ns,
    definition,
    listen,
    ros_environment,
    stamp,
    synthetic_bag,
    synthetic_run,
)
from mcap.writer import Writer

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.log.bag import schema
from dtsa_bench.log.bag.errors import BagError, UnusableBag
from dtsa_bench.log.bag.metadata import PROFILES, load_profiles
from dtsa_bench.log.bag.reader import Bag, BagMessage
from dtsa_bench.log.bag.replay import Player, ros_profile
from dtsa_bench.log.bag.writer import BagWriter
from dtsa_bench.log.record import SLOT_RECORD


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> SyntheticRun:
    return synthetic_bag(tmp_path_factory.mktemp("bags") / "flight", slots=100, agents=3, chunk_size=40_000)


class Listener:
    def __init__(self) -> None:
        self.messages: list[BagMessage] = []
        self.walls: list[int] = []
        self.clocks: list[int] = []
        self.clock_walls: list[int] = []

    def publish(self, message: BagMessage) -> None:
        self.messages.append(message)
        self.walls.append(time.monotonic_ns())

    def clock(self, time_ns: int) -> None:
        self.clocks.append(time_ns)
        self.clock_walls.append(time.monotonic_ns())


def play(run: SyntheticRun, **options: object) -> tuple[Listener, Player]:
    listener = Listener()
    with Bag(run.writer.directory) as bag:
        player = Player(bag, listener, **{"rate": 50.0, **options})  # type: ignore[arg-type]
        player.play()
    return listener, player


def test_everything_or_what_is_chosen_is_played_in_order_and_the_clock_is_there_before(run: SyntheticRun) -> None:
    listener, player = play(run)
    with Bag(run.writer.directory) as bag:
        assert listener.messages == list(bag.messages())
    assert player.message_count == len(listener.messages)
    assert listener.clocks == sorted(listener.clocks)
    assert listener.clocks[0] == listener.messages[0].log_time_ns
    assert {message.log_time_ns for message in listener.messages} <= set(listener.clocks)
    listener, _ = play(run, topics=["/cf1/odom", SLOT_RECORD])
    assert {message.topic for message in listener.messages} == {"/cf1/odom", SLOT_RECORD}
    listener, _ = play(run, start_s=0.5)
    assert min(message.log_time_ns for message in listener.messages) == SECOND + SECOND // 2
    listener = Listener()
    with Bag(run.writer.directory) as bag:
        player = Player(bag, listener, rate=100.0, loop=True, topics=[SLOT_RECORD])
        player.play(lambda playing: setattr(playing, "stopped", playing.round_count >= 2))
    slots = [message.log_time_ns for message in listener.messages]
    assert slots[:200] == 2 * [SECOND + k * 10_000_000 for k in range(100)]


@pytest.mark.parametrize(("rate", "gap_slots"), [(0.5, 30), (8.0, 800)])
def test_between_messages_the_clock_goes_on_at_the_rate(tmp_path: Path, rate: float, gap_slots: int) -> None:
    run = synthetic_run(tmp_path / "bag", agents=2)
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


@pytest.mark.alone
@pytest.mark.realtime
@pytest.mark.parametrize("rate", [1.0, 4.0])
def test_messages_keep_their_time(run: SyntheticRun, rate: float) -> None:
    listener, _ = play(run, rate=rate, topics=[SLOT_RECORD])
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


def test_impossible_rates_starts_and_topics_are_refused(run: SyntheticRun) -> None:
    for rate in (0.0, -1.0, float("nan"), 1e9):
        with pytest.raises(ConfigError, match="rate"):
            play(run, rate=rate)
    for start in (-0.1, 1.5, float("nan")):
        with pytest.raises(ConfigError, match="start"):
            play(run, start_s=start)
    with pytest.raises(UnusableBag, match="no topic"):
        play(run, topics=["/swarm/nothing"])


def need_ros() -> None:
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    pytest.importorskip("dtsa_msgs", reason="the workspace is not built")
    try:
        schema.installed("dtsa_msgs/msg/Slot")
    except BagError as error:
        pytest.skip(str(error))


def start_replay(*words: str | Path, **options: Any) -> subprocess.Popen[str]:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "env": ros_environment(), **options}
    return subprocess.Popen([sys.executable, "-m", "dtsa_bench", "replay", *map(str, words)], text=True, **pipes)


@pytest.mark.ros
@pytest.mark.alone
@pytest.mark.realtime
def test_another_process_hears_the_recorded_bytes_in_time(run: SyntheticRun, tmp_path: Path) -> None:
    need_ros()
    from node_helpers import ros_graph

    with ros_graph(tmp_path) as graph:
        arrived = listen(graph, run.writer.directory)
        words = ("--wait-for-subscriber", "--delay", "1.5")
        player = start_replay(run.writer.directory, *words, env=graph.environment)
        graph.until(lambda: player.poll() is not None and len(arrived[SLOT_RECORD]) >= 100)
        out, error = player.communicate()
    assert player.returncode == 0, error
    assert f"played {sum(run.writer.counts.values())} messages" in out
    assert [data for _, data in arrived[SLOT_RECORD]] == [as_it_arrives(row[2]) for row in run.written[SLOT_RECORD]]
    odometry = {data for _, data in arrived["/cf2/odom"]}
    assert odometry <= {as_it_arrives(row[2]) for row in run.written["/cf2/odom"]}
    assert len(odometry) >= 90  # best effort, as recorded
    clock = [clock_ns(data) for _, data in arrived["/clock"]]
    assert clock == sorted(clock)
    assert clock[0] >= SECOND
    offsets = [wall - 10_000_000 * k for k, (wall, _) in enumerate(arrived[SLOT_RECORD])]
    middle = statistics.median(offsets)
    assert statistics.median(abs(offset - middle) for offset in offsets) < 1_000_000


@pytest.mark.ros
def test_space_pauses_and_q_ends_in_a_terminal(run: SyntheticRun) -> None:
    need_ros()
    control, terminal = pty.openpty()
    player = start_replay(run.writer.directory, "--loop", "--delay", "0", stdin=terminal, stderr=terminal)
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
        for text, key in ((" messages ", b" "), ("paused", b" "), ("messages         ", b"q")):
            read_until(text)
            os.write(control, key)
        assert "played" in player.communicate(timeout=30)[0]
        assert player.returncode == 0
    finally:
        player.kill()
        player.communicate()
        os.close(control)


@pytest.mark.ros
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_a_player_cleanly(run: SyntheticRun, number: signal.Signals) -> None:
    need_ros()
    player = start_replay(run.writer.directory, "--loop")
    assert player.stdout.readline().startswith("playing ")
    player.send_signal(number)
    out, error = player.communicate(timeout=30)
    assert player.returncode == 0, error
    assert "played" in out
    assert "Traceback" not in error


FOREVER = {"sec": 2147483647, "nsec": 4294967295}
LATCHED = PROFILES["latched"]
UNKNOWN = LATCHED | {"history": "unknown", "depth": 0}
NUMBERS = LATCHED | {
    "history": 3, "depth": 0, "reliability": 1, "durability": 1, "liveliness": 1, "deadline": FOREVER,
    "lifespan": FOREVER, "liveliness_lease_duration": FOREVER,
}  # fmt: skip


def foreign_bag(path: Path, topics: dict[str, tuple[str, list[dict[str, Any]], list[tuple[int, bytes]]]]) -> Path:
    """A file as another recorder writes it: by topic its type, the QoS of its publishers, messages and their times."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        for name, (kind, profiles, messages) in topics.items():
            encoding = ("cdr", "ros2msg") if kind.count("/") == 2 else ("json", "jsonschema")
            schema = writer.register_schema(kind, encoding[1], b"")
            about = {"offered_qos_profiles": yaml.safe_dump(profiles)}
            channel = writer.register_channel(name, encoding[0], schema, about)
            for time_ns, data in messages:
                writer.add_message(channel, time_ns, data, time_ns)
        writer.finish()
    return path


def texts(*words: str) -> list[tuple[int, bytes]]:
    """Messages of std_msgs/String, a tenth of a second from one to the next."""
    return [(SECOND + k * SECOND // 10, cdr("std_msgs/msg/String", data=word)) for k, word in enumerate(words)]


@pytest.mark.parametrize(
    ("profiles", "wanted"),
    [
        ([LATCHED], (True, True, 1)),
        ([PROFILES["sensor_data"]], (False, False, 5)),
        ([PROFILES["reliable"], PROFILES["best_effort"]], (False, False, 10)),
        ([PROFILES["reliable"] | {"depth": 3}, PROFILES["reliable"] | {"depth": 7}], (True, False, 7)),
        ([PROFILES["reliable"] | {"depth": 7}, PROFILES["reliable"] | {"depth": 3}], (True, False, 7)),
        ([], (True, False, 10)),
        ([LATCHED, LATCHED | {"depth": 2}], (True, True, 3)),  # two publishers: a late subscriber hears of both
        ([LATCHED, PROFILES["reliable"]], (True, True, 1)),
        ([UNKNOWN], (True, True, 40)),
        ([NUMBERS], (True, True, 40)),
        ([NUMBERS | {"durability": 2, "reliability": 2}], (False, False, 10)),
        ([PROFILES["reliable"] | {"depth": "many"}], (True, False, 10)),
        ([LATCHED | {"history": "keep_all"}], (True, True, 40)),
    ],
)
def test_recorded_qos_becomes_that_of_the_publisher(
    profiles: list[dict[str, Any]], wanted: tuple[bool, bool, int]
) -> None:
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

    found = ros_profile(load_profiles(yaml.safe_dump(profiles)), 40)
    reliable, latched = (
        found.reliability == ReliabilityPolicy.RELIABLE,
        found.durability == (DurabilityPolicy.TRANSIENT_LOCAL),
    )
    assert (reliable, latched, found.depth) == wanted


@pytest.mark.ros
@pytest.mark.parametrize("profile", [NUMBERS, UNKNOWN], ids=["Humble", "Jazzy"])
def test_a_late_subscriber_hears_all_latched_messages(tmp_path: Path, profile: dict[str, Any]) -> None:
    need_ros()
    from node_helpers import ros_graph
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from std_msgs.msg import String

    messages = texts("one", "two", "three")
    bag = foreign_bag(
        tmp_path / "bag.mcap",
        {
            "/settings": ("std_msgs/msg/String", [profile], messages),
            "/tick": ("std_msgs/msg/String", [], [*messages, (600 * SECOND, messages[0][1])]),
        },
    )
    with ros_graph(tmp_path) as graph:
        early: list[str] = []
        late: list[str] = []
        graph.node.create_subscription(String, "/settings", lambda m: early.append(m.data), QoSProfile(depth=10))
        player = start_replay(bag, "--wait-for-subscriber", env=graph.environment)
        try:
            graph.until(lambda: len(early) == 3)
            latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            graph.node.create_subscription(String, "/settings", lambda m: late.append(m.data), latched)
            graph.until(lambda: len(late) == 3)
            player.send_signal(signal.SIGINT)
            assert player.wait(30) == 0
        finally:
            player.kill()
            player.communicate()
    assert early == late == ["one", "two", "three"]


@pytest.mark.ros
def test_a_recorded_clock_is_the_only_one_and_what_cannot_be_played_is_left_out(tmp_path: Path) -> None:
    need_ros()
    from node_helpers import ros_graph
    from rosgraph_msgs.msg import Clock

    times = [500 * SECOND + k * SECOND // 10 for k in range(8)]  # not those of the recording
    clocks = [cdr("rosgraph_msgs/msg/Clock", clock=stamp(time_ns)) for time_ns in times]
    bag = foreign_bag(
        tmp_path / "bag.mcap",
        {
            "/clock": ("rosgraph_msgs/msg/Clock", [], [(SECOND + k * SECOND // 10, c) for k, c in enumerate(clocks)]),
            "/text": ("std_msgs/msg/String", [], texts("a")),
            "/odd": ("no_such_msgs/msg/Thing", [], texts("a")),
            "/missing": ("std_msgs/msg/NoSuchThing", [], texts("a")),
            "/service/_service_event": ("std_srvs/srv/SetBool_Event", [], texts("a")),
            "/notes": ("Note", [], texts("a")),
        },
    )
    with ros_graph(tmp_path) as graph:
        found: list[int] = []
        publishers: set[int] = set()
        graph.node.create_subscription(
            Clock, "/clock", lambda m: found.append(m.clock.sec * SECOND + m.clock.nanosec), 100
        )
        player = start_replay(bag, "--wait-for-subscriber", env=graph.environment)
        graph.until(lambda: publishers.add(graph.node.count_publishers("/clock")) or player.poll() is not None)
        out, error = player.communicate()
    assert player.returncode == 0, error
    assert "playing 2 topics" in out
    assert "played 9 messages" in out
    assert found == times
    assert publishers <= {0, 1}
    warnings = [line for line in error.splitlines() if "is left out" in line]
    assert [line.split()[2] for line in warnings] == ["/odd", "/missing", "/service/_service_event", "/notes"]
    player = start_replay(bag, "--topics", "/odd")
    assert "none of the topics can be played" in player.communicate()[1]
    assert player.returncode == 1


@pytest.mark.ros
@pytest.mark.parametrize("name", ["/cf1/odom-raw", "/1st", "/a//b"])
def test_a_topic_that_ros_forbids_is_refused_by_name(tmp_path: Path, name: str) -> None:
    need_ros()
    text = ("std_msgs/msg/String", [], texts("a"))
    bag = foreign_bag(tmp_path / "bag.mcap", {name: text, "/text": text})
    player = start_replay(bag)
    error = player.communicate()[1]
    assert player.returncode == 2
    assert re.search(rf"topic: got '{name}'.*leave it out with --topics", error)
    assert len(error.splitlines()) == 1
    assert "played 1 messages" in start_replay(bag, "--topics", "/text").communicate()[0]


@pytest.mark.ros
def test_a_type_that_has_changed_since_is_refused(tmp_path: Path) -> None:
    need_ros()
    kind = "nav_msgs/msg/Odometry"
    other = schema.Definition(kind, definition(kind).text, "RIHS01_" + 64 * "0")
    with BagWriter(tmp_path / "bag", {}) as writer:
        writer.add_topic("/odom", kind, "reliable", other)
    player = start_replay(tmp_path / "bag")
    error = player.communicate()[1]
    assert player.returncode == 1
    assert "differs from the installed one" in error
    assert "Traceback" not in error
