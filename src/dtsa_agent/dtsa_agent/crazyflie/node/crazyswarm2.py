"""The bridge as Crazyswarm2's programs know their server: imported only when asked for.

Node, services, topics, parameters and units are those of its crazyflie_server; the bridge's rules stay in force. Its
units, by what its server does with them: everything is in the world's frame whatever the header says; `cmd_position`
has its yaw in degrees and `cmd_velocity_world` its yaw rate in degrees per second, all others count in radians.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.crazyflie.settings import SwarmSettings
from dtsa_agent.crazyflie.state import conversions
from dtsa_agent.crazyflie.state.conversions import Vector, VehicleState
from dtsa_agent.crazyflie.vehicle.onboard import Parameter
from dtsa_agent.crazyflie.vehicle.reports import Snapshot
from dtsa_agent.crazyflie.vehicle.vehicle import Vehicle

from .bridge import Bridge
from .command_thread import CommandThread
from .inputs import Inputs, Types
from .outputs import Outputs

LOW_POWER = 3  # pm_state
MAX_UINT16 = 0xFFFF
ALL = "all"
PARAMS = ".params."
GROUPS = "hlCommander.groupmask"
NO_TRAJECTORIES = "trajectories are not supported: send positions, velocities or go_to"


def load_interfaces() -> Any:
    """Import Crazyswarm2's messages.

    :raises ConfigError: its package is not in the workspace.
    """
    try:
        from crazyflie_interfaces import msg, srv
    except ImportError:
        raise ConfigError(
            "interfaces", "crazyswarm2",
            "dtsa, or crazyswarm2 with the package crazyflie_interfaces in the workspace (it is not)",
        ) from None  # fmt: skip
    return msg, srv


@dataclass(slots=True)
class Answer:
    """The answer of our services; Crazyswarm2's have none, so it stands in the log alone."""

    success: bool = True
    message: str = ""


class Crazyswarm2Inputs(Inputs):
    """Topics and services of Crazyswarm2's server; parameters as of `Inputs`."""

    def __init__(self, node: Node, bridge: Bridge, commands: CommandThread, say: Callable[[str, str], None]) -> None:
        super().__init__(node, bridge, commands, say)
        msg, srv = load_interfaces()
        self._srv = srv
        self.types = Types(
            msg.FullState, msg.Position, msg.VelocityWorld,
            srv.Takeoff, srv.Land, srv.GoTo, srv.Arm, srv.NotifySetpointsStop,
        )  # fmt: skip
        self._masks = {name: vehicle.robot.group_mask for name, vehicle in bridge.vehicles.items()}

    def offer(self) -> None:
        """Create everything; `/all/emergency` is last."""
        FirmwareParameters(self._node, self._bridge, self._say, self._masks).declare()
        # Its Python library waits for the services of trajectories, whether a program flies any or not.
        kinds = (self._srv.UploadTrajectory, "upload_trajectory"), (self._srv.StartTrajectory, "start_trajectory")
        for name in (*self._bridge.vehicles, "all"):
            for kind, service in kinds:
                self._node.create_service(kind, f"{name}/{service}", partial(self._refuse, f"{name}/{service}"))
        super().offer()

    def _refuse(self, name: str, request: Any, response: Any) -> Any:
        self._say("warn", f"order /{name}: {NO_TRAJECTORIES}")
        return response

    def _ordered(self, name: str, callback: Callable[[Any, Any], Any], request: Any, response: Any) -> Any:
        super()._ordered(name, callback, request, Answer())
        return response

    # -- units ------------------------------------------------------------------------------------------------------
    def _world(self, frame: str, x: float, y: float, z: float) -> conversions.Vector:
        return x, y, z

    def _position(self, m: Any, stamp: float) -> conversions.Setpoint:
        return conversions.position((m.x, m.y, m.z), math.radians(m.yaw), stamp)

    def _velocity_world(self, m: Any, stamp: float) -> conversions.Setpoint:
        return conversions.velocity_world((m.vel.x, m.vel.y, m.vel.z), math.radians(m.yaw_rate), stamp)

    # -- services ---------------------------------------------------------------------------------------------------
    def _groups(self, name: str) -> int:
        return self._masks[name]

    def _climb(self, vehicle: Vehicle, height: float, duration: float) -> str:
        return vehicle.takeoff(height, duration, arm=True)  # its programs arm nobody

    def _go_to(self, names: list[str], request: Any, response: Any) -> Any:
        if len(names) > 1 and not request.relative:
            response.success, response.message = False, "a go_to of all must be relative: they would meet in one place"
            return response
        return super()._go_to(names, request, response)


class Crazyswarm2Outputs(Outputs):
    """Publishers of all vehicles, with Crazyswarm2's messages and places in the world's frame."""

    frame = "world"

    def __init__(self, node: Node, settings: SwarmSettings) -> None:
        self.status_type = load_interfaces()[0].Status
        self._critical = {robot.name: robot.battery.voltage_critical for robot in settings.robots}
        self._counted: dict[str, tuple[int, int]] = {}
        super().__init__(node, settings)

    def _place(self, state: VehicleState) -> Vector:
        return state.position

    def _status_message(self, s: Snapshot, stamp: Any) -> Any:
        """Its status; the packets are those since the one before."""
        sent, received = self._counted.get(s.name, (0, 0))
        self._counted[s.name] = s.sent, s.received
        volts = s.vehicle.battery if s.vehicle else 0.0
        message = self.status_type(
            supervisor_info=s.vehicle.info & MAX_UINT16 if s.vehicle else 0,
            battery_voltage=volts,
            pm_state=LOW_POWER if s.vehicle and volts < self._critical[s.name] else 0,
            rssi=s.rssi,
            num_tx_unicast=s.sent - sent,
            num_rx_unicast=s.received - received,
            latency_unicast=min(round(s.latency_p99 * 1000), MAX_UINT16),
        )
        message.header.stamp = stamp
        message.header.frame_id = self.frame
        return message


class FirmwareParameters:
    """The firmware's parameters as parameters of the node: `cf1.params.ring.effect`, for all `all.params.ring.effect`.

    :param node: has the parameters.
    :param bridge: the swarm, connected.
    :param say: called with a level and a line about each that is set.
    :param masks: the groups of each robot by its name; changed with the firmware's own.
    """

    def __init__(self, node: Node, bridge: Bridge, say: Callable[[str, str], None], masks: dict[str, int]) -> None:
        self._node, self._bridge, self._say, self._masks = node, bridge, say, masks
        self._known: dict[str, dict[str, Parameter]] = {}

    def declare(self) -> None:
        """Declare all: addresses and places of the robots, and what the connected ones have."""
        common: dict[str, Parameter] = {}
        for name, vehicle in self._bridge.vehicles.items():
            self._declare(f"robots.{name}.uri", vehicle.robot.uri, read_only=True)
            self._declare(f"robots.{name}.initial_position", list(vehicle.robot.initial_position), read_only=True)
            self._known[name] = vehicle.onboard.parameters()
            for parameter in self._known[name].values():
                self._declare(f"{name}{PARAMS}{parameter.name}", parameter.value, read_only=parameter.read_only)
            common = self._known[name] | common
        for parameter in common.values():
            self._declare(f"{ALL}{PARAMS}{parameter.name}", parameter.value, read_only=parameter.read_only)
        self._node.add_on_set_parameters_callback(self._check)
        self._node.add_post_set_parameters_callback(self._apply)

    def _declare(self, name: str, value: Any, *, read_only: bool) -> None:
        self._node.declare_parameter(name, value, ParameterDescriptor(read_only=read_only), ignore_override=True)

    def _check(self, parameters: Sequence[RosParameter]) -> SetParametersResult:
        """Whether all can be set."""
        for given in parameters:
            owner, found, name = given.name.partition(PARAMS)
            if not found:
                continue
            for robot in self._owners(owner, name):
                vehicle = self._bridge.vehicles[robot]
                problem = self._known[robot][name].problem(given.value)
                if owner != ALL and not vehicle.onboard.settable:
                    problem = f"{robot} is not connected, or its parameters are being read"
                if problem:
                    self._say("warn", f"parameter {given.name}: {problem}")
                    return SetParametersResult(successful=False, reason=problem)
        return SetParametersResult(successful=True)

    def _owners(self, owner: str, name: str) -> list[str]:
        """The robots that a parameter belongs to."""
        robots = list(self._known) if owner == ALL else [owner]
        return [robot for robot in robots if name in self._known.get(robot, {})]

    def _apply(self, parameters: Sequence[RosParameter]) -> None:
        """Send what was set; for all: set it for each of them."""
        for given in parameters:
            owner, found, name = given.name.partition(PARAMS)
            if not found:
                continue
            if owner == ALL:
                robots = [r for r in self._owners(owner, name) if self._bridge.vehicles[r].onboard.settable]
                self._node.set_parameters([RosParameter(f"{r}{PARAMS}{name}", value=given.value) for r in robots])
                continue
            self._bridge.vehicles[owner].onboard.set_parameter(name, given.value)
            if name == GROUPS:
                self._masks[owner] = int(given.value)
            self._say("info", f"parameter {given.name} = {given.value:g}")
