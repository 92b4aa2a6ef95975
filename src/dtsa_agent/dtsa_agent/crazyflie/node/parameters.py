"""The firmware's parameters as parameters of the node: `cf1.params.ring.effect`; `all.params.ring.effect` sets all."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from dtsa_agent.crazyflie.bridge import Bridge
from dtsa_agent.crazyflie.link import CrazyflieLink

FLOATS = frozenset({"float", "FP16", "double"})
ALL = "all"
PARAMS = ".params."
GROUPS = "hlCommander.groupmask"


@dataclass(frozen=True, slots=True)
class FirmwareParameter:
    """One parameter of the firmware."""

    name: str  # group.name
    c_type: str  # such as uint8_t
    read_only: bool
    value: float  # int for integer types

    def why_refused(self, value: object) -> str:
        """Return why the parameter cannot be set to a value; empty if it can."""
        if self.read_only:
            return f"{self.name} is read-only"
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            return f"{self.name}: {value!r} is not a number"
        if self.c_type in FLOATS:
            return ""
        bits = int("".join(filter(str.isdigit, self.c_type)))
        low, high = (0, 2**bits - 1) if self.c_type.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        if value != int(value) or not low <= value <= high:
            return f"{self.name}: {value!r} is not a whole number from {low} to {high}"
        return ""


def read_parameters(link: CrazyflieLink) -> dict[str, FirmwareParameter]:
    """Return the parameters of a Crazyflie that were read when it connected, by `group.name`."""
    cf = link.crazyflie
    if cf is None:
        return {}
    parameters = {}
    for group, elements in dict(cf.param.toc.toc).items():
        for name, element in dict(elements).items():
            text = cf.param.values.get(group, {}).get(name)
            if text is None:
                continue
            full_name = f"{group}.{name}"
            value = link.robot.firmware_params.get(full_name)  # set after connecting: newer than cflib's copy
            if value is None:
                value = float(text) if element.ctype in FLOATS else int(text)
            read_only = element.access == element.RO_ACCESS
            parameters[full_name] = FirmwareParameter(full_name, element.ctype, read_only, value)
    return parameters


class FirmwareParameters:
    """Parameters of the node that mirror the firmware's parameters of the connected Crazyflies.

    :param log: called with a level and a line for each parameter that is set.
    :param masks: group mask of each robot, by its name; updated when the firmware's mask is set.
    """

    def __init__(self, node: Node, bridge: Bridge, log: Callable[[str, str], None], masks: dict[str, int]) -> None:
        self._node, self._bridge, self._log, self._masks = node, bridge, log, masks
        self._by_robot: dict[str, dict[str, FirmwareParameter]] = {}

    def declare(self) -> None:
        """Declare address and initial position of each robot, and the parameters of each connected Crazyflie."""
        common: dict[str, FirmwareParameter] = {}
        for name, vehicle in self._bridge.vehicles.items():
            self._declare(f"robots.{name}.uri", vehicle.robot.uri, read_only=True)
            self._declare(f"robots.{name}.initial_position", list(vehicle.robot.initial_position), read_only=True)
            self._by_robot[name] = read_parameters(vehicle.link)
            for parameter in self._by_robot[name].values():
                self._declare(f"{name}{PARAMS}{parameter.name}", parameter.value, read_only=parameter.read_only)
            common = self._by_robot[name] | common
        for parameter in common.values():
            self._declare(f"{ALL}{PARAMS}{parameter.name}", parameter.value, read_only=parameter.read_only)
        self._node.add_on_set_parameters_callback(self._check)
        self._node.add_post_set_parameters_callback(self._apply)

    def _declare(self, name: str, value: Any, *, read_only: bool) -> None:
        self._node.declare_parameter(name, value, ParameterDescriptor(read_only=read_only), ignore_override=True)

    def _check(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Accept the request if every parameter can be set."""
        for parameter in parameters:
            target, separator, name = parameter.name.partition(PARAMS)
            for robot in self._robots_with(target, name) if separator else ():
                problem = self._by_robot[robot][name].why_refused(parameter.value)
                if target != ALL and not self._bridge.vehicles[robot].link.can_set:
                    problem = f"{robot} is not connected, or its parameters are being read"
                if problem:
                    self._log("warn", f"parameter {parameter.name}: {problem}")
                    return SetParametersResult(successful=False, reason=problem)
        return SetParametersResult(successful=True)

    def _robots_with(self, target: str, name: str) -> list[str]:
        """Return the robots of a target (a robot's name or `all`) that have a parameter."""
        robots = list(self._by_robot) if target == ALL else [target]
        return [robot for robot in robots if name in self._by_robot.get(robot, {})]

    def _apply(self, parameters: Sequence[Parameter]) -> None:
        """Send each new value to its Crazyflie; a parameter of `all` is set for each connected robot."""
        for parameter in parameters:
            target, separator, name = parameter.name.partition(PARAMS)
            if not separator:
                continue
            if target == ALL:
                robots = [r for r in self._robots_with(target, name) if self._bridge.vehicles[r].link.can_set]
                self._node.set_parameters([Parameter(f"{r}{PARAMS}{name}", value=parameter.value) for r in robots])
                continue
            self._bridge.vehicles[target].link.set_parameter(name, parameter.value)
            if name == GROUPS:
                self._masks[target] = int(parameter.value)
            self._log("info", f"parameter {parameter.name} = {parameter.value:g}")
