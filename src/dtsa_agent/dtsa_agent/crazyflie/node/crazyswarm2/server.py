"""What the bridge's node needs to be Crazyswarm2's server."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from rclpy.node import Node

from dtsa_agent.crazyflie.node.bridge import Bridge
from dtsa_agent.crazyflie.node.command_thread import CommandThread
from dtsa_agent.crazyflie.settings.config import SwarmSettings

from .inputs import Crazyswarm2Inputs
from .interfaces import Interfaces, load
from .outputs import Crazyswarm2Outputs


@dataclass(frozen=True, slots=True)
class Server:
    """Inputs and outputs with Crazyswarm2's messages."""

    interfaces: Interfaces

    def inputs(
        self, node: Node, bridge: Bridge, commands: CommandThread, say: Callable[[str, str], None]
    ) -> Crazyswarm2Inputs:
        """Topics and services that its programs use."""
        return Crazyswarm2Inputs(node, bridge, commands, say, self.interfaces)

    def outputs(self, node: Node, settings: SwarmSettings) -> Crazyswarm2Outputs:
        """Topics that its programs listen to."""
        return Crazyswarm2Outputs(node, settings, self.interfaces)


def server() -> Server:
    """Find Crazyswarm2's messages.

    :raises ConfigError: they are not in the workspace.
    """
    return Server(load())
