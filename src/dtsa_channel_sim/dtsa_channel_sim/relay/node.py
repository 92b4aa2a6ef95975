"""``ros2 run dtsa_channel_sim relay``: topics of any robots over the shared medium (docs/how-to/relay.md)."""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from numpy.typing import NDArray
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from scipy.spatial.transform import Rotation

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Setting
from dtsa_agent.ros.common.checks import UNREADABLE, BadMessage, Intake, check_numbers
from dtsa_agent.ros.common.node_process import ending, run_node
from dtsa_agent.ros.common.parameters import check_parameters, declare_setting
from dtsa_agent.stop import Stop
from dtsa_agent.yaml_file import read_mapping

from .settings import RelayedTopic, RelaySettings, full_name
from .transport import COUNTS, RadioMessage, Transport

_CONFIG = Setting("config", "file", "", "YAML file: robots, topics, channel")
_DEPTH = 100  # messages of a topic that wait for the relay
_POLL_S, _SHORTEST_POLL_S = 0.05, 0.0005
_LOOK_S, _REPORT_S, _REMIND_S = 0.5, 1.0, 10.0  # for topics that are awaited; diagnostics; lines about the former
_JUMP_NS = 10_000_000_000  # by which no clock moves on its own
_NO_EVENTS = PublisherEventCallbacks(use_default_callbacks=False)  # an executor looks at each one every time
_MAX_FRAMES, _MAX_DEPTH = 10_000, 64  # of /tf


def message_class(name: str) -> Any:
    """Return the class of a message type, ``package/msg/Name``; a ConfigError if its package is not installed."""
    package, _, kind = name.partition("/msg/")
    try:
        found = getattr(import_module(f"{package}.msg"), kind)
        found.__class__.__import_type_support__()
    except Exception as error:  # what a package that is half there raises has no common base
        raise ConfigError("type", name, f"an installed message type ({error})") from None
    return found


class TransformTree:
    """Frames of /tf: each child's place in its parent, m, and its rotation."""

    def __init__(self, root: str) -> None:
        self._root = root.strip("/")
        self._frames: dict[str, tuple[str, Any, Any]] = {}

    def accept(self, message: Any) -> None:
        """Keep the transforms of a tf2_msgs/TFMessage; raise BadMessage if one cannot be."""
        for entry in message.transforms:
            child, place, q = entry.child_frame_id.strip("/"), entry.transform.translation, entry.transform.rotation
            check_numbers("transforms", (place.x, place.y, place.z, q.x, q.y, q.z, q.w))
            if any((q.x, q.y, q.z, q.w)) and (child in self._frames or len(self._frames) < _MAX_FRAMES):
                turn = Rotation.from_quat((q.x, q.y, q.z, q.w))
                self._frames[child] = entry.header.frame_id.strip("/"), np.array((place.x, place.y, place.z)), turn

    def place_of(self, frame: str) -> NDArray[np.float64]:
        """Return where a frame is in the root, (3,) m; not numbers if nothing connects them."""
        frame, place = frame.strip("/"), np.zeros(3)
        for _ in range(_MAX_DEPTH):
            if frame == self._root:
                return place
            if frame not in self._frames:
                break
            frame, offset, turn = self._frames[frame]
            place = turn.apply(place) + offset
        return np.full(3, np.nan)


class RobotPlaces:
    """Where robots are: (3, N) m; not numbers until it is known."""

    def __init__(self, node: Node, settings: RelaySettings) -> None:
        self.positions = np.full((3, len(settings.robots)), np.nan)
        self._node, self._intake = node, Intake(node.get_logger())
        self._tree = TransformTree(settings.map_frame)
        self._frames = [(row, value) for row, (kind, value) in enumerate(settings.places) if kind == "tf"]
        for row, (kind, value) in enumerate(settings.places):
            if kind == "place":
                self.positions[:, row] = value
            elif kind == "odometry":
                topic = full_name(settings.robots[row], value, kind)
                qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
                self._subscribe("nav_msgs/msg/Odometry", topic, qos, partial(self._accept_odometry, row))
        latched = QoSProfile(depth=_DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for topic, qos in (("/tf", QoSProfile(depth=_DEPTH)), ("/tf_static", latched)) if self._frames else ():
            self._subscribe("tf2_msgs/msg/TFMessage", topic, qos, self._accept_transforms)

    def _subscribe(self, type_name: str, topic: str, qos: QoSProfile, use: Callable[[Any], None]) -> None:
        kind = message_class(type_name)

        def accept(data: bytes) -> None:
            with self._intake.guard():
                try:
                    message = deserialize_message(data, kind)
                except Exception as error:  # rclpy has no common base
                    raise BadMessage(UNREADABLE, f"no {type_name}: {(str(error).splitlines() or [''])[0]}") from None
                use(message)

        self._node.create_subscription(kind, topic, accept, qos, raw=True)

    def _accept_odometry(self, row: int, message: Any) -> None:
        place = message.pose.pose.position
        check_numbers("places", (place.x, place.y, place.z))
        self.positions[:, row] = place.x, place.y, place.z

    def _accept_transforms(self, message: Any) -> None:
        self._tree.accept(message)
        for row, frame in self._frames:
            self.positions[:, row] = self._tree.place_of(frame)


class Relay:
    """Takes messages from robots, lets the medium carry them, and gives them to those that received them."""

    def __init__(self, node: Node, settings: RelaySettings) -> None:
        self._node, self._settings, self._logger = node, settings, node.get_logger()
        self._transport, self._places = Transport(settings.access, settings.channel), RobotPlaces(node, settings)
        for topic in settings.topics:
            if topic.message_type:
                message_class(topic.message_type)
        self._awaited = list(settings.topics)
        self._publishers: dict[tuple[str, int], Publisher] = {}  # by source and the receiver's row
        self._refused: set[str] = set()  # sources with messages that do not fit
        self._diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._clock_ns, self._now_ns = node.get_clock().now().nanoseconds, 0
        self._look_s = self._report_s = 0.0
        self._remind_s = time.monotonic() + 2 * _LOOK_S

    def run(self, stop: Stop) -> None:
        """Relay until a signal."""
        executor = SingleThreadedExecutor(context=self._node.context)
        executor.add_node(self._node)
        while not stop and self._node.context.ok():
            wait_s = (self._transport.due_ns - self._update_time()) / 1e9
            executor.spin_once(timeout_sec=min(_POLL_S, max(_SHORTEST_POLL_S, wait_s)))
            for message, received in self._transport.advance(self._update_time(), self._places.positions):
                source, data = message.payload
                for row in np.flatnonzero(received).tolist():
                    self._publishers[source, row].publish(data)
            self._keep_house(time.monotonic())

    def _update_time(self) -> int:
        """Return the time of the transport, ns: by the node's clock, but it stands still when that jumps."""
        clock_ns = self._node.get_clock().now().nanoseconds
        step_ns, self._clock_ns = clock_ns - self._clock_ns, clock_ns
        if 0 <= step_ns <= _JUMP_NS:
            self._now_ns += step_ns
        elif self._now_ns:
            self._logger.warning(f"the clock has jumped by {step_ns / 1e9:.3g} s")
        return self._now_ns

    def _keep_house(self, now_s: float) -> None:
        if now_s >= self._look_s:
            self._look_s = now_s + _LOOK_S
            self._awaited = [topic for topic in self._awaited if not self._open(topic)]
        if now_s >= self._remind_s:
            self._remind_s = now_s + _REMIND_S
            for text in self._missing():
                self._logger.info(f"waits for {text}")
        if now_s >= self._report_s:
            self._report_s = now_s + _REPORT_S
            self._report()

    def _missing(self) -> list[str]:
        unknown = np.isnan(self._places.positions[0])
        return [topic.source for topic in self._awaited] + [
            f"the place of {name} ({kind}: {value})"
            for name, (kind, value), missing in zip(self._settings.robots, self._settings.places, unknown, strict=True)
            if kind and missing
        ]

    def _open(self, topic: RelayedTopic) -> bool:
        """Subscribe to a topic if it has a publisher; return whether nothing is left to do."""
        publishers = self._node.get_publishers_info_by_topic(topic.source)
        if not publishers:
            return False
        kind, robots = publishers[0].topic_type, self._settings.robots
        try:
            if topic.message_type not in ("", kind):
                raise ConfigError("type", kind, f"{topic.message_type}, as the file says")
            message_type = message_class(kind)
        except ConfigError as error:
            self._logger.error(f"{topic.source}: {error}")
            return True
        profiles = [info.qos_profile for info in publishers]
        reliable = all(profile.reliability == ReliabilityPolicy.RELIABLE for profile in profiles)
        latched = all(profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for profile in profiles)
        qos = QoSProfile(
            depth=_DEPTH,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        receivers = np.zeros(len(robots), np.bool_)
        for receiver in topic.receivers:
            receivers[receiver - 1] = True
            name = f"/{robots[receiver - 1]}/from/{robots[topic.robot - 1]}/{topic.name.strip('/')}"
            publisher = self._node.create_publisher(message_type, name, qos, event_callbacks=_NO_EVENTS)
            self._publishers[topic.source, receiver - 1] = publisher

        numbers = itertools.count(1)

        def accept(taken: Any) -> None:
            for _ in range(_DEPTH):  # an executor takes one at a time, and long for it
                data, info = taken
                number = info["publication_sequence_number"] or next(numbers)
                self._send(topic, receivers, data, number)
                taken = subscription.handle.take_message(message_type, True)
                if taken is None:
                    return

        # Two parameters: rclpy then gives the number of the message, too.
        subscription = self._node.create_subscription(
            message_type, topic.source, lambda data, info: accept((data, info)), qos, raw=True
        )
        self._logger.info(f"{topic.source}: {kind}, to {', '.join(robots[k - 1] for k in topic.receivers)}")
        return True

    def _send(self, topic: RelayedTopic, receivers: Any, data: bytes, number: int) -> None:
        length = topic.length or len(data)
        if not (fault := self._transport.fault_of(length)):
            now_ns, payload = self._update_time(), (topic.source, data)
            self._transport.send(RadioMessage(topic.robot, topic.name, number, length, now_ns, receivers, payload))
        elif topic.source not in self._refused:
            self._refused.add(topic.source)
            self._logger.error(f"{topic.source}: a message cannot be sent: {fault}")

    def _report(self) -> None:
        """Publish what has become of the messages of each pair, and of the relay."""
        counts, robots = self._transport.counts, self._settings.robots
        missing = ", ".join(self._missing())
        about = {"access": self._settings.access.access, "refused": ", ".join(sorted(self._refused))}
        statuses = [_status("relay", f"waits for {missing}" if missing else "relays", about)]
        for sender, receiver in np.argwhere(counts["sent"]).tolist():
            values = {name: int(counts[name][sender, receiver]) for name in COUNTS}
            newest_ns = int(self._transport.newest_ns[receiver, sender])
            delay_ms = counts["delay_ns"][sender, receiver] / max(1, values["received"]) / 1e6
            more = {
                "delay_mean_ms": f"{delay_ms:.3f}",
                "age_ms": f"{(self._now_ns - newest_ns) / 1e6:.3f}" if newest_ns >= 0 else "-1",
            }
            text = f"{values['received']} of {values['sent']} received"
            statuses.append(_status(f"relay: {robots[sender]} to {robots[receiver]}", text, {**values, **more}))
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


def main(args: Sequence[str] | None = None) -> int:
    """Runs the node."""
    return run_node("relay", _body, args)


if __name__ == "__main__":
    sys.exit(main())
