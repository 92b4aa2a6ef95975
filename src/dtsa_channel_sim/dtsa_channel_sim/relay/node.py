"""``ros2 run dtsa_channel_sim relay``: topics of any robots over the shared medium (docs/how-to/relay.md)."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NoReturn

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from numpy.typing import NDArray
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Setting
from dtsa_agent.ros.common.checks import Intake, check_numbers
from dtsa_agent.ros.common.loop import Feed
from dtsa_agent.ros.common.names import message_class
from dtsa_agent.ros.common.node_process import ending, run_node
from dtsa_agent.ros.common.parameters import check_parameters, declare_setting
from dtsa_agent.stop import Stop, leave_at_once
from dtsa_agent.yaml_file import read_mapping

from .settings import RelayedTopic, RelaySettings, full_name
from .transport import COUNTS, RadioMessage

_CONFIG = Setting("config", "file", "", "YAML file: robots, topics, channel")
_DEPTH = 100  # messages of a topic that wait for the relay
_MAX_WAIT_S, _MIN_WAIT_S = 0.05, 0.0005
_TICK_S, _REPORT_TICKS, _REMIND_TICKS = 0.5, 2, 20  # of checks for topics; diagnostics; lines about what is awaited
_JUMP_NS = 10_000_000_000  # by which no clock moves on its own
_NO_EVENTS = PublisherEventCallbacks(use_default_callbacks=False)  # an executor checks each one every time
_MAX_FRAMES, _MAX_DEPTH = 10_000, 64  # of /tf


class TransformTree:
    """Frames of /tf: the parent of each, its position there, m, and its rotation (x, y, z, w)."""

    def __init__(self, root: str) -> None:
        self._root, self._frames = root.strip("/"), dict[str, tuple[str, Any, Any]]()

    def accept(self, message: Any) -> None:
        """Keep the transforms of a tf2_msgs/TFMessage; raise BadMessage if one cannot be."""
        for entry in message.transforms:
            child, p, q = entry.child_frame_id.strip("/"), entry.transform.translation, entry.transform.rotation
            check_numbers("transforms", numbers := (p.x, p.y, p.z, q.x, q.y, q.z, q.w))
            offset, quaternion = np.array(numbers[:3]), np.array(numbers[3:])
            if (norm := np.linalg.norm(quaternion)) and (child in self._frames or len(self._frames) < _MAX_FRAMES):
                self._frames[child] = entry.header.frame_id.strip("/"), offset, quaternion / norm

    def place_of(self, frame: str) -> NDArray[np.float64]:
        """Return the position of a frame in the root, (3,) m; not numbers if nothing connects them."""
        frame, place = frame.strip("/"), np.zeros(3)
        for _ in range(_MAX_DEPTH):
            if frame == self._root:
                return place
            if frame not in self._frames:
                break
            frame, offset, quaternion = self._frames[frame]
            across = 2.0 * np.cross(quaternion[:3], place)
            place = place + quaternion[3] * across + np.cross(quaternion[:3], across) + offset
        return np.full(3, np.nan)


class Relay:
    """Gives messages of robots to the transport, and to the robots that received them."""

    def __init__(self, node: Node, settings: RelaySettings) -> None:
        self._node, self._logger, self._intake = node, node.get_logger(), Intake(node.get_logger())
        self._transport, robots, self._awaited = settings.read()
        for topic in self._awaited:
            if topic.type:
                message_class(topic.type)
        self._names = list(robots)
        self._refused: set[str] = set()  # sources with messages that do not fit
        self._diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._clock_ns, self._now_ns = node.get_clock().now().nanoseconds, 0
        self._positions = np.full((3, len(robots)), np.nan)  # m; not numbers: not known yet
        self._feeds: list[tuple[Feed, Callable[[Any], None]]] = []  # what says where robots are
        self._tree, self._frames = TransformTree(settings.map_frame), dict[int, str]()  # of robots, by row
        for row, (name, robot) in enumerate(robots.items()):
            if robot.odometry:
                accept, source = partial(self._accept_odometry, row), full_name(name, robot.odometry, "odometry")
                self._follow("nav_msgs/msg/Odometry", source, accept, reliability=ReliabilityPolicy.BEST_EFFORT)
            elif robot.tf:
                self._frames[row], self._positions[:, row] = robot.tf, self._tree.place_of(robot.tf)
            else:
                self._positions[:, row] = robot.place or 0.0  # 0: it does not matter
        if self._frames:
            static = DurabilityPolicy.TRANSIENT_LOCAL
            self._follow("tf2_msgs/msg/TFMessage", "/tf", self._tree.accept)
            self._follow("tf2_msgs/msg/TFMessage", "/tf_static", self._tree.accept, durability=static)

    def run(self, stop: Stop) -> None:
        """Relay until a signal."""
        executor = SingleThreadedExecutor(context=self._node.context)
        executor.add_node(self._node)
        ticks, next_tick_s = itertools.count(1), 0.0
        while not stop and self._node.context.ok():
            wait_s = (self._transport.due_ns - self._update_time()) / 1e9
            executor.spin_once(timeout_sec=min(_MAX_WAIT_S, max(_MIN_WAIT_S, wait_s)))
            self._update_positions()
            for message, received in self._transport.advance(self._update_time(), self._positions):
                publishers, data = message.payload
                for row in np.flatnonzero(received).tolist():
                    publishers[row].publish(data)
            if time.monotonic() >= next_tick_s:
                next_tick_s = time.monotonic() + _TICK_S
                self._tick(next(ticks))

    def _update_time(self) -> int:
        """Return the time of the transport, ns: by the node's clock, but it stands still when that jumps."""
        clock_ns = self._node.get_clock().now().nanoseconds
        step_ns, self._clock_ns = clock_ns - self._clock_ns, clock_ns
        self._now_ns += step_ns if 0 <= step_ns <= _JUMP_NS else 0
        return self._now_ns

    # Where robots are.

    def _follow(self, type_name: str, topic: str, accept: Callable[[Any], None], **policies: Any) -> None:
        qos = QoSProfile(depth=_DEPTH, **policies)
        self._feeds.append((Feed(self._node, message_class(type_name), topic, qos, intake=self._intake), accept))

    def _accept_odometry(self, row: int, message: Any) -> None:
        position = message.pose.pose.position
        check_numbers("places", place := (position.x, position.y, position.z))
        self._positions[:, row] = place

    def _update_positions(self) -> None:
        is_changed = False
        for feed, accept in self._feeds:
            for message in itertools.islice(iter(feed.take, None), _DEPTH):
                is_changed = True
                with self._intake.guard():
                    accept(message)
        for row, frame in self._frames.items() if is_changed else ():
            self._positions[:, row] = self._tree.place_of(frame)

    # Messages.

    def _tick(self, tick: int) -> None:
        """Relay topics that have a publisher by now; now and then say what is missing, and how pairs are doing."""
        for topic in self._awaited.copy():
            if sources := self._node.get_publishers_info_by_topic(topic.source):
                self._awaited.remove(topic)
                try:
                    self._relay(topic, sources)
                except ConfigError as error:
                    self._logger.error(f"{topic.source}: {error}")
        missing = [topic.source for topic in self._awaited]
        missing += [f"the place of {self._names[row]}" for row in np.flatnonzero(np.isnan(self._positions[0]))]
        if tick % _REMIND_TICKS == _REPORT_TICKS:
            for text in missing:
                self._logger.info(f"waits for {text}")
        if tick % _REPORT_TICKS == 0:
            self._report(f"waits for {', '.join(missing)}" if missing else "relays")

    def _relay(self, topic: RelayedTopic, sources: Sequence[TopicEndpointInfo]) -> None:
        type_name = sources[0].topic_type
        if topic.type not in ("", type_name):
            raise ConfigError("type", type_name, f"{topic.type}, as the file says")
        message_type = message_class(type_name)
        # The weaker of two policies is the larger number; one that ROS does not know has a number above both.
        profiles = [source.qos_profile for source in sources]
        reliability = min(max(qos.reliability for qos in profiles), ReliabilityPolicy.BEST_EFFORT)
        durability = min(max(qos.durability for qos in profiles), DurabilityPolicy.VOLATILE)
        qos = QoSProfile(depth=_DEPTH, reliability=reliability, durability=durability)
        publishers, numbers = dict[int, Publisher](), itertools.count(1)

        def accept(first: bytes, about: Any) -> None:  # with two parameters rclpy gives the message's number, too
            more = iter(partial(subscription.handle.take_message, message_type, True), None)
            # An executor takes one message at a time, and long for it.
            for data, info in itertools.chain([(first, about)], itertools.islice(more, _DEPTH)):
                number, length = info["publication_sequence_number"] or next(numbers), topic.bytes or len(data)
                now_ns, payload = self._update_time(), (publishers, data)
                message = RadioMessage(topic.robot, topic.name, number, length, now_ns, topic.receivers, payload)
                try:
                    self._transport.send(message)
                except ConfigError as error:
                    if topic.source not in self._refused:
                        self._refused.add(topic.source)
                        self._logger.error(f"{topic.source}: a message cannot be sent: {error}")

        try:
            subscription = self._node.create_subscription(message_type, topic.source, accept, qos, raw=True)
        except RuntimeError:  # of rcl: in one process a topic has one type
            raise ConfigError("type", type_name, "that of odometry, which this topic is by the file") from None
        for row in np.flatnonzero(topic.receivers).tolist():
            name = f"/{self._names[row]}/from/{self._names[topic.robot - 1]}/{topic.name.strip('/')}"
            publishers[row] = self._node.create_publisher(message_type, name, qos, event_callbacks=_NO_EVENTS)
        self._logger.info(f"{topic.source}: {type_name}")

    def _report(self, state: str) -> None:
        """Publish the state of the relay, and counts and ages of each pair."""
        counts, newest = self._transport.counts, self._transport.newest
        report = DiagnosticArray()
        report.header.stamp = self._node.get_clock().now().to_msg()

        def add(name: str, text: str, **values: Any) -> None:
            pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
            report.status.append(DiagnosticStatus(name=name, message=text, hardware_id="simulated", values=pairs))

        add("relay", state, access=self._transport.config.access, refused=", ".join(sorted(self._refused)))
        for sender, receiver in np.argwhere(counts["sent"]).tolist():
            values = {name: counts[name][sender, receiver] for name in COUNTS}
            delay_ms = counts["delay_ns"][sender, receiver] / max(1, values["received"]) / 1e6
            message = newest[receiver, sender]
            age = f"{(self._now_ns - message.at_ns) / 1e6:.3f}" if message else "-1"
            add(
                f"relay: {self._names[sender]} to {self._names[receiver]}",
                f"{values['received']} of {values['sent']} received",
                **values, delay_mean_ms=f"{delay_ms:.3f}", age_ms=age,
            )  # fmt: skip
        self._diagnostics.publish(report)


def _body(stop: Stop, supervised: bool) -> None:
    node = Node("relay", start_parameter_services=False)
    with ending(node):
        path = declare_setting(node, _CONFIG)
        check_parameters(node)
        if not path:
            raise ConfigError("config", path, "a YAML file: --ros-args -p config:=FILE")
        Relay(node, RelaySettings.from_dict(read_mapping(path, "relay"))).run(stop)


def main(args: Sequence[str] | None = None) -> NoReturn:
    """Run the node; end the process."""
    leave_at_once(run_node("relay", _body, args))


if __name__ == "__main__":
    main()
