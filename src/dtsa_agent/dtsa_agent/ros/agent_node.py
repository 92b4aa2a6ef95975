"""``ros2 run dtsa_agent agent``: one quadcopter."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rclpy.node import Node

from dtsa_agent.air.port import AIRS
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.config import MAX_AGENTS
from dtsa_agent.core.settings.declaration import Setting
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.node_process import ending, node_options, run_node
from dtsa_agent.ros.common.parameters import declare_setting, declare_swarm_namespace
from dtsa_agent.stop import Stop

from .swarm_host import declare_swarm, host_agents

_UNNAMED = names.agent_namespace(0)  # replaced below unless the command line gives a namespace

CHANNEL = "channel"
_AIR = Setting(
    "air", "text", CHANNEL, "what carries the frames: the channel's node, or a port", choices=(CHANNEL, *AIRS)
)


def _declare_identity(node: Node) -> tuple[int, str]:
    """Declare and return the agent's id, which the namespace may give, and the namespace of its swarm."""
    digits = node.get_namespace().rpartition("cf")[2]
    default = int(digits) if digits.isdigit() and node.get_namespace() != _UNNAMED else 1
    text = "id of this agent, 1 .. agents; default: the number in the namespace"
    agent = declare_setting(node, Setting("id", "int", default, text, minimum=1, maximum=MAX_AGENTS))
    return int(agent), declare_swarm_namespace(node)


def _body(stop: Stop, supervised: bool) -> int | None:
    options = node_options(supervised)
    node = Node("agent", namespace=_UNNAMED, **options)
    agent, space = _declare_identity(node)
    if node.get_namespace() == _UNNAMED:
        node.destroy_node()
        node = Node("agent", namespace=names.agent_namespace(agent, space), **options)
        _declare_identity(node)
    with ending(node):
        air = _AIR.check(declare_setting(node, _AIR))
        if air != CHANNEL:
            from .odometry_vehicle import fly_over_port  # other agents need no port

            return fly_over_port(node, air, agent, stop)
        config = declare_swarm(node)
        if agent > config.agents:
            raise ConfigError("id", agent, f"1 to {config.agents}, the number of agents")
        host_agents(node, [agent], config, stop, space, [node.get_namespace()])
        return None


def main(args: Sequence[str] | None = None) -> int:
    """Runs the node."""
    return run_node("agent", _body, args)


if __name__ == "__main__":
    sys.exit(main())
