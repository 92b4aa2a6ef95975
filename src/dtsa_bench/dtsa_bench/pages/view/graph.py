"""A swarm on the ROS graph as a source of moments: a node that listens, and for which no agent ever waits."""

from __future__ import annotations

import math
import os
import re
import time
from collections import deque
from dataclasses import dataclass
from itertools import islice
from typing import Any

from builtin_interfaces.msg import Duration
from dtsa_msgs.msg import Configuration, RunStatus, SlotRecord, Status
from dtsa_msgs.srv import Land
from rcl_interfaces.msg import ParameterEvent
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from std_srvs.srv import Empty

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.checks import Intake
from dtsa_agent.ros.common.loop import Feed
from dtsa_agent.ros.common.node_process import init_ros, limit_to_machine

from .follower import Follower
from .history import PageCommand, RunHistory, VehicleStates

_POLL_S = 0.02
_VEHICLES_S = 0.05  # wall time between polls of the vehicles
_MAX_WAITING = 500  # messages that wait for the next poll
_ENDED = 2  # RunStatus.ENDED
_MAX_COMMANDS = 20  # that wait
_ANSWER_S = 5.0
_LAND_S = 3
_STATUS_TYPE = "dtsa_msgs/msg/Status"
_SEARCH_S = 1.0  # between searches of the graph for vehicles
_MAX_VEHICLES = 200
_SILENT_S = 2.0  # the bridge publishes the status of each five times a second
_STATE_LENGTH, _REASON_LENGTH = 20, 80  # characters that are shown

VehicleRow = tuple[str, str, float, float, str]  # as in `VehicleStates`


def _listening(depth: int) -> QoSProfile:
    """QoS of a listener that no publisher waits for; `depth`: messages that wait for it, of more the last."""
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)


class GraphSource:
    """Follows the swarm of a namespace, run after run.

    :param domain: ROS domain; None: that of the environment.
    :param space: namespace of the swarm.
    :param control: whether commands of a page are carried out.
    """

    def __init__(
        self, history: RunHistory, domain: int | None = None, space: str = names.SWARM, control: bool = False
    ) -> None:
        self._history, self._space = history, space
        limit_to_machine(os.environ)
        self._context = Context()
        init_ros(None, self._context, domain)
        self._node = Node(
            "view", namespace=space, context=self._context, enable_rosout=False, start_parameter_services=False
        )
        self._intake = Intake(self._node.get_logger())
        self._settings = self._feed(Configuration, f"{space}/{names.CONFIGURATION}", names.latched_qos())
        self._status = self._feed(RunStatus, f"{space}/{names.STATUS}", names.latched_qos())
        waiting = _listening(_MAX_WAITING)
        self._changes = self._feed(ParameterEvent, "/parameter_events", waiting)
        self._records = self._feed(SlotRecord, f"{space}/{names.SLOT_RECORD}", waiting)
        self._vehicles = VehicleWatch(self._node, self._intake, history, names.swarm_prefix(space))
        self._commands = _Commands(self._node, self._context, space) if control else None
        self._run = 0
        self._newest_status: RunStatus | None = None  # until it is shown: settings of its run may come later
        self._follower: Follower | None = None
        self.stopped = False

    def _feed(self, message_type: Any, topic: str, qos: QoSProfile) -> Feed:
        return Feed(self._node, message_type, topic, qos, intake=self._intake)

    def run(self) -> None:
        """Listen until ``stopped`` is set."""
        self._history.state = "waiting for a swarm"
        next_poll_s = 0.0
        try:
            while not self.stopped and self._context.ok():
                self._follow_runs()
                if (now := time.monotonic()) >= next_poll_s:
                    next_poll_s = now + _VEHICLES_S
                    self._vehicles.poll(now)
                if self._follower is not None:
                    self._receive(self._follower)
                for text in self._commands.carry_out() if self._commands else ():
                    self._vehicles.answer = text
                    if self._follower is not None:
                        self._follower.note(text)
                time.sleep(_POLL_S)
            self._follow_runs()  # the run may have ended since the last poll
        finally:
            self._vehicles.close()
            for feed in (self._settings, self._status, self._changes, self._records):
                feed.close()
            if self._commands:
                self._commands.close()
            self._node.destroy_node()
            self._context.try_shutdown()

    def command(self, command: PageCommand) -> str:
        """Accept a command; its result appears among the events.

        :raises ConfigError: if it cannot be one.
        """
        if self._commands is None:
            raise ConfigError("command", command.kind, "only with --control")
        return self._commands.accept(command)

    def _follow_runs(self) -> None:
        """Receive which run is under way, and how it is doing."""
        message = self._settings.take()
        if message is not None and message.run != self._run:
            self._run = message.run
            self._follower = Follower(self._history, {"live": True, "control": self._commands is not None})
            self._follower.receive("Configuration", message)
            if not self._follower.has_settings:
                self._follower = None
                return
        status = self._newest_status = self._status.take() or self._newest_status
        if status is not None and self._follower is not None and status.run == self._run:
            self._newest_status = None
            if status.phase == _ENDED:
                self._receive(self._follower)
            self._follower.receive("RunStatus", status)
            if status.phase == _ENDED:
                self._follower.finish("ended")

    def _receive(self, follower: Follower) -> None:
        """Receive the messages since the last poll."""
        for event in islice(iter(self._changes.take, None), _MAX_WAITING):
            if event.node == f"{self._space}/channel":
                follower.receive("ParameterEvent", event)
        for record in islice(iter(self._records.take, None), _MAX_WAITING):
            if record.run == self._run:
                follower.receive("SlotRecord", record)


@dataclass(slots=True)
class _Vehicle:
    feed: Feed
    heard_s: float  # time.monotonic() of the last status
    row: VehicleRow | None = None

    def row_now(self, now: float) -> VehicleRow | None:
        """Return its last status, or "silent" where that is long ago."""
        if self.row is None or now - self.heard_s <= _SILENT_S:
            return self.row
        name, state, battery, _, _ = self.row
        return name, f"silent ({state})"[:_STATE_LENGTH], battery, 0.0, "the bridge reports nothing of it"


class VehicleWatch:
    """Finds the vehicles of a bridge, whose names have a prefix, as ``/north``, and adds them to a history."""

    def __init__(self, node: Node, intake: Intake, history: RunHistory, prefix: str = "") -> None:
        self._node, self._intake, self._history = node, intake, history
        self._topic = re.compile(f"{re.escape(prefix)}/([A-Za-z][A-Za-z0-9_]{{0,40}})/(?:{names.STATUS}|state)")
        self._vehicles: dict[str, _Vehicle] = {}
        self._search_s = 0.0
        self.answer = ""  # result of the last command

    def poll(self, now: float) -> None:
        """Receive statuses, and search for new vehicles; `now`: s, ``time.monotonic()``."""
        if now >= self._search_s:
            self._search_s = now + _SEARCH_S
            self._search(now)
        for name, vehicle in self._vehicles.items():
            message = vehicle.feed.take()
            if message is not None and math.isfinite(message.battery_voltage) and math.isfinite(message.link_quality):
                numbers = round(message.battery_voltage, 2), round(message.link_quality, 2)
                vehicle.row = name, message.state_name[:_STATE_LENGTH], *numbers, message.reason[:_REASON_LENGTH]
                vehicle.heard_s = now
        rows = [vehicle.row_now(now) for vehicle in self._vehicles.values()]
        states = VehicleStates(tuple(row for row in rows if row is not None), self.answer)
        if states.rows and states != self._history.vehicles:
            self._history.vehicles = states

    def _search(self, now: float) -> None:
        vehicles = dict(self._vehicles)
        for topic, types in self._node.get_topic_names_and_types():
            match = self._topic.fullmatch(topic) if _STATUS_TYPE in types else None
            if match and match[1] not in vehicles and len(vehicles) < _MAX_VEHICLES:
                feed = Feed(self._node, Status, topic, _listening(1), intake=self._intake)
                vehicles[match[1]] = _Vehicle(feed, now)
        self._vehicles = {name: vehicles[name] for name in sorted(vehicles, key=_by_number)}

    def close(self) -> None:
        """Stop listening."""
        for vehicle in self._vehicles.values():
            vehicle.feed.close()


def _by_number(name: str) -> tuple[str, int]:
    letters = name.rstrip("0123456789")
    return letters, int(name[len(letters) :] or 0)


class _Commands:
    """Carries out commands by the services of the channel's node and of the bridge."""

    def __init__(self, node: Node, context: Context, space: str) -> None:
        self._channel = node.create_client(SetParameters, f"{space}/channel/set_parameters")
        self._land = node.create_client(Land, "/all/land")
        self._stop = node.create_client(Empty, "/all/emergency")
        self._waiting: deque[PageCommand] = deque(maxlen=_MAX_COMMANDS)
        self._calls: list[tuple[str, float, Future]] = []  # text, deadline, answer
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(node)

    def accept(self, command: PageCommand) -> str:
        """Accept a command; called by the server's thread."""
        self._waiting.append(command)
        return f"ordered: {command.kind}"

    def carry_out(self) -> list[str]:
        """Call the services without waiting; return the results that are there, as people read them."""
        results = []
        while self._waiting:
            command = self._waiting.popleft()
            client, request = self._request(command)
            text = f"{command.kind} {command.value!r}" if client is self._channel else command.kind
            if not client.service_is_ready():
                results.append(f"refused: {text}: no node offers {client.srv_name}")
            else:
                self._calls.append((text, time.monotonic() + _ANSWER_S, client.call_async(request)))
        if self._calls:
            self._executor.spin_once(timeout_sec=0.0)
        for call in list(self._calls):
            text, deadline, future = call
            if future.done() or time.monotonic() > deadline:
                self._calls.remove(call)
                results.append(f"{text}: {_answer_text(future.result()) if future.done() else 'no answer'}")
        return results

    def _request(self, command: PageCommand) -> tuple[Any, Any]:
        if command.kind == "land":
            return self._land, Land.Request(height=0.0, duration=Duration(sec=_LAND_S))
        if command.kind == "emergency":
            return self._stop, Empty.Request()
        parameter = Parameter(command.kind, value=command.value).to_parameter_msg()
        return self._channel, SetParameters.Request(parameters=[parameter])

    def close(self) -> None:
        """Release the executor."""
        self._executor.shutdown(timeout_sec=0)


def _answer_text(response: Any) -> str:
    """Answer of a service, in words."""
    results = getattr(response, "results", None)
    if results is not None:
        return "done" if results and results[0].successful else f"refused: {results[0].reason if results else '?'}"
    if getattr(response, "success", True):
        return "done"
    return f"refused: {response.message}"
