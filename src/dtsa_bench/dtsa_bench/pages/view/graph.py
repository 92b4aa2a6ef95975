"""A swarm on the ROS graph as a source of moments: a node that listens, and for which no agent ever waits."""

from __future__ import annotations

import os
import time
from collections import deque
from typing import Any

from builtin_interfaces.msg import Duration
from dtsa_msgs.msg import Configuration, Decision, Reception, RunStatus, Slot
from dtsa_msgs.srv import Land
from rcl_interfaces.msg import ParameterEvent
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.task import Future
from std_srvs.srv import Empty
from visualization_msgs.msg import MarkerArray

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.process.loop import Feed
from dtsa_agent.ros.common.process.node_process import init_ros
from dtsa_agent.ros.common.wire.intake import Intake
from dtsa_agent.ros.common.workarounds.dds import limit_to_machine

from .follower import Follower
from .orders import Order
from .track import Track
from .vehicles import VehicleWatch, listening

_POLL_S = 0.02
_VEHICLES_S = 0.05  # wall time from one look at the vehicles to the next
_WAITING = 500  # messages that wait for the next poll
_ENDED = 2  # RunStatus.ENDED
_MOST_ORDERS = 20  # that wait
_ANSWER_S = 5.0
_LAND_S = 3


class GraphSource:
    """Follows the swarm of a namespace, run after run.

    :param track: where the moments go.
    :param domain: ROS domain; None: that of the environment.
    :param space: namespace of the swarm.
    :param control: whether orders are carried out.
    """

    def __init__(
        self, track: Track, domain: int | None = None, space: str = names.SWARM, control: bool = False
    ) -> None:
        self._track, self._space = track, space
        limit_to_machine(os.environ, shared_memory=False)  # who is killed beside it does not take it along
        self._context = Context()
        init_ros(None, self._context, domain)
        self._node = Node(
            "view", namespace=space, context=self._context, enable_rosout=False, start_parameter_services=False
        )
        self._intake = Intake(self._node.get_logger())
        self._settings = self._feed(Configuration, f"{space}/{names.CONFIGURATION}", names.latched_qos())
        self._status = self._feed(RunStatus, f"{space}/{names.STATUS}", names.latched_qos())
        self._changes = self._feed(ParameterEvent, "/parameter_events", listening(_WAITING))
        self._markers = self._feed(MarkerArray, f"{space}/{names.MARKERS}", listening(_WAITING))
        kinds = ((Slot, names.SLOT), (Decision, names.DECISION), (Reception, names.RECEPTION))
        self._slots = [self._feed(kind, f"{space}/{topic}", listening(_WAITING)) for kind, topic in kinds]
        self._kept: list[tuple[int, int, Any]] = []  # messages of the newest slot, which may not be complete
        self._vehicles = VehicleWatch(self._node, self._intake, track, names.swarm_prefix(space))
        self._orders = _Orders(self._node, self._context, space) if control else None
        self._run = 0
        self._follower: Follower | None = None
        self.stopped = False

    def _feed(self, kind: Any, topic: str, qos: QoSProfile) -> Feed:
        return Feed(self._node, kind, topic, qos, intake=self._intake)

    def run(self) -> None:
        """Listens until ``stopped`` is set."""
        self._track.end("waiting for a swarm")
        look = 0.0
        try:
            while not self.stopped and self._context.ok():
                self._follow_runs()
                if (now := time.monotonic()) >= look:
                    look = now + _VEHICLES_S
                    self._vehicles.look(now)
                if self._follower is not None:
                    self._receive(self._follower)
                for text in self._orders.carry_out() if self._orders else ():
                    self._vehicles.answer = text
                    if self._follower is not None:
                        self._follower.note(text)
                time.sleep(_POLL_S)
            self._follow_runs()  # the run may have ended since the last poll
        finally:
            self._vehicles.close()
            for feed in (self._settings, self._status, self._changes, self._markers, *self._slots):
                feed.close()
            if self._orders:
                self._orders.close()
            self._node.destroy_node()
            self._context.try_shutdown()

    def order(self, order: Order) -> str:
        """Accept an order; what has come of it stands among the events.

        :raises ConfigError: if it cannot be one.
        """
        if self._orders is None:
            raise ConfigError("order", order.kind, "only with --control")
        return self._orders.accept(order)

    def _follow_runs(self) -> None:
        """Receive which run is under way, and how it is doing."""
        message = self._settings.take()
        if message is not None and message.run != self._run:
            self._run, self._kept = message.run, []
            self._follower = Follower(self._track, {"live": True, "control": self._orders is not None})
            self._follower.receive("Configuration", message)
            if not self._follower.begun:
                self._follower = None
                return
        status = self._status.take()
        if status is not None and self._follower is not None and status.run == self._run:
            if status.phase == _ENDED:
                self._receive(self._follower, last=True)
            self._follower.receive("RunStatus", status)
            if status.phase == _ENDED:
                self._follower.finish("ended")

    def _receive(self, follower: Follower, last: bool = False) -> None:
        """Receive what has come since the last poll: of each slot decisions and frames before the verdict.

        :param last: nothing more will come: the newest slot is complete, too.
        """
        while (event := self._changes.take()) is not None:
            if event.node == f"{self._space}/channel":
                follower.receive("ParameterEvent", event)
        while (markers := self._markers.take()) is not None:
            follower.receive("MarkerArray", markers)
        for place, feed in enumerate(self._slots):
            for _ in range(_WAITING):
                message = feed.take()
                if message is None:
                    break
                if message.run == self._run:
                    slot = message.heard_slot if place == 0 else message.slot
                    self._kept.append((slot, place, message))
        self._kept.sort(key=lambda entry: entry[:2])
        newest = self._kept[-1][0] if self._kept else 0
        complete = [entry for entry in self._kept if last or entry[0] < newest]
        del self._kept[: len(complete)]
        for _, _, message in complete:
            follower.receive(type(message).__name__, message)


class _Orders:
    """Carries out orders by the services of the channel's node and of the bridge.

    :param node: calls them.
    :param context: its context.
    :param space: namespace of the swarm.
    """

    def __init__(self, node: Node, context: Context, space: str) -> None:
        self._channel = node.create_client(SetParameters, f"{space}/channel/set_parameters")
        self._land = node.create_client(Land, "/all/land")
        self._stop = node.create_client(Empty, "/all/emergency")
        self._waiting: deque[Order] = deque(maxlen=_MOST_ORDERS)
        self._asked: list[tuple[str, float, Future]] = []  # what, until when, its answer
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(node)

    def accept(self, order: Order) -> str:
        """Accept an order; called by the server's thread."""
        self._waiting.append(order)
        return f"ordered: {order.kind}"

    def carry_out(self) -> list[str]:
        """Call what is ordered, never wait; what has come of orders, as people read it."""
        results = []
        while self._waiting:
            order = self._waiting.popleft()
            client, request = self._request(order)
            text = f"{order.kind} {order.value!r}" if client is self._channel else order.kind
            if not client.service_is_ready():
                results.append(f"refused: {text}: no node offers {client.srv_name}")
            else:
                self._asked.append((text, time.monotonic() + _ANSWER_S, client.call_async(request)))
        if self._asked:
            self._executor.spin_once(timeout_sec=0.0)
        for entry in list(self._asked):
            text, until, future = entry
            if future.done() or time.monotonic() > until:
                self._asked.remove(entry)
                results.append(f"{text}: {_answer_text(future.result()) if future.done() else 'no answer'}")
        return results

    def _request(self, order: Order) -> tuple[Any, Any]:
        if order.kind == "land":
            return self._land, Land.Request(height=0.0, duration=Duration(sec=_LAND_S))
        if order.kind == "emergency":
            return self._stop, Empty.Request()
        parameter = Parameter(order.kind, value=order.value).to_parameter_msg()
        return self._channel, SetParameters.Request(parameters=[parameter])

    def close(self) -> None:
        """Gives the handles back."""
        self._executor.shutdown(timeout_sec=0)


def _answer_text(response: Any) -> str:
    """What a service has answered, in words."""
    results = getattr(response, "results", None)
    if results is not None:
        return "done" if results and results[0].successful else f"refused: {results[0].reason if results else '?'}"
    if getattr(response, "success", True):
        return "done"
    return f"refused: {response.message}"
