"""What ``agent`` and ``swarm_host`` have in common: their parameters, and how they run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, ParameterType
from rclpy.node import Node

from dtsa_agent.core import AbstractSwarm, SwarmConfig
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.plugins import make_swarm, shareable
from dtsa_agent.keys import with_key

from .common import names
from .common.loop import Stop
from .common.parameters import declare_settings
from .swarm_node import SwarmNode

MODES = ("lockstep", "realtime")


def _declare(node: Node, name: str, default: Any, text: str, kind: int = ParameterType.PARAMETER_NOT_SET) -> Any:
    info = ParameterDescriptor(description=text, read_only=True, type=kind)
    return node.declare_parameter(name, default, info).value


def _whole_numbers(node: Node, name: str, default: list[int], count: int, text: str) -> list[int]:
    values = list(_declare(node, name, default, text, ParameterType.PARAMETER_INTEGER_ARRAY))
    if len(values) == 1:
        values *= count
    if len(values) != count:
        raise ConfigError(name, values, f"{count} whole numbers, or one for all")
    return values


def host_agents(
    node: Node,
    ids: Sequence[int],
    config: SwarmConfig,
    stop: Stop,
    shared: bool = False,
    spaces: Sequence[str] | None = None,
) -> None:
    """Declares the rest of the parameters and runs agents until the end.

    :param node: the ROS node.
    :param ids: ids of the agents that live in it.
    :param config: the settings that all agents share.
    :param stop: the signal flag.
    :param shared: whether one table serves all.
    :param spaces: namespace of each agent; default: ``/cf1``, ``/cf2``, ...
    :raises ConfigError: for settings that are not usable.
    """
    if shared and not shareable(config):
        raise ConfigError("shared_view", True, f"false with policy {config.policy}")
    space = str(_declare(node, "swarm_namespace", names.SWARM, "namespace of what the whole swarm shares")).rstrip("/")
    odometry = _declare(node, "odometry", True, "offer each agent's true motion as <agent>/odom")
    mode = _declare(node, "mode", MODES[0], "lockstep: all wait for each other; realtime: each agent has its own clock")
    if mode not in MODES:
        raise ConfigError("mode", mode, ", ".join(MODES))
    swarm = with_key(make_swarm(config, local=sorted(ids), shared_view=shared and mode == "lockstep"))
    if mode == "lockstep":
        agents: SwarmNode = SwarmNode(node, swarm, space)
    else:
        agents = _realtime(node, swarm, space)
    if odometry:
        agents.offer_odometry(spaces)
    try:
        agents.run(stop)
    finally:
        agents.loop.close()


def _realtime(node: Node, swarm: AbstractSwarm, space: str) -> SwarmNode:
    from .realtime import RealtimeNode

    count = len(swarm.ids)
    text = "offset of each agent's clock at the start, one for all or one an agent; positive: early (ns)"
    offset = _whole_numbers(node, "clock_offset_ns", [0], count, text)
    drift = _whole_numbers(
        node, "clock_drift_ppb", [0], count, "by how much each agent's clock runs fast (parts per billion)"
    )
    jitter = float(_declare(node, "clock_jitter_ns", 0.0, "standard deviation of the time of one transmission (ns)"))
    align = bool(_declare(node, "align", True, "agents move their slots towards what they hear"))
    fixed, per_byte = _whole_numbers(
        node,
        "flight_time_ns",
        [0, 0],
        2,
        "from the order to send until a receiver has the frame: for any frame, and more for each of its bytes (ns)",
    )
    text = "x, y, z an agent: where it hovers when it comes into a flight under way; [0.0]: at its start (m)"
    places = list(_declare(node, "resume_at", [0.0], text, ParameterType.PARAMETER_DOUBLE_ARRAY))
    if len(places) not in (1, 3 * count) or not all(map(math.isfinite, places)):
        raise ConfigError("resume_at", places, f"{3 * count} numbers with a decimal point: x, y, z of each agent")
    return RealtimeNode(
        node,
        swarm,
        space,
        offset_ns=offset,
        drift_ppb=drift,
        jitter_ns=jitter,
        align=align,
        flight_time_ns=(fixed, per_byte),
        resume_at=places if len(places) > 1 else (),
    )


def declare_swarm(node: Node) -> SwarmConfig:
    """Declares the swarm's settings and reads them.

    :raises ConfigError: for settings that are not usable.
    """
    return SwarmConfig.from_dict(declare_settings(node, SwarmConfig))
