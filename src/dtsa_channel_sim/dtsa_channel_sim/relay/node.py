"""``ros2 run dtsa_channel_sim relay``: topics of any robots over the shared medium (docs/how-to/relay.md)."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from typing import Any, NoReturn

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from numpy.typing import NDArray
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Setting
from dtsa_agent.ros.common.checks import UNREADABLE, BadMessage, Intake, check_numbers
from dtsa_agent.ros.common.node_process import ending, run_node
from dtsa_agent.ros.common.parameters import check_parameters, declare_setting
from dtsa_agent.stop import Stop, leave_at_once
from dtsa_agent.yaml_file import read_mapping

from .settings import RelayedTopic, RelaySettings, full_name
from .transport import COUNTS, RadioMessage, Transport

_CONFIG = Setting("config", "file", "", "YAML file: robots, topics, channel")
_DEPTH = 100  # messages of a topic that wait for the relay
_MAX_WAIT_S, _MIN_WAIT_S = 0.05, 0.0005
_TICK_S, _REPORT_TICKS, _REMIND_TICKS = 0.5, 2, 20  # of checks for topics; diagnostics; lines about what is awaited
_JUMP_NS = 10_000_000_000  # by which no clock moves on its own
_NO_EVENTS = PublisherEventCallbacks(use_default_callbacks=False)  # an executor checks each one every time
_MAX_FRAMES, _MAX_DEPTH = 10_000, 64  # of /tf


def message_class(name: str) -> Any:
    """Return the class of a message type, ``package/msg/Name``; a ConfigError if its package is not installed."""
    package, _, class_name = name.partition("/msg/")
    try:
        message_type = getattr(import_module(f"{package}.msg"), class_name)
        message_type.__class__.__import_type_support__()
    except Exception as error:  # what an incomplete package raises has no common base
        raise ConfigError("type", name, f"an installed message type ({error})") from None
    return message_type


class TransformTree:
    """Frames of /tf: the position of each in its parent, m, and its rotation (x, y, z, w)."""

    def __init__(self, root: str) -> None:
        self._root = root.strip("/")
        self._frames: dict[str, tuple[str, Any, Any]] = {}

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


class RobotPlaces:
    """Positions of the robots by odometry, /tf or the file: (3, N) m; not numbers until they are known."""

    def __init__(self, node: Node, settings: RelaySettings) -> None:
        self.positions = np.full((3, len(settings.robots)), np.nan)
        self._node, self._intake = node, Intake(node.get_logger())
        self._tree = TransformTree(settings.map_frame)
        self._frames = [(row, value) for row, (source, value) in enumerate(settings.places) if source == "tf"]
        for row, (source, value) in enumerate(settings.places):
            if source == "place":
                self.positions[:, row] = value
            elif source == "odometry":
                topic = full_name(settings.robots[row], value, source)
                qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
                self._subscribe("nav_msgs/msg/Odometry", topic, qos, partial(self._accept_odometry, row))
        latched = QoSProfile(depth=_DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for topic, qos in (("/tf", QoSProfile(depth=_DEPTH)), ("/tf_static", latched)) if self._frames else ():
            self._subscribe("tf2_msgs/msg/TFMessage", topic, qos, self._accept_transforms)

    def _subscribe(self, type_name: str, topic: str, qos: QoSProfile, use: Callable[[Any], None]) -> None:
        message_type = message_class(type_name)

        def accept(data: bytes) -> None:
            with self._intake.guard():
                try:
                    message = deserialize_message(data, message_type)
                except Exception as error:  # rclpy has no common base
                    raise BadMessage(UNREADABLE, f"no {type_name}: {(str(error).splitlines() or [''])[0]}") from None
                use(message)

        self._node.create_subscription(message_type, topic, accept, qos, raw=True)

    def _accept_odometry(self, row: int, message: Any) -> None:
        position = message.pose.pose.position
        check_numbers("places", numbers := (position.x, position.y, position.z))
        self.positions[:, row] = numbers

    def _accept_transforms(self, message: Any) -> None:
        self._tree.accept(message)
        for row, frame in self._frames:
            self.positions[:, row] = self._tree.place_of(frame)


class Relay:
    """Gives messages of robots to the transport, and to the robots that received them."""

    def __init__(self, node: Node, settings: RelaySettings) -> None:
        self._node, self._settings, self._logger = node, settings, node.get_logger()
        self._transport, self._places = Transport(settings.access, settings.channel), RobotPlaces(node, settings)
        for topic in settings.topics:
            if topic.type:
                message_class(topic.type)
        self._awaited = list(settings.topics)
        self._publishers: dict[tuple[str, int], Publisher] = {}  # by source and the receiver's row
        self._refused: set[str] = set()  # sources with messages that do not fit
        self._diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._clock_ns, self._now_ns = node.get_clock().now().nanoseconds, 0
        self._ticks, self._next_tick_s = 0, 0.0

    def run(self, stop: Stop) -> None:
        """Relay until a signal."""
        executor = SingleThreadedExecutor(context=self._node.context)
        executor.add_node(self._node)
        while not stop and self._node.context.ok():
            wait_s = (self._transport.due_ns - self._update_time()) / 1e9
            executor.spin_once(timeout_sec=min(_MAX_WAIT_S, max(_MIN_WAIT_S, wait_s)))
            for message, received in self._transport.advance(self._update_time(), self._places.positions):
                source, data = message.payload
                for row in np.flatnonzero(received).tolist():
                    self._publishers[source, row].publish(data)
            if time.monotonic() >= self._next_tick_s:
                self._tick()

    def _update_time(self) -> int:
        """Return the time of the transport, ns: by the node's clock, but it stands still when that jumps."""
        clock_ns = self._node.get_clock().now().nanoseconds
        step_ns, self._clock_ns = clock_ns - self._clock_ns, clock_ns
        if 0 <= step_ns <= _JUMP_NS:
            self._now_ns += step_ns
        elif self._now_ns:
            self._logger.warning(f"the clock has jumped by {step_ns / 1e9:.3g} s")
        return self._now_ns

    def _tick(self) -> None:
        self._next_tick_s, self._ticks = time.monotonic() + _TICK_S, self._ticks + 1
        self._awaited = [topic for topic in self._awaited if not self._open(topic)]
        if self._ticks % _REMIND_TICKS == _REPORT_TICKS:
            for text in self._missing():
                self._logger.info(f"waits for {text}")
        if self._ticks % _REPORT_TICKS == 0:
            self._report()

    def _missing(self) -> list[str]:
        robots = zip(self._settings.robots, self._settings.places, np.isnan(self._places.positions[0]), strict=True)
        places = [f"the place of {name} ({source}: {value})" for name, (source, value), nan in robots if source and nan]
        return [topic.source for topic in self._awaited] + places

    def _open(self, topic: RelayedTopic) -> bool:
        """Subscribe to a topic if it has a publisher; return whether nothing is left to do."""
        publishers = self._node.get_publishers_info_by_topic(topic.source)
        if not publishers:
            return False
        type_name, robots = publishers[0].topic_type, self._settings.robots
        try:
            if topic.type not in ("", type_name):
                raise ConfigError("type", type_name, f"{topic.type}, as the file says")
            message_type = message_class(type_name)
        except ConfigError as error:
            self._logger.error(f"{topic.source}: {error}")
            return True
        qos = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        if all(info.qos_profile.reliability == ReliabilityPolicy.RELIABLE for info in publishers):
            qos.reliability = ReliabilityPolicy.RELIABLE
        if all(info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for info in publishers):
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        receivers, numbers = np.zeros(len(robots), np.bool_), itertools.count(1)
        for receiver in topic.receivers:
            receivers[receiver - 1] = True
            name = f"/{robots[receiver - 1]}/from/{robots[topic.robot - 1]}/{topic.name.strip('/')}"
            publisher = self._node.create_publisher(message_type, name, qos, event_callbacks=_NO_EVENTS)
            self._publishers[topic.source, receiver - 1] = publisher

        def accept(data: bytes, info: Any) -> None:  # with two parameters rclpy gives the message's number, too
            for _ in range(_DEPTH):  # an executor takes one message at a time, and long for it
                self._send(topic, receivers, data, info["publication_sequence_number"] or next(numbers))
                if (following := subscription.handle.take_message(message_type, True)) is None:
                    return
                data, info = following

        subscription = self._node.create_subscription(message_type, topic.source, accept, qos, raw=True)
        self._logger.info(f"{topic.source}: {type_name}, to {', '.join(robots[k - 1] for k in topic.receivers)}")
        return True

    def _send(self, topic: RelayedTopic, receivers: Any, data: bytes, number: int) -> None:
        length = topic.bytes or len(data)
        if not (fault := self._transport.fault_of(length)):
            now_ns, payload = self._update_time(), (topic.source, data)
            self._transport.send(RadioMessage(topic.robot, topic.name, number, length, now_ns, receivers, payload))
        elif topic.source not in self._refused:
            self._refused.add(topic.source)
            self._logger.error(f"{topic.source}: a message cannot be sent: {fault}")

    def _report(self) -> None:
        """Publish counts and ages of each pair, and the state of the relay."""
        counts, robots = self._transport.counts, self._settings.robots
        missing = ", ".join(self._missing())
        values: dict[str, Any] = {"access": self._settings.access.access, "refused": ", ".join(sorted(self._refused))}
        statuses = [_status("relay", f"waits for {missing}" if missing else "relays", values)]
        for sender, receiver in np.argwhere(counts["sent"]).tolist():
            sums = {name: int(counts[name][sender, receiver]) for name in COUNTS}
            newest_ns = int(self._transport.newest_ns[receiver, sender])
            delay_ms = counts["delay_ns"][sender, receiver] / max(1, sums["received"]) / 1e6
            age = f"{(self._now_ns - newest_ns) / 1e6:.3f}" if newest_ns >= 0 else "-1"
            text = f"{sums['received']} of {sums['sent']} received"
            values = {**sums, "delay_mean_ms": f"{delay_ms:.3f}", "age_ms": age}
            statuses.append(_status(f"relay: {robots[sender]} to {robots[receiver]}", text, values))
        message = DiagnosticArray(status=statuses)
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._diagnostics.publish(message)


def _status(name: str, text: str, values: dict[str, Any]) -> DiagnosticStatus:
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return DiagnosticStatus(level=DiagnosticStatus.OK, name=name, message=text, hardware_id="simulated", values=pairs)


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
