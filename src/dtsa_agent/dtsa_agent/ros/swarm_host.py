"""``ros2 run dtsa_agent swarm_host``: several quadcopters in one process, behind one subscription and one publisher."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rcl_interfaces.msg import ParameterDescriptor, ParameterType

from dtsa_agent.core.settings.declaration import Setting
from dtsa_agent.ros.common.graph.namespaces import swarm_wide_node
from dtsa_agent.ros.common.graph.parameters import declare_setting
from dtsa_agent.ros.common.process.loop import Stop
from dtsa_agent.ros.common.process.node_process import ending, node_options, run_node

from .hosting import declare_swarm, host_agents
from .swarm_node import parse_ids

SHARED = Setting(
    "shared_table",
    "bool",
    False,
    "one table serves all agents here, for as long as all hear the same; policies tdma, dtsa and age; only faster, "
    "changes no flight",
)


def _body(stop: Stop, supervised: bool) -> None:
    node, space = swarm_wide_node("swarm_host", node_options(supervised))
    with ending(node):
        config = declare_swarm(node)
        listed = ParameterDescriptor(
            description="ids of the agents in this process; [0]: all",
            read_only=True,
            type=ParameterType.PARAMETER_INTEGER_ARRAY,
        )
        ids = [agent for agent in node.declare_parameter("ids", [0], listed).value if agent]
        shared = declare_setting(node, SHARED)
        host_agents(node, parse_ids(ids, config.agents), config, stop, space, shared)


def main(args: Sequence[str] | None = None) -> int:
    """Runs the node."""
    return run_node("swarm_host", _body, args)


if __name__ == "__main__":
    sys.exit(main())
