"""Logs at run time: a topic of Crazyswarm2's LogDataGeneric for variables of the firmware."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node

from dtsa_agent.crazyflie.node.bridge import Bridge
from dtsa_agent.crazyflie.vehicle.vehicle import Vehicle

from .interfaces import Interfaces

ALWAYS = frozenset({"pose", "odom", "status"})  # published while somebody listens
STATISTICS = "warnings.communication.publish_stats"


class Logs:
    """The services `add_logging` and `remove_logging` of each vehicle, and statistics of the links.

    :param node: offers and publishes.
    :param bridge: the swarm.
    :param say: called with a level and a line about each order.
    :param interfaces: Crazyswarm2's messages.
    """

    def __init__(self, node: Node, bridge: Bridge, say: Callable[[str, str], None], interfaces: Interfaces) -> None:
        self._node, self._bridge, self._say, self._interfaces = node, bridge, say, interfaces
        self._publishers: dict[str, Any] = {}
        self._lock = threading.Lock()
        self._counted: dict[str, tuple[int, int]] = {}

    def offer(self) -> None:
        """Create the services, and the statistics if they are asked for."""
        srv, msg = self._interfaces.srv, self._interfaces.msg
        for name, vehicle in self._bridge.vehicles.items():
            self._node.create_service(srv.AddLogging, f"{name}/add_logging", partial(self._add, vehicle))
            self._node.create_service(srv.RemoveLogging, f"{name}/remove_logging", partial(self._remove, vehicle))
            for topic in vehicle.robot.firmware_logging.values():
                if problem := self._begin(vehicle, topic.name, topic.frequency, list(topic.variables)):
                    self._say("warn", f"{name}: firmware_logging: {problem}")
        if self._node.declare_parameter(STATISTICS, False).value:
            self._statistics = {
                name: self._node.create_publisher(msg.ConnectionStatisticsArray, f"{name}/connection_statistics", 10)
                for name in self._bridge.vehicles
            }
            self._node.create_timer(1.0, self._publish_statistics)

    def _add(self, vehicle: Vehicle, request: Any, response: Any) -> Any:
        topic, rate = request.topic_name, request.frequency
        problem = "" if topic in ALWAYS else self._begin(vehicle, topic, rate, list(request.vars))
        self._said(vehicle, f"add_logging ({topic}, {rate} Hz, {', '.join(request.vars)})", problem)
        response.success = not problem
        return response

    def _begin(self, vehicle: Vehicle, topic: str, rate: float, variables: list[str]) -> str:
        if not rate > 0.0:
            return f"{topic}: {rate} Hz"
        path = f"{vehicle.name}/{topic}"
        new = path not in self._publishers  # it stays when the link ends
        if new:
            try:
                publisher = self._node.create_publisher(self._interfaces.msg.LogDataGeneric, path, 10)
            except InvalidTopicNameException as error:
                return str(error).splitlines()[0]
            self._publishers[path] = publisher
        period = max(10, round(100 / rate) * 10)
        problem = vehicle.onboard.add_log(topic, period, variables, partial(self._publish, path, variables))
        if problem and new:
            self._end(path)
        return problem

    def _publish(self, path: str, variables: list[str], stamp: int, values: Mapping[str, float]) -> None:
        message = self._interfaces.msg.LogDataGeneric(timestamp=stamp)
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.header.frame_id = "world"
        message.values = [float(values[name]) for name in variables]
        with self._lock:
            if (publisher := self._publishers.get(path)) is not None:
                publisher.publish(message)

    def _end(self, path: str) -> None:
        with self._lock:
            publisher = self._publishers.pop(path, None)
        if publisher is not None:
            self._node.destroy_publisher(publisher)

    def _remove(self, vehicle: Vehicle, request: Any, response: Any) -> Any:
        problem = vehicle.onboard.remove_log(request.topic_name)
        self._end(f"{vehicle.name}/{request.topic_name}")
        self._said(vehicle, f"remove_logging ({request.topic_name})", problem)
        response.success = not problem
        return response

    def _said(self, vehicle: Vehicle, order: str, problem: str) -> None:
        self._say("warn" if problem else "info", f"order /{vehicle.name}/{order}: {problem or 'done'}")

    def _publish_statistics(self) -> None:
        msg = self._interfaces.msg
        for name, vehicle in self._bridge.vehicles.items():
            sent, received = vehicle.link.sent, vehicle.link.received
            before = self._counted.get(name, (0, 0))
            self._counted[name] = sent, received
            message = msg.ConnectionStatisticsArray()
            message.header.stamp = self._node.get_clock().now().to_msg()
            message.header.frame_id = "world"
            message.stats = [
                msg.ConnectionStatistics(
                    uri=vehicle.robot.uri, sent_count=sent - before[0], receive_count=received - before[1]
                )
            ]
            self._statistics[name].publish(message)
