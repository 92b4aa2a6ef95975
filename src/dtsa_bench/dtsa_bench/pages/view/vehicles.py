"""Crazyflies as their bridge tells of them on the ROS graph, with or without a run."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from dtsa_msgs.msg import Status
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.process.loop import Feed
from dtsa_agent.ros.common.wire.intake import Intake

from .track import Track, Vehicles

_TYPE = "dtsa_msgs/msg/Status"
_SEARCH_S = 1.0  # from one look at the graph to the next
_MOST = 200  # vehicles
_SILENT_S = 2.0  # the bridge tells the status of each five times a second
_STATE, _REASON = 20, 80  # characters that are shown


def listening(depth: int) -> QoSProfile:
    """QoS of a listener that no publisher waits for; `depth`: messages that wait for it, of more the last."""
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)


@dataclass(slots=True)
class _Vehicle:
    feed: Feed
    heard_s: float  # time.monotonic() of the last status
    row: tuple[str, str, float, float, str] | None = None

    def row_now(self, now: float) -> tuple[str, str, float, float, str] | None:
        """Its last status; that it is silent where that is long ago."""
        if self.row is None or now - self.heard_s <= _SILENT_S:
            return self.row
        name, state, battery, _, _ = self.row
        return name, f"silent ({state})"[:_STATE], battery, 0.0, "the bridge tells nothing of it"


class VehicleWatch:
    """Finds the vehicles of a bridge, whose names have a prefix, as ``/north``, and shows them on a track."""

    def __init__(self, node: Node, intake: Intake, track: Track, prefix: str = "") -> None:
        self._node, self._intake, self._track = node, intake, track
        self._topic = re.compile(f"{re.escape(prefix)}/([A-Za-z][A-Za-z0-9_]{{0,40}})/{names.STATUS}")
        self._vehicles: dict[str, _Vehicle] = {}
        self._search_s = 0.0
        self.answer = ""  # what has come of the last order

    def look(self, now: float) -> None:
        """Receive statuses, and search for new vehicles; `now`: s, ``time.monotonic()``."""
        if now >= self._search_s:
            self._search_s = now + _SEARCH_S
            self._search(now)
        for name, vehicle in self._vehicles.items():
            message = vehicle.feed.take()
            if message is not None and math.isfinite(message.battery_voltage) and math.isfinite(message.link_quality):
                numbers = round(message.battery_voltage, 2), round(message.link_quality, 2)
                vehicle.row = name, message.state_name[:_STATE], *numbers, message.reason[:_REASON]
                vehicle.heard_s = now
        rows = [vehicle.row_now(now) for vehicle in self._vehicles.values()]
        vehicles = Vehicles(tuple(row for row in rows if row is not None), self.answer)
        if vehicles.rows and vehicles != self._track.vehicles:
            self._track.vehicles = vehicles

    def _search(self, now: float) -> None:
        found = dict(self._vehicles)
        for topic, types in self._node.get_topic_names_and_types():
            match = self._topic.fullmatch(topic) if _TYPE in types else None
            if match and match[1] not in found and len(found) < _MOST:
                feed = Feed(self._node, Status, topic, listening(1), intake=self._intake)
                found[match[1]] = _Vehicle(feed, now)
        self._vehicles = {name: found[name] for name in sorted(found, key=_by_number)}

    def close(self) -> None:
        """Listens no more."""
        for vehicle in self._vehicles.values():
            vehicle.feed.close()


def _by_number(name: str) -> tuple[str, int]:
    letters = name.rstrip("0123456789")
    return letters, int(name[len(letters) :] or 0)
