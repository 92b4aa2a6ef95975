"""The ground station of the bridge's benchmark: calls the services, streams numbered commands, reads the status."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration
from dtsa_msgs.msg import Status, VelocityWorld
from dtsa_msgs.srv import Arm, Land, Takeoff
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Empty

from dtsa_agent.core.errors import DtsaError
from dtsa_agent.ros.common.process.node_process import init_ros
from dtsa_agent.ros.common.workarounds.dds import limit_to_machine

from .stamped_fleet import STEP_MPS

Step = Callable[[str, Callable[[], object]], None]


class Pilot:
    """Listens to all that a swarm's agents listen to, and commands everybody.

    :param domain: ROS domain.
    :param count: Crazyflies, cf1 to cfN.
    """

    def __init__(self, domain: int, count: int) -> None:
        self._context = Context()
        limit_to_machine(os.environ, shared_memory=False)
        init_ros([], self._context, domain)
        self._node = Node("benchmark", context=self._context, enable_rosout=False, start_parameter_services=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._status: list[Status | None] = [None] * count
        self._statuses, self._outputs, self._odometry = [], [], []
        for k in range(count):
            keep = self._keep(k)
            self._statuses.append(self._node.create_subscription(Status, f"/cf{k + 1}/status", keep, 10))
            # Only what somebody listens to is sent; what comes is not of interest here.
            self._odometry.append(self._node.create_subscription(Odometry, f"/cf{k + 1}/odom", lambda _: None, 1))
            self._outputs.append(self._node.create_publisher(VelocityWorld, f"/cf{k + 1}/cmd_velocity_world", 1))
        # Made long before they are used: a server drops answers to a client that it has not found yet.
        services = {"emergency": Empty, "arm": Arm, "takeoff": Takeoff, "land": Land}
        self._clients = {name: self._node.create_client(kind, f"/all/{name}") for name, kind in services.items()}
        self.first = 1  # number of the first command of the latest stream; 0 is nobody's
        self._sent = 0  # commands in it

    def _keep(self, k: int) -> Callable[[Status], None]:
        def keep(message: Status) -> None:
            self._status[k] = message

        return keep

    def spin(self, timeout: float) -> None:
        """Serve what comes in for a while, s."""
        self._executor.spin_once(timeout_sec=timeout)

    def close(self) -> None:
        """End."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def ready(self) -> bool:
        """Whether all services are there and everybody is ready."""
        return all(client.service_is_ready() for client in self._clients.values()) and self._all(Status.STATE_READY)

    def _all(self, state: int) -> bool:
        return all(status is not None and status.state == state for status in self._status)

    def _call(self, step: Step, name: str, **fields: Any) -> None:
        client = self._clients[name]
        step(name, client.call_async(client.srv_type.Request(**fields)).done)

    def take_off(self, step: Step, height: float, seconds: float) -> None:
        """Arm all and climb.

        :param step: waits until something is so.
        :param height: m above the floor.
        :param seconds: s that it takes.
        """
        self._call(step, "arm", arm=True)
        step("arming", lambda: self._all(Status.STATE_ARMED))
        self._call(step, "takeoff", height=height, duration=_duration(seconds))
        climbed = time.monotonic() + seconds + 0.5
        step("the take-off", lambda: self._all(Status.STATE_FLYING) and time.monotonic() > climbed)

    def land(self, step: Step, seconds: float) -> None:
        """Land all and wait until the motors are locked."""
        self._call(step, "land", duration=_duration(seconds))
        step("the landing", lambda: self._all(Status.STATE_READY))

    def stream(self, rate_hz: float, seconds: float) -> NDArray[np.float64]:
        """Publish zero velocity, with a number hidden in it, to each at a fixed rate.

        :returns: time of each command, s (system clock), shape (count, n); the first has the number `first`.
        """
        number = round(rate_hz * seconds)
        times = np.empty((len(self._outputs), number))
        self.first, message = self.first + self._sent, VelocityWorld()
        begun = time.monotonic()
        for i in range(number):
            time.sleep(max(0.0, begun + i / rate_hz - time.monotonic()))
            message.vel.x = (self.first + i) * STEP_MPS
            for k, publisher in enumerate(self._outputs):
                times[k, i] = time.time()
                publisher.publish(message)
        self._sent = number
        time.sleep(max(0.0, begun + number / rate_hz - time.monotonic()))
        return times

    def received(self) -> list[tuple[float, int]]:
        """For each Crazyflie the time (s) of its latest status and the log packets that had come by then."""
        result = []
        for k, subscription in enumerate(self._statuses):
            while (taken := subscription.handle.take_message(Status, False)) is not None:
                self._status[k] = taken[0]
            status = self._status[k]
            assert status is not None
            stamp = status.header.stamp
            result.append((stamp.sec + 1e-9 * stamp.nanosec, status.num_rx_unicast))
        return result

    def log_rates(self, before: list[tuple[float, int]]) -> list[float]:
        """Log packets a second that reached the bridge since then, for each.

        :param before: what `received` said.
        :raises DtsaError: nothing was heard of one.
        """
        pairs = list(zip(before, self.received(), strict=True))
        if any(t1 <= t0 for (t0, _), (t1, _) in pairs):
            raise DtsaError("no status of a Crazyflie came while its log packets were counted")
        return [(n1 - n0) / (t1 - t0) for (t0, n0), (t1, n1) in pairs]


def _duration(seconds: float) -> Duration:
    return Duration(sec=int(seconds), nanosec=int(seconds % 1 * 1e9))
