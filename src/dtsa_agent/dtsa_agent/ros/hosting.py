"""What ``agent`` and ``swarm_host`` have in common: their parameters, and how they run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, ParameterType
from rclpy.node import Node

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import ConfigError, DtsaError
from dtsa_agent.core.plugins.entry_points import make_swarm, shareable
from dtsa_agent.core.settings.declaration import Settings, setting
from dtsa_agent.keys import authenticator, with_key
from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.graph.parameters import check_parameters, declare_settings
from dtsa_agent.ros.common.process.loop import Stop
from dtsa_agent.ros.common.process.priority import PrioritySettings, give_way_by

from .swarm_node import AgentsNode, SwarmNode


@dataclass(frozen=True, slots=True)
class HostSettings(Settings):
    """How agents live in a process, beside what the whole swarm agrees on.

    :raises ConfigError: for values that are not allowed.
    """

    odometry: bool = setting(True, "offer each agent's true motion as <agent>/odom")
    mode: str = setting(
        names.MODES[0],
        "in lockstep all wait for each other; in real time each agent has a clock of its own",
        choices=names.MODES,
    )


@dataclass(frozen=True, slots=True)
class OwnClocks(Settings):
    """What the clocks of all agents of a process have in common.

    :raises ConfigError: for values that are not allowed.
    """

    clock_jitter_ns: float = setting(
        0.0, "standard deviation of the time of one transmission", unit="ns", minimum=0, maximum=1e9
    )
    align: bool = setting(True, "agents move their slots towards what they hear")


def _declare(node: Node, name: str, default: Any, text: str, kind: int) -> Any:
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
    space: str = names.SWARM,
    shared: bool = False,
    spaces: Sequence[str] | None = None,
) -> None:
    """Declares the rest of the parameters and runs agents until the end.

    :param node: the ROS node.
    :param ids: ids of the agents that live in it.
    :param config: the settings that all agents share.
    :param stop: the signal flag.
    :param space: namespace of what the whole swarm shares.
    :param shared: whether one table serves all.
    :param spaces: namespace of each agent; default: ``/cf1``, ``/cf2``, ... in the swarm's.
    :raises ConfigError: for settings that are not usable.
    """
    if shared and not shareable(config):
        raise ConfigError("shared_table", True, f"false with policy {config.policy}")
    host = HostSettings(**declare_settings(node, HostSettings))
    priority = PrioritySettings(**declare_settings(node, PrioritySettings)).priority
    if host.mode == "lockstep":
        swarm = with_key(make_swarm(config, local=sorted(ids), shared_table=shared))
        agents: AgentsNode = SwarmNode(node, swarm, space)
    else:
        agents = _realtime(node, config, sorted(ids), space, priority)
    if host.odometry:
        agents.offer_odometry(spaces)
    logger = node.get_logger()
    try:
        check_parameters(node)
        agents.run(stop)
        logger.info(f"ends after slot {agents.slot}: {'stopped by a signal' if stop else 'the run is over'}")
    except DtsaError as error:
        logger.error(f"ends after slot {agents.slot}: {error}")
        raise
    finally:
        agents.membership.close()
        agents.loop.close()


def _realtime(node: Node, config: SwarmConfig, ids: Sequence[int], space: str, priority: int) -> AgentsNode:
    from .realtime import RealtimeNode

    count = len(ids)
    text = "offset of each agent's clock at the start, one for all or one an agent; positive: early (ns)"
    offset = _whole_numbers(node, "clock_offset_ns", [0], count, text)
    drift = _whole_numbers(
        node, "clock_drift_ppb", [0], count, "by how much each agent's clock runs fast (parts per billion)"
    )
    clocks = OwnClocks(**declare_settings(node, OwnClocks))
    fixed, per_byte = _whole_numbers(
        node,
        "flight_time_ns",
        [0, 0],
        2,
        "from the order to send until a receiver has the frame: for any frame, and more for each of its bytes (ns)",
    )
    text = (
        "without real-time priority: by how much this process gives way to others, the channel above all: nice, 0 to 19"
    )
    nice = _declare(node, "nice", 0, text, ParameterType.PARAMETER_INTEGER)
    if not 0 <= nice <= 19:
        raise ConfigError("nice", nice, "0 to 19")
    if nice:
        give_way_by(nice)
    text = "x, y, z an agent: where it hovers when it comes into a flight under way; [0.0]: at its start (m)"
    places = list(_declare(node, "resume_at", [0.0], text, ParameterType.PARAMETER_DOUBLE_ARRAY))
    if len(places) not in (1, 3 * count) or not all(map(math.isfinite, places)):
        raise ConfigError("resume_at", places, f"{3 * count} numbers with a decimal point: x, y, z of each agent")
    return RealtimeNode(
        node,
        config,
        ids,
        space,
        authenticator=authenticator(config),
        offset_ns=offset,
        drift_ppb=drift,
        jitter_ns=clocks.clock_jitter_ns,
        align=clocks.align,
        flight_time_ns=(fixed, per_byte),
        priority=priority,
        resume_at=places if len(places) > 1 else (),
    )


def declare_swarm(node: Node) -> SwarmConfig:
    """Declares the swarm's settings and reads them.

    :raises ConfigError: for settings that are not usable.
    """
    return SwarmConfig.from_dict(declare_settings(node, SwarmConfig))
