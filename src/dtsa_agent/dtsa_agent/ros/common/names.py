"""Names on the graph, quality of service and the time base: the same for all nodes of a swarm."""

from __future__ import annotations

from typing import Any

SWARM = "/swarm"  # namespace of what the whole swarm shares
FRAME = "map"  # the room's centre, ENU

SLOT = "slot"
TRANSMISSION = "transmission"
RECEPTION = "reception"
DECISION = "decision"
MARKERS = "markers"
ODOMETRY = "odom"

# In real time nobody waits for a process that gets no time: some seconds of messages wait for it instead.
REALTIME_WAITING = 64

# A player's /clock and the stamps of a bag must not start at 0, which ROS takes for "no time yet".
TIME_ZERO_NS = 1_000_000_000


def agent_namespace(agent: int) -> str:
    """Namespace of one agent, e.g. ``/cf3``."""
    return f"/cf{agent}"


def slot_time_ns(slot: int, slot_ns: int) -> int:
    """Simulated time at which a slot starts, ns."""
    return TIME_ZERO_NS + slot * slot_ns


def lockstep_qos(writers: int = 1) -> Any:
    """Nothing may be lost on the way; every node has one message under way at a time, or a repeated one.

    :param writers: number of nodes that write to the topic: a reader's history is shared by all of them.
    """
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=4 * writers,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.VOLATILE,
    )
