"""The firmware's parameters as parameters of the node: `cf1.params.ring.effect`, for all `all.params.ring.effect`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from dtsa_agent.crazyflie.node.bridge import Bridge
from dtsa_agent.crazyflie.vehicle.onboard import Parameter

ALL = "all"
PARAMS = ".params."
GROUPS = "hlCommander.groupmask"


class FirmwareParameters:
    """Declares them, and passes on what is set.

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
