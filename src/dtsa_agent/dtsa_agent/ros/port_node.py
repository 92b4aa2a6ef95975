"""``ros2 run dtsa_agent agent`` with ``air:=udp`` or another port: frames over it, a vehicle on the graph.

How it is used: docs/how-to/vehicles.md.
"""

from __future__ import annotations

import json
from contextlib import nullcontext
from importlib.metadata import entry_points
from typing import Any

from rclpy.node import Node

from dtsa_agent.air.driver import LiveAgent
from dtsa_agent.air.ports import make_settings, open_port, settings_class
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.core import ConfigError, SwarmConfig
from dtsa_agent.core.errors import DtsaError
from dtsa_agent.core.settings.declaration import Setting, settings_of
from dtsa_agent.ros.common.graph.parameters import check_parameters, declare_setting, declare_settings
from dtsa_agent.stop import Stop

from .odometry_vehicle import ODOMETRY, OdometryVehicle, VehicleSettings

_DEFAULTS = {"policy": "lease", "auth": True}  # as of `tools/dtsa agent`
_OUT = Setting("out", "text", "", "directory for its bag and summary.json, empty or new; empty text: none")
_RECORDERS = "dtsa.recorders"  # group of entry points: what records is in a package above this one


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
    out = str(declare_setting(node, _OUT))
    check_parameters(node)
    record = _recorder(out) if out else None
    logger = node.get_logger()
    try:
        with open_port(chosen) as port:
            flying = LiveAgent(own, config, port, vehicle=vehicle, say=logger.warning)
            with nullcontext() if record is None else record(out, flying, chosen) as recorder:
                flying.run(stop)
            summary = flying.summary() if recorder is None else recorder.summary
            logger.info(f"ends: {json.dumps(summary)}")
    finally:
        if vehicle is not None:
            vehicle.close()
    if recorder is not None and recorder.failure:
        raise DtsaError(recorder.failure)
    return 0


def _recorder(out: str) -> Any:
    """What records an agent, as ``recorder(out, agent, port_settings)``: a context in which it flies.

    :raises ConfigError: if there is none here.
    """
    found = [*entry_points(group=_RECORDERS, name="agent")]
    if not found:
        raise ConfigError("out", out, "no directory, for the package dtsa_bench, which records, is not here")
    try:
        return found[0].load()
    except ImportError as error:
        raise ConfigError("out", out, f"no directory, for what records cannot be imported ({error})") from None
