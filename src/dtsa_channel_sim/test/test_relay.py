"""The relay as a process, between nodes that know nothing of it."""

from __future__ import annotations

import itertools
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy")

import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, TransformStamped
from nav_msgs.msg import Odometry
from node_helpers import Graph, ros_graph
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String

from dtsa_agent.ros.common.checks import BadMessage
from dtsa_agent.stop import Stop, StopToken
from dtsa_channel_sim.relay.node import Relay, TransformTree
from dtsa_channel_sim.relay.settings import RelaySettings
from dtsa_channel_sim.relay.transport import RadioMessage

pytestmark = pytest.mark.ros
MODULE = "dtsa_channel_sim.relay.node"
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[Graph]:
    with ros_graph(tmp_path) as graph:
        yield graph


def relay(
    graph: Graph, path: Path, channel: dict[str, Any], robots: dict[str, Any], *more: str
) -> subprocess.Popen[str]:
    path.write_text(yaml.safe_dump({"channel": channel, "robots": robots}), encoding="utf-8")
    return graph.start(MODULE, "-p", f"config:={path}", *more, logs=True)


class Pair:
    """Robot 1 sends texts to robot 2; ``lists`` has what came out."""

    def __init__(self, graph: Graph, qos: QoSProfile | int = LATCHED, kind: Any = String) -> None:
        self.graph, self.texts, self.reports = graph, [], []  # type: ignore[var-annotated]
        self.publisher = graph.node.create_publisher(kind, "/robot1/text", qos)
        name = "/robot2/from/robot1/text"
        self.subscription = graph.node.create_subscription(kind, name, self.texts.append, qos)
        graph.node.create_subscription(DiagnosticArray, "/diagnostics", self.reports.append, 10)

    def connect(self) -> None:
        """Waits until messages would come through."""
        self.graph.until(lambda: self.publisher.get_subscription_count() and self.connected())

    def connected(self) -> bool:
        return bool(self.graph.node.get_publishers_info_by_topic("/robot2/from/robot1/text"))

    def counts(self) -> dict[str, str]:
        """The last report on the pair."""
        for status in self.reports[-1].status if self.reports else ():
            if status.name == "relay: robot1 to robot2":
                return {value.key: value.value for value in status.values}
        return {}

    def send(self, first: int, end: int, every_s: float = 0.0) -> None:
        for number in range(first, end):
            self.publisher.publish(String(data=str(number)))
            self.graph.executor.spin_once(timeout_sec=every_s)

    def until_sent(self, count: int) -> None:
        self.graph.until(lambda: self.counts().get("sent") == str(count))


TWO: dict[str, Any] = {"robot1": {"topics": {"text": {"bytes": 20}}}, "robot2": {}}


def received_numbers(
    graph: Graph, path: Path, channel: dict[str, Any], every_s: float
) -> tuple[dict[str, set[int]], dict[str, int]]:
    """Three robots send a hundred numbers to each other, one in ``every_s``; return what came and how many collided."""
    robots = ("robot1", "robot2", "robot3")
    qos = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # whoever finds the other late
    node, made, reports = graph.node, [], {}  # type: ignore[var-annotated]
    publishers = [node.create_publisher(String, f"/{robot}/text", qos) for robot in robots]
    numbers: dict[str, set[int]] = {f"{one} to {other}": set() for one, other in itertools.permutations(robots, 2)}
    for pair, came in numbers.items():
        one, _, other = pair.split()
        topic = f"/{other}/from/{one}/text"
        made.append(node.create_subscription(String, topic, lambda text, came=came: came.add(int(text.data)), qos))

    def note(message: DiagnosticArray) -> None:
        for status in message.status:
            reports[status.name.removeprefix("relay: ")] = {value.key: value.value for value in status.values}

    made.append(node.create_subscription(DiagnosticArray, "/diagnostics", note, 10))
    topics = {robot: {"topics": {"text": {"bytes": 20}}} for robot in robots}
    process = relay(graph, path, {"loss": 0.3, "seed": 4, "queue": 100, "slot_ms": 2, **channel}, topics)
    outputs = [subscription.topic_name for subscription in made[:-1]]
    graph.until(lambda: all(publisher.get_subscription_count() for publisher in publishers))
    graph.until(lambda: all(node.count_publishers(topic) for topic in outputs))
    for number in range(100):
        for publisher in publishers:
            publisher.publish(String(data=str(number)))
        graph.executor.spin_once(timeout_sec=every_s)

    def all_accounted() -> bool:
        return all(
            pair in reports
            and int(reports[pair]["lost"]) + int(reports[pair]["collided"]) + len(came) == 100
            and reports[pair]["sent"] == "100"
            for pair, came in numbers.items()
        )

    graph.until(all_accounted)
    assert all(reports[pair]["dropped"] == reports[pair]["out_of_range"] == "0" for pair in numbers)
    collided = {pair: int(reports[pair]["collided"]) for pair in numbers}
    assert all(float(reports[pair]["delay_mean_ms"]) > 0.4 for pair in numbers)
    process.send_signal(signal.SIGINT)
    assert process.wait(30) == 0
    for publisher in publishers:
        node.destroy_publisher(publisher)
    for subscription in made:
        node.destroy_subscription(subscription)
    graph.until(lambda: not any(node.count_publishers(topic) for topic in outputs))
    return numbers, collided


@pytest.mark.parametrize("access", ["unlimited", "lease"])
def test_losses_are_those_of_the_seed_on_an_idle_and_a_busy_machine(graph: Graph, tmp_path: Path, access: str) -> None:
    """Slowly, and in one go beside processes that take all time: of each pair the same numbers arrive.

    Under lease two that wake may send in the same OPEN turn: that depends on when they have something to send.
    """
    idle, collided_idle = received_numbers(graph, tmp_path / "idle.yaml", {"access": access}, 0.01)
    hogs = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2 * (os.cpu_count() or 1))]
    try:
        busy, collided_busy = received_numbers(graph, tmp_path / "busy.yaml", {"access": access}, 0.0)
    finally:
        for hog in hogs:
            hog.kill()
            hog.wait()
    for pair, came in idle.items():
        assert len(came - busy[pair]) <= collided_busy[pair]
        assert len(busy[pair] - came) <= collided_idle[pair]
        assert max(collided_idle[pair], collided_busy[pair]) <= (5 if access == "lease" else 0)
    assert all(50 < len(came) < 90 for came in idle.values())
    assert len({frozenset(came) for came in idle.values()}) == len(idle)


def test_no_message_is_lost_that_comes_while_many_are_read(graph: Graph) -> None:
    """As many wait as can, and one more comes when the first is read."""
    node = rclpy.create_node("relay", context=graph.node.context)
    relayed = Relay(node, RelaySettings.from_dict({"robots": TWO}))
    publisher = graph.node.create_publisher(String, "/robot1/text", 200)
    give = relayed._transport.send

    def send(message: RadioMessage) -> None:
        if message.number == 1:
            publisher.publish(String(data="more"))
            time.sleep(0.3)
        give(message)

    relayed._transport.send = send  # type: ignore[method-assign]
    graph.until(lambda: node.get_publishers_info_by_topic("/robot1/text"))
    relayed._tick(1)
    graph.until(lambda: publisher.get_subscription_count())
    for number in range(100):
        publisher.publish(String(data=str(number)))
    time.sleep(0.3)  # they come
    end_s = time.monotonic() + 2.0
    relayed.run(StopToken(Stop(), lambda: "time" * (time.monotonic() > end_s)))
    node.destroy_node()
    assert relayed._transport.counts["sent"][0, 1] == 101


def test_quality_of_service_is_the_publishers_and_a_latched_message_reaches_all(graph: Graph, tmp_path: Path) -> None:
    pair = Pair(graph)
    pair.send(0, 1)
    relay(graph, tmp_path / "relay.yaml", {}, TWO)
    graph.until(lambda: pair.texts)
    late: list[String] = []
    graph.node.create_subscription(String, "/robot2/from/robot1/text", late.append, LATCHED)
    graph.until(lambda: late)
    sensor = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = graph.node.create_publisher(String, "/robot1/sensor", sensor)
    topics = {"robot1": {"topics": {"sensor": {}}}, "robot2": {}}
    relay(graph, tmp_path / "sensor.yaml", {}, topics, "-r", "__node:=relay2")
    got: list[String] = []
    graph.node.create_subscription(String, "/robot2/from/robot1/sensor", got.append, sensor)
    graph.until(lambda: got, lambda: publisher.publish(String(data="x")))
    (info,) = graph.node.get_publishers_info_by_topic("/robot2/from/robot1/sensor")
    assert info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT


PERSISTENT = """<dds xmlns="http://www.eprosima.com"><profiles>
<data_writer profile_name="/robot1/text"><qos><durability><kind>TRANSIENT</kind></durability></qos>
<propertiesPolicy><properties>
<property><name>dds.persistence.plugin</name><value>builtin.SQLITE3</value></property>
<property><name>dds.persistence.sqlite3.filename</name><value>{database}</value></property>
<property><name>dds.persistence.guid</name>
<value>77.72.69.74.65.72.5f.70.65.72.73.5f|67.75.69.64</value></property>
</properties></propertiesPolicy></data_writer>
</profiles></dds>"""
PUBLISHER = """
import rclpy, time
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
rclpy.init()
publisher = rclpy.create_node("persistent").create_publisher(
    String, "/robot1/text", QoSProfile(depth=10, durability=DurabilityPolicy.SYSTEM_DEFAULT))
while True:
    publisher.publish(String(data="x"))
    time.sleep(0.05)
"""


def test_a_publisher_with_a_policy_that_ros_does_not_know_is_relayed(graph: Graph, tmp_path: Path) -> None:
    """A writer of DDS that keeps its messages in a file."""
    profiles = tmp_path / "profiles.xml"
    profiles.write_text(PERSISTENT.format(database=tmp_path / "messages.db"), encoding="utf-8")
    environment = {"RMW_FASTRTPS_USE_QOS_FROM_XML": "1", "FASTRTPS_DEFAULT_PROFILES_FILE": str(profiles)}
    graph.processes.append(
        subprocess.Popen(
            [sys.executable, "-c", PUBLISHER], env=graph.environment | environment, stderr=subprocess.PIPE, text=True
        )
    )
    topic = "/robot1/text"
    graph.until(lambda: graph.node.get_publishers_info_by_topic(topic))
    (info,) = graph.node.get_publishers_info_by_topic(topic)
    assert info.qos_profile.durability == DurabilityPolicy.UNKNOWN
    relay(graph, tmp_path / "relay.yaml", {}, TWO)
    texts: list[String] = []
    graph.node.create_subscription(String, "/robot2/from/robot1/text", texts.append, 10)
    graph.until(lambda: texts)


def test_odometry_says_who_is_in_range(graph: Graph, tmp_path: Path) -> None:
    """Until it is known where a robot is, and beyond the range, nothing reaches it; odometry may be nonsense."""
    robots = {"robot1": {**TWO["robot1"], "place": [0, 0, 0]}, "robot2": {"odometry": "odom"}}
    pair = Pair(graph)
    relay(graph, tmp_path / "relay.yaml", {"range_m": 10}, robots)
    odometry = graph.node.create_publisher(Odometry, "/robot2/odom", 10)
    pair.connect()
    pair.send(0, 5)
    graph.until(lambda: pair.counts().get("out_of_range") == "5")
    message = Odometry()

    def told_at(x: float) -> None:
        message.pose.pose.position.x = x
        odometry.publish(message)

    graph.until(lambda: pair.texts, lambda: (told_at(3.0), told_at(float("nan")), pair.send(5, 6)))  # type: ignore[func-returns-value]
    told_at(30.0)
    graph.until(lambda: int(pair.counts()["out_of_range"]) > 5, lambda: pair.send(6, 7))


def transform(parent: str, child: str, x: float, yaw: float = 0.0) -> TransformStamped:
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    message.transform.translation.x = x
    message.transform.rotation.z, message.transform.rotation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    return message


def test_places_by_transforms() -> None:
    """A chain of frames with a quarter turn; one that is not connected, a loop, and numbers that are none."""
    tree = TransformTree("map")
    chain = [transform("/map", "odom", 10.0, math.pi / 2), transform("odom", "robot1/base_link", 2.0)]
    tree.accept(SimpleNamespace(transforms=[*chain, transform("a", "b", 1.0), transform("b", "a", 1.0)]))
    assert tree.place_of("robot1/base_link") == pytest.approx([10.0, 2.0, 0.0])
    assert all(math.isnan(number) for frame in ("a", "nowhere") for number in tree.place_of(frame))
    with pytest.raises(BadMessage):
        tree.accept(SimpleNamespace(transforms=[transform("map", "odom", float("nan"))]))
    assert tree.place_of("odom") == pytest.approx([10.0, 0.0, 0.0])


def test_transforms_say_who_is_in_range(graph: Graph, tmp_path: Path) -> None:
    """A robot in a frame that stands still in the map, another one in a frame that moves."""
    message_type = pytest.importorskip("tf2_msgs.msg", reason="the wheels lack it").TFMessage
    robots = {"robot1": {**TWO["robot1"], "tf": "robot1/base_link"}, "robot2": {"tf": "robot2/base_link"}}
    pair = Pair(graph)
    relay(graph, tmp_path / "relay.yaml", {"range_m": 10}, robots)
    static = graph.node.create_publisher(message_type, "/tf_static", LATCHED)
    static.publish(
        message_type(transforms=[transform("map", "hall", 100.0), transform("hall", "robot1/base_link", 1.0)])
    )
    moving = graph.node.create_publisher(message_type, "/tf", 100)
    pair.connect()

    def move(x: float) -> None:
        moving.publish(message_type(transforms=[transform("map", "robot2/odom", 98.0)]))
        moving.publish(message_type(transforms=[transform("robot2/odom", "robot2/base_link", x)]))
        pair.send(0, 1)

    graph.until(lambda: int(pair.counts().get("out_of_range", 0)) > 0, lambda: move(50.0))
    assert not pair.texts
    graph.until(lambda: pair.texts, lambda: move(0.0))


def test_time_is_that_of_the_clock_topic(graph: Graph, tmp_path: Path) -> None:
    """Slots of one simulated second: nothing goes before the clock does, whatever the wall says."""
    clock = graph.node.create_publisher(Clock, "/clock", 10)
    pair = Pair(graph)
    relay(graph, tmp_path / "relay.yaml", {"access": "tdma", "slot_ms": 1000}, TWO, "-p", "use_sim_time:=true")
    pair.connect()
    now = 5_000.0

    def tick(step_s: float = 0.05) -> None:
        nonlocal now
        now += step_s
        message = Clock()
        message.clock.sec, message.clock.nanosec = int(now), int(now % 1 * 1e9)
        clock.publish(message)

    tick()
    graph.until(lambda: clock.get_subscription_count() > 0)
    for _ in range(10):
        tick(0.0)
        graph.executor.spin_once(timeout_sec=0.05)
    pair.send(0, 1)
    pair.until_sent(1)
    assert not pair.texts
    began = now
    graph.until(lambda: pair.texts, tick)
    assert now - began > 0.5


def test_what_is_wrong_is_named_and_nothing_ends(graph: Graph, tmp_path: Path) -> None:
    """Topics that nobody publishes, of another type, messages that are too long: a line each, and the rest goes on."""
    topics = {"text": {}, "later": {}, "wrong": {"type": "std_msgs/msg/String"}}
    process = relay(
        graph, tmp_path / "relay.yaml", {"access": "tdma", "slot_ms": 1}, {"robot1": {"topics": topics}, "robot2": {}}
    )
    pair = Pair(graph)
    wrong = graph.node.create_publisher(PoseStamped, "/robot1/wrong", 1)
    pair.connect()
    pair.publisher.publish(String(data="x" * 1000))
    pair.send(0, 3)
    graph.until(lambda: len(pair.texts) == 3)
    graph.until(lambda: pair.counts().get("received") == "3")
    graph.until(lambda: "/robot1/later" in pair.reports[-1].status[0].message)
    assert pair.reports[-1].status[0].values[1].value == "/robot1/text"
    later = graph.node.create_publisher(String, "/robot1/later", 1)
    graph.until(lambda: "waits" not in pair.reports[-1].status[0].message)
    assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    output = process.communicate(timeout=60)[1]
    assert process.returncode == 0
    for line in (
        "waits for /robot1/later",
        "/robot1/wrong: type: got 'geometry_msgs/msg/PoseStamped'",
        "a slot has 1 ms",
    ):
        assert output.count(line) == 1, output
    assert "Traceback" not in output
    del wrong, later


def test_odometry_that_is_none_is_named_and_the_rest_goes_on(graph: Graph, tmp_path: Path) -> None:
    topics = {"odom": {}, **TWO["robot1"]["topics"]}
    odometry = graph.node.create_publisher(PoseStamped, "/robot1/odom", 1)
    pair = Pair(graph)
    robots = {"robot1": {"odometry": "odom", "topics": topics}, "robot2": {}}
    process = relay(graph, tmp_path / "relay.yaml", {}, robots)
    pair.connect()
    pair.send(0, 3)
    graph.until(lambda: len(pair.texts) == 3)
    process.send_signal(signal.SIGTERM)
    output = process.communicate(timeout=60)[1]
    assert process.returncode == 0
    assert output.count("/robot1/odom: type: got 'geometry_msgs/msg/PoseStamped'") == 1
    assert "Traceback" not in output
    del odometry


@pytest.mark.parametrize(
    ("robots", "channel", "line"),
    [
        ({"robot1": {"topics": {"x": {"type": "no_msgs/msg/Nothing"}}}, "robot2": {}}, {}, "no_msgs/msg/Nothing"),
        ({"robot1": {"topics": {"x": {"type": "Pose"}}}, "robot2": {}}, {}, "'Pose'"),
        ({"robot1": {"topics": {"x": {}}}, "robot2": {}}, {"range_m": 5}, "robots.robot1.place"),
    ],
)
def test_a_file_that_cannot_be_used_is_one_line(
    graph: Graph, tmp_path: Path, robots: dict[str, Any], channel: dict[str, Any], line: str
) -> None:
    process = relay(graph, tmp_path / "relay.yaml", channel, robots)
    error = process.communicate(timeout=60)[1]
    assert process.returncode == 2
    assert line in error
    assert len(error.strip().splitlines()) == 1
    graph.processes.remove(process)
