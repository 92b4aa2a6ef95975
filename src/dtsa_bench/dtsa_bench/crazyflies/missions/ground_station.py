"""The ground station of a mission with Crazyflies: it orders, watches, and is alive."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray
from dtsa_msgs.msg import Status
from geometry_msgs.msg import Point
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Log
from rclpy.node import Node
from std_msgs.msg import Empty as EmptyMessage
from std_srvs.srv import Empty, Trigger

from dtsa_agent.core import Scenario, SwarmConfig, make_scenario
from dtsa_agent.crazyflie.node.interfaces import EVENTS, EVENTS_QOS, STATE, STOP_HERE, Arm, GoTo, Land, Takeoff
from dtsa_agent.crazyflie.orders import shortest_s
from dtsa_agent.crazyflie.settings import SwarmSettings
from dtsa_agent.crazyflie.state import to_map, to_world
from dtsa_agent.ros.common.loop import ExecutorThread
from dtsa_agent.stop import StopToken

from .mission_record import MissionLog
from .places import MissionError, assign_places, check_crossings, check_standing

ARRIVED_M = 0.12  # m: at its start when this close
CLIMB_MPS = 0.4
SHIFT_MPS = 0.3
BRIDGE_SILENT_S = 3.0
STOPPING_S = (1.2, 6.0)  # all come to rest within the first time; at the second they land wherever they are
FLYING = (Status.STATE_ARMED, Status.STATE_FLYING, Status.STATE_LANDING)
NOT_LANDED = (Status.STATE_FLYING, Status.STATE_LANDING, Status.STATE_LOST, Status.STATE_EMERGENCY)
BRIDGE_S = 60.0  # s, for the connections
AGENTS_S = 60.0  # s, for their process


class GroundStation:
    """The ground station's part: it calls the bridge's services, watches the vehicles, and sends its heartbeat.

    :param check_bridge: raises an error when the bridge's process has died; None: it is not a child of this process.
    """

    def __init__(
        self, node: Node, settings: SwarmSettings, scenario: Scenario, ended: StopToken, report: Callable[[str], None],
        check_bridge: Callable[[], None] | None = None,
    ) -> None:  # fmt: skip
        self.node, self.settings, self.scenario, self.ended, self.report = node, settings, scenario, ended, report
        self.status: dict[str, Status] = {}
        self.log = MissionLog()
        self.place: dict[str, tuple[float, float, float]] = {}
        self.last_status_time = time.monotonic()  # s, monotonic, the last status of anybody
        self.exchanging = False
        self.check_bridge_process = check_bridge or self._check_silence
        self._odometry: list[Any] = []
        for robot in settings.robots:
            name = robot.name
            node.create_subscription(Status, f"/{name}/{STATE}", partial(self._receive_status, name), 10)
            receive = partial(self._receive_odometry, name)
            self._odometry.append(node.create_subscription(Odometry, f"/{name}/odom", receive, 1))
        node.create_subscription(DiagnosticArray, "/diagnostics", self.log.diagnostic, 10)
        node.create_subscription(Log, EVENTS, self.log.event, EVENTS_QOS)
        self._heartbeat = node.create_publisher(EmptyMessage, "/all/heartbeat", 1)
        self._stop_here = node.create_publisher(EmptyMessage, STOP_HERE, 1)
        self._stopping: float | None = None  # s, monotonic, since when they are told to come to rest
        self._beating = threading.Event()
        self._over = threading.Event()
        # Made long before they are used: a server drops the answer to a client that it has not discovered yet.
        self._clients = {
            name: node.create_client(kind, name)
            for kind, name in (
                (Arm, "/all/arm"),
                (Takeoff, "/all/takeoff"),
                (Land, "/all/land"),
                (Empty, "/all/emergency"),
                (Trigger, "/all/end_heartbeat"),
                *((GoTo, f"/{robot.name}/go_to") for robot in settings.robots),
            )
        }
        self._serving = ExecutorThread(node, "mission")
        self._pulse = threading.Thread(target=self._beat, name="heartbeat", daemon=True)
        self._pulse.start()

    def _receive_status(self, name: str, message: Status) -> None:
        self.status[name] = message
        self.last_status_time = time.monotonic()
        self.log.status(name, message)
        if self.exchanging and message.state != Status.STATE_FLYING and not self.ended.reason:
            self.ended.reason = f"{name} is {message.state_name} ({message.reason})"

    def _receive_odometry(self, name: str, message: Odometry) -> None:
        p = message.pose.pose.position
        self.place[name] = to_map((p.x, p.y, p.z), self.settings.station.room_origin_in_world)

    def _beat(self) -> None:
        while not self._over.wait(0.1):
            if self._beating.is_set():
                self._heartbeat.publish(EmptyMessage())
            if self._stopping is not None:
                self._stop_here.publish(EmptyMessage())

    def _check_silence(self) -> None:
        silent = time.monotonic() - self.last_status_time
        if self.status and silent > BRIDGE_SILENT_S:
            raise MissionError(f"the bridge has been silent for {silent:.1f} s")

    def close(self) -> None:
        """End of all threads."""
        self._over.set()
        self._serving.close()
        self._pulse.join(2.0)

    def call(self, name: str, timeout: float = 10.0, **fields: Any) -> None:
        """Call a service and wait for its answer (s, at most).

        :raises MissionError: it does not answer or says no, or the user has interrupted.
        """
        self._check_goes_on()
        client = self._clients[name]
        future = client.call_async(client.srv_type.Request(**fields))
        end = time.monotonic() + timeout
        while not future.done():
            self.check_bridge_process()
            if time.monotonic() > end:
                raise MissionError(f"service {name} does not answer")
            time.sleep(0.005)
        if not getattr(future.result(), "success", True):
            raise MissionError(f"{name}: {future.result().message}")

    def _check_goes_on(self) -> None:
        self.check_bridge_process()
        if self.ended:
            raise MissionError(self.ended.reason or "interrupted")

    def wait(self, what: str, condition: Callable[[], bool], timeout: float) -> None:
        """Wait until something is so (s, at most); MissionError: it takes too long, or the user interrupts."""
        end = time.monotonic() + timeout
        while not condition():
            self._check_goes_on()
            if time.monotonic() > end:
                missing = [f"{n} {s.state_name} ({s.reason})" for n, s in self.status.items()]
                raise MissionError(f"{what} took longer than {timeout:g} s: {', '.join(missing)}")
            time.sleep(0.02)

    def _all(self, *states: int) -> bool:
        return len(self.status) == len(self.settings.robots) and all(s.state in states for s in self.status.values())

    def _any(self, *states: int) -> bool:
        return any(s.state in states for s in self.status.values())

    def connect(self, config: SwarmConfig) -> SwarmConfig:
        """Wait until the bridge is up and all are ready; the configuration in which all begin near where they stand.

        :raises MissionError: it is not safe to begin.
        """
        emergency = self._clients["/all/emergency"]
        self.wait("the bridge's start", emergency.service_is_ready, BRIDGE_S)
        self._beating.set()
        self.wait("the connection", self._all_ready, 10.0)
        vehicles = [robot.name for robot in self.settings.robots]
        self.wait("odometry", lambda: len(self.place) == len(vehicles), 5.0)
        measured = np.array([self.place[name] for name in vehicles]).T
        check_standing(vehicles, measured, self.settings.station.safety)
        assigned = assign_places(config, measured)
        self.scenario = make_scenario(assigned)
        check_crossings(self.scenario, vehicles, measured)
        return assigned

    def _all_ready(self) -> bool:
        locked = [f"{n} ({s.reason})" for n, s in self.status.items() if s.state == Status.STATE_EMERGENCY]
        if locked:
            raise MissionError(f"switch off and on before the next flight: {', '.join(locked)}")
        return self._all(Status.STATE_READY)

    def wait_for_agents(self, alive: Callable[[], None]) -> None:
        """Wait until the agents' process, which `alive` checks, offers commands for all; MissionError: not in time."""
        topics = [f"/{robot.name}/cmd_velocity_world" for robot in self.settings.robots]

        def offered() -> bool:
            alive()
            return all(self.node.count_publishers(topic) for topic in topics)

        self.wait("the agents' start", offered, AGENTS_S)

    def take_off(self) -> None:
        """Arm, climb to the middle of the room, go to the start."""
        self.report("arming")
        self.call("/all/arm", arm=True)
        self.wait("arming", lambda: self._all(Status.STATE_ARMED), 5.0)
        height = self.settings.station.room_origin_in_world[2]
        limit = self.settings.station.max_speed_mps
        seconds = max(2.0, height / CLIMB_MPS, shortest_s(height, limit))
        self.report("take-off")
        self.call("/all/takeoff", height=height, duration=_duration(seconds))
        over = time.monotonic() + seconds
        self.wait("the take-off", lambda: time.monotonic() > over and self._all(Status.STATE_FLYING), seconds + 5.0)
        way = self._largest_distance_to_start()
        seconds = 1.5 + max(way / SHIFT_MPS, shortest_s(way, limit))  # for all: their ways keep apart if flown together
        for robot, start in zip(self.settings.robots, self.scenario.start.T.tolist(), strict=True):
            x, y, z = to_world(tuple(start), self.settings.station.room_origin_in_world)
            goal = Point(x=x, y=y, z=z)
            self.call(f"/{robot.name}/go_to", goal=goal, duration=_duration(seconds))
        self.wait("the way to the start", lambda: self._largest_distance_to_start() < ARRIVED_M, seconds + 15.0)
        over = time.monotonic() + 0.5  # the last go_to is flown to its end before streamed commands count
        self.wait("the last go_to", lambda: time.monotonic() > over, 1.0)
        # Not needed any more: the station has better things to do. Only the executor's own thread may take them away.
        self._serving.executor.create_task(self._forget_odometry)
        self.exchanging = True

    def _forget_odometry(self) -> None:
        while self._odometry:
            self.node.destroy_subscription(self._odometry.pop())

    def _largest_distance_to_start(self) -> float:
        starts = zip(self.settings.robots, self.scenario.start.T.tolist(), strict=True)
        return max(math.dist(self.place[robot.name], start) for robot, start in starts)

    @property
    def not_landed(self) -> list[str]:
        """Names of those that are in the air, or may be, or fell, by their last status."""
        return [name for name, s in sorted(self.status.items()) if s.state in NOT_LANDED]

    def at_rest(self, apart: Callable[[], bool]) -> bool:
        """Tell all that fly to come to rest, none above another one; True once they are apart, or time is up."""
        now = time.monotonic()
        if self._stopping is None:
            self._stopping = now
            self._stop_here.publish(EmptyMessage())
        least, most = STOPPING_S
        return now - self._stopping > most or (now - self._stopping > least and apart())

    def land(self, urgent: Callable[[], bool]) -> None:
        """Land all that are in the air and wait until they stand; once it is `urgent`, all motors stop."""
        self.exchanging = False
        if self._any(*FLYING):
            self.report("landing")
            duration = _duration(max(2.0, self.settings.station.room_origin_in_world[2] / CLIMB_MPS))
            answer = self._clients["/all/land"].call_async(Land.Request(duration=duration))
            end = time.monotonic() + self.settings.station.landing_timeout_s
            while time.monotonic() < end and self._any(*FLYING) and not urgent():
                if time.monotonic() - self.last_status_time > BRIDGE_SILENT_S:
                    self.report("the bridge is silent: what flies is left to its own watchdogs")
                    break
                time.sleep(0.05)
            answer.cancel()
        if urgent() and self._any(*FLYING, Status.STATE_LOST):
            self.report("EMERGENCY STOP")
            self._clients["/all/emergency"].call_async(Empty.Request())
            time.sleep(0.5)
        self._beating.clear()  # before: the silence that follows a later one would stop whatever is armed then
        end_heartbeat = self._clients["/all/end_heartbeat"]
        if end_heartbeat.service_is_ready():
            future = end_heartbeat.call_async(Trigger.Request())
            end = time.monotonic() + 2.0
            while not future.done() and time.monotonic() < end:
                time.sleep(0.01)


def _duration(seconds: float) -> Duration:
    return Duration(sec=int(seconds), nanosec=int((seconds % 1.0) * 1e9))
