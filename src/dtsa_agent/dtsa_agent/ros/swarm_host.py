"""``ros2 run dtsa_agent swarm_host``: several quadcopters in one process, behind one subscription and one publisher.

Its parameters, and how agents run, are also those of ``agent``.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from rclpy.node import Node

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import ConfigError, DtsaError
from dtsa_agent.core.plugins import make_swarm
from dtsa_agent.core.settings.declaration import Setting, setting
from dtsa_agent.core.station import ClockMap
from dtsa_agent.keys import authenticator, with_key
from dtsa_agent.priority import PrioritySettings, set_nice
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.node_process import ending, node_options, run_node
from dtsa_agent.ros.common.parameters import (
    check_parameters,
    declare_list,
    declare_setting,
    declare_settings,
    swarm_wide_node,
)
from dtsa_agent.stop import Stop

from .agents_node import AgentsNode
from .swarm_node import SwarmNode

_SHARED = Setting(
    "shared_table", "bool", False,
    "one table serves all agents here, for as long as all hear the same; policies tdma, dtsa and age; only faster, "
    "changes no flight",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class HostSettings(PrioritySettings):
    """How agents live in a process, beside what the whole swarm agrees on."""

    mode: str = setting(
        names.MODES[0], "in lockstep all wait for each other; in real time each agent has a clock of its own",
        choices=names.MODES,
    )  # fmt: skip
    clock_jitter_ns: float = setting(
        0.0, "in real time: standard deviation of the time of one transmission", unit="ns", minimum=0, maximum=1e9
    )
    align: bool = setting(True, "in real time: agents move their slots towards what they hear")
    nice: int = setting(
        0, "in real time, without real-time priority: by how much this process gives way to others, the channel above "
        "all: nice", minimum=0, maximum=19,
    )  # fmt: skip


def declare_swarm(node: Node) -> SwarmConfig:
    """Declare the swarm's settings and return their values; ConfigError: they are not usable."""
    return SwarmConfig.from_dict(declare_settings(node, SwarmConfig))


def declare_ids(node: Node, agents: int) -> list[int]:
    """Declare which of N agents live in a process; return their ids, ascending. ConfigError: there are others."""
    listed = declare_list(node, "ids", [0], "ids of the agents in this process; [0]: all")
    ids = sorted(agent for agent in listed if agent) or list(range(1, agents + 1))
    if len(set(ids)) != len(ids) or ids[0] < 1 or ids[-1] > agents:
        raise ConfigError("ids", listed, f"different ids from 1 to {agents}; none: all")
    return ids


def host_agents(
    node: Node, ids: Sequence[int], config: SwarmConfig, stop: Stop, space: str, spaces: Sequence[str],
    shared: bool = False,
) -> None:  # fmt: skip
    """Declare the rest of the parameters and run agents until the end; ConfigError: settings are not usable.

    :param ids: of the agents that live here, ascending.
    :param space: namespace of what the whole swarm shares.
    :param spaces: namespace of each agent.
    :param shared: whether one table serves all.
    """
    if shared and not config.may_share_table:
        raise ConfigError("shared_table", True, f"false with policy {config.policy}")
    host = HostSettings(**declare_settings(node, HostSettings))
    if host.mode == names.MODES[0]:
        agents: AgentsNode = SwarmNode(node, with_key(make_swarm(config, local=ids, shared_table=shared)), space)
    else:
        agents = _realtime_node(node, config, ids, space, host)
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
        agents.close()


def _realtime_node(node: Node, config: SwarmConfig, ids: Sequence[int], space: str, host: HostSettings) -> AgentsNode:
    from .realtime import RealtimeNode

    def declare_numbers(name: str, count: int, text: str) -> list[int]:
        values = declare_list(node, name, [0], text)
        if len(values) not in (1, count):
            raise ConfigError(name, values, f"{count} whole numbers, or one for all")
        return values if len(values) == count else values * count

    count = len(ids)
    text = "offset of each agent's clock at the start, one for all or one an agent; positive: early (ns)"
    offset = declare_numbers("clock_offset_ns", count, text)
    drift = declare_numbers("clock_drift_ppb", count, "by how much each agent's clock runs fast (parts per billion)")
    text = "from the order to send until a receiver has the frame: for any frame, and more for each of its bytes (ns)"
    fixed, per_byte = declare_numbers("flight_time_ns", 2, text)
    text = "x, y, z an agent: where it hovers when it comes into a flight under way; [0.0]: at its start (m)"
    places = declare_list(node, "resume_at", [0.0], text)
    if len(places) not in (1, 3 * count) or not all(map(math.isfinite, places)):
        raise ConfigError("resume_at", places, f"{3 * count} numbers with a decimal point: x, y, z of each agent")
    if host.nice:
        set_nice(host.nice)
    return RealtimeNode(
        node, config, ids, space, authenticator=authenticator(config), jitter_ns=host.clock_jitter_ns, align=host.align,
        clocks=[ClockMap(*clock) for clock in zip(offset, drift, strict=True)], priority=host.priority,
        flight_time_ns=fixed + per_byte * config.frame_length, resume_at=places if len(places) > 1 else (),
    )  # fmt: skip


def _body(stop: Stop, supervised: bool) -> None:
    node, space = swarm_wide_node("swarm_host", node_options(supervised))
    with ending(node):
        config = declare_swarm(node)
        ids = declare_ids(node, config.agents)
        spaces = [names.agent_namespace(agent, space) for agent in ids]
        host_agents(node, ids, config, stop, space, spaces, declare_setting(node, _SHARED))


def main(args: Sequence[str] | None = None) -> int:
    """Runs the node."""
    return run_node("swarm_host", _body, args)


if __name__ == "__main__":
    sys.exit(main())
