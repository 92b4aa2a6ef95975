"""Names on the graph, quality of service and the time base: the same for all nodes of a swarm."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from itertools import groupby
from typing import Any

from dtsa_agent.core.errors import ConfigError

SWARM = "/swarm"  # namespace of what the whole swarm shares
FRAME = "map"  # the room's centre, ENU

MODES = ("lockstep", "realtime")

SLOT = "slot"
TRANSMISSION = "transmission"
PROCESS = "process"
AIR_FRAME = "frame"
REPORT = "report"
SLOT_RECORD = "slot_record"
MARKERS = "markers"
CONFIGURATION = "configuration"
STATUS = "status"
ODOMETRY = "odom"

# In real time nobody waits for a process that gets no time: some seconds of messages wait for it instead.
REALTIME_WAITING = 64

# Calls before slot 0 are numbered from here on, as no slot is: a late answer to one is no answer to a slot.
FIRST_CALL = 1 << 31

# A player's /clock and the stamps of a bag must not start at 0, which ROS takes for "no time yet".
TIME_ZERO_NS = 1_000_000_000


def agent_namespace(agent: int, swarm_namespace: str = SWARM) -> str:
    """Return the namespace of one agent: ``/cf3``, or ``/north/cf3`` in a swarm that is not the default one."""
    return f"{swarm_prefix(swarm_namespace)}/cf{agent}"


def swarm_prefix(swarm_namespace: str) -> str:
    """Return what stands before the names of a swarm's agents: nothing for the default swarm, else ``/north``."""
    return "" if swarm_namespace == SWARM else swarm_namespace.rstrip("/")


def body_frame(agent_namespace: str) -> str:
    """Return the frame of an agent's body, as ``cf3/base_link`` or ``north/cf3/base_link``."""
    return f"{agent_namespace.strip('/')}/base_link"


def clock_topic(swarm_namespace: str) -> str:
    """Return the topic of the simulated time: ``/clock``, or the swarm's own one beside other swarms."""
    return f"{swarm_prefix(swarm_namespace)}/clock"


def slot_time_ns(slot: int, slot_ns: int) -> int:
    """Return the simulated time at which a slot of that length starts, ns."""
    return TIME_ZERO_NS + slot * slot_ns


def latched_qos() -> Any:
    """The last message, for late subscribers too."""
    from rclpy.qos import DurabilityPolicy, QoSProfile

    return QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # reliable, as by default


def lockstep_qos(writers: int = 1) -> Any:
    """Nothing may be lost on the way; a reader's history is shared by all nodes that write to the topic."""
    from rclpy.qos import QoSProfile

    return QoSProfile(depth=4 * writers)  # reliable, keeps the last, volatile


def agent_names(ids: Iterable[int]) -> str:
    """Return agents as the user knows them: ``cf3``, or ``cf1 .. cf6`` for many in a row."""
    rows = [list(group) for _, group in groupby(enumerate(sorted(ids)), lambda item: item[1] - item[0])]
    ends = [(row[0][1], row[-1][1]) for row in rows]
    return ", ".join(f"cf{a}" if a == b else f"cf{a} .. cf{b}" for a, b in ends) or "no agent"


def message_class(name: str) -> Any:
    """Return the class of a message type, ``package/msg/Name``; a ConfigError if its package is not installed."""
    package, _, class_name = name.partition("/msg/")
    try:
        message_type = getattr(import_module(f"{package}.msg"), class_name)
        message_type.__class__.__import_type_support__()
    except Exception as error:  # what an incomplete package raises has no common base
        raise ConfigError("type", name, f"an installed message type ({error})") from None
    return message_type
