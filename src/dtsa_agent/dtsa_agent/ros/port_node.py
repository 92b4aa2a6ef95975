"""``ros2 run dtsa_agent agent`` with ``air:=udp`` or another port: frames over it, a vehicle on the graph.

How it is used: docs/how-to/vehicles.md.
"""

from __future__ import annotations

import json

from rclpy.node import Node

from dtsa_agent.air.agent import AirAgent
from dtsa_agent.air.ports import make_settings, open_port, settings_class
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.settings.declaration import settings_of
from dtsa_agent.ros.common.graph.parameters import declare_settings
from dtsa_agent.stop import Stop

from .odometry_vehicle import ODOMETRY, OdometryVehicle, VehicleSettings

_DEFAULTS = {"policy": "lease", "auth": True}  # as of `tools/dtsa agent`


def fly_over_port(node: Node, air: str, agent: int, stop: Stop) -> int:
    """Declares the rest of the parameters and flies until a signal.

    :param node: the ROS node.
    :param air: name of the kind of port.
    :param agent: id of the agent.
    :param stop: the signal flag.
    :returns: exit code.
    :raises ConfigError: for settings that are not usable.
    """
    config = SwarmConfig.from_dict(declare_settings(node, SwarmConfig, defaults=_DEFAULTS))
    own = AgentSettings(id=agent, **declare_settings(node, AgentSettings, skip=("id",)))
    cls = settings_class(air)
    needed = {setting.name: "" for setting in settings_of(cls) if setting.required}  # said if they are not given
    chosen = make_settings(air, declare_settings(node, cls, defaults=needed))
    settings = VehicleSettings.from_dict(declare_settings(node, VehicleSettings))
    vehicle = OdometryVehicle(node, settings, config.slot_s) if settings.vehicle == ODOMETRY else None
    logger = node.get_logger()
    try:
        with open_port(chosen) as port:
            flying = AirAgent(own, config, port, vehicle=vehicle, say=logger.warning)
            flying.run(stop)
            logger.info(f"ends: {json.dumps(flying.summary())}")
    finally:
        if vehicle is not None:
            vehicle.close()
    return 0
