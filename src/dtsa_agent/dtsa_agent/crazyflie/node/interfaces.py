"""Crazyswarm2's names and messages: its own package where it is installed, else ours of the same shape.

Services of ours answer whether the order was taken; Crazyswarm2's have no answer, and its programs look at what flies.
"""

from __future__ import annotations

from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile

try:
    from crazyflie_interfaces import msg, srv

    STATE = "state"  # topic of dtsa_msgs/Status: `status` is Crazyswarm2's
except ImportError:
    from dtsa_msgs import msg, srv

    STATE = "status"

NODE = "crazyflie_server"
STOP_HERE = "/all/stop_here"  # of a mission's ground station: no agent flies on to its goal
EVENTS = "/all/events"  # what the bridge does, and what it was ordered to do: its log
EVENTS_QOS = QoSProfile(depth=500, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # also for subscribers that come late

VelocityWorld: Any = msg.VelocityWorld
Arm: Any = srv.Arm
GoTo: Any = srv.GoTo
Land: Any = srv.Land
Takeoff: Any = srv.Takeoff
# Its Python library waits for these, whether a program flies trajectories or not; they do nothing.
TRAJECTORIES: list[tuple[Any, str]] = [
    (getattr(srv, kind), name)
    for kind, name in (("UploadTrajectory", "upload_trajectory"), ("StartTrajectory", "start_trajectory"))
    if hasattr(srv, kind)
]
