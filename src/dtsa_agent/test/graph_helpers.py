"""A node beside the bridge, for the tests of the bridge on the graph."""

from __future__ import annotations

import math
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from dtsa_msgs.msg import Position, Status, VelocityWorld
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from node_helpers import ServedNode

COUNT = 3  # Crazyflies


class Graph(ServedNode):
    def __init__(self, domain: int) -> None:
        super().__init__(domain, "test")
        self.last: dict[str, Any] = {}
        for k in range(1, COUNT + 1):
            self._listen(Odometry, f"/cf{k}/odom")
            self._listen(PoseStamped, f"/cf{k}/pose")
            self._listen(Status, f"/cf{k}/status")
        self._listen(DiagnosticArray, "/diagnostics")
        self.velocity = {
            k: self.node.create_publisher(VelocityWorld, f"/cf{k}/cmd_velocity_world", 1) for k in (1, 2, 3)
        }
        self.position = self.node.create_publisher(Position, "/cf1/cmd_position", 1)

    def _listen(self, kind: type, topic: str) -> None:
        self.node.create_subscription(kind, topic, lambda message: self.last.__setitem__(topic, message), 10)

    def state(self, k: int) -> str:
        status = self.last.get(f"/cf{k}/status")
        return status.state_name if status else ""

    def place(self, k: int) -> tuple[float, float, float]:
        odometry = self.last.get(f"/cf{k}/odom")
        if odometry is None:  # sent only once the bridge knows that somebody listens
            return math.inf, math.inf, math.inf
        p = odometry.pose.pose.position
        return p.x, p.y, p.z
