"""The messages of Crazyswarm2, from the workspace."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.crazyflie.node.inputs import Types


@dataclass(frozen=True, slots=True)
class Interfaces:
    """What the package crazyflie_interfaces has."""

    msg: Any
    srv: Any

    def types(self) -> Types:
        """Its messages in place of ours."""
        msg, srv = self.msg, self.srv
        return Types(
            msg.FullState,
            msg.Position,
            msg.VelocityWorld,
            msg.Hover,
            srv.Takeoff,
            srv.Land,
            srv.GoTo,
            srv.Arm,
            srv.NotifySetpointsStop,
        )


def load() -> Interfaces:
    """Import the package.

    :raises ConfigError: it is not in the workspace.
    """
    try:
        from crazyflie_interfaces import msg, srv
    except ImportError:
        raise ConfigError(
            "interfaces", "crazyswarm2",
            "dtsa, or crazyswarm2 with the package crazyflie_interfaces in the workspace (it is not)",
        ) from None  # fmt: skip
    return Interfaces(msg, srv)
