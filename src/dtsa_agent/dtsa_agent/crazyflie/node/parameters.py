"""The firmware's parameters as parameters of the node: `cf1.params.ring.effect`; `all.params.ring.effect` sets all."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from dtsa_agent.crazyflie.bridge import Bridge

ALL = "all"
PARAMS = ".params."
GROUPS = "hlCommander.groupmask"


def why_refused(name: str, element: Any, value: object) -> str:
    """Return why a parameter, an entry of cflib's table, cannot be set to a value; empty if it can."""
    if element.access == element.RO_ACCESS:
        return f"{name} is read-only"
    try:
        struct.pack(element.pytype, value)
    except (struct.error, OverflowError):
        return f"{name}: {value!r} is no {element.ctype}"
    return "" if math.isfinite(value) else f"{name}: {value!r} is not finite"  # type: ignore[arg-type]


class FirmwareParameters:
    """Parameters of the node that mirror the firmware's parameters of the connected Crazyflies.

    :param log: called with a level and a line for each parameter that is set.
    :param masks: group mask of each robot, by its name; updated when the firmware's mask is set.
    """

    def __init__(self, node: Node, bridge: Bridge, log: Callable[[str, str], None], masks: dict[str, int]) -> None:
        self._node, self._vehicles, self._log, self._masks = node, bridge.vehicles, log, masks
        self._elements: dict[str, dict[str, Any]] = {}  # entries of cflib's table, by robot and `group.name`

    def declare(self) -> None:
        """Declare address and initial position of each robot, and the parameters of each connected Crazyflie."""
        common: dict[str, tuple[Any, float]] = {}
        for robot, vehicle in self._vehicles.items():
            self._declare(f"robots.{robot}.uri", vehicle.robot.uri, read_only=True)
            self._declare(f"robots.{robot}.initial_position", list(vehicle.robot.initial_position), read_only=True)
            found = vehicle.link.parameters()
            self._elements[robot] = {name: element for name, (element, _) in found.items()}
            self._declare_firmware(robot, found)
            common = found | common
        self._declare_firmware(ALL, common)
        self._node.add_on_set_parameters_callback(self._check)
        self._node.add_post_set_parameters_callback(self._apply)

    def _declare_firmware(self, target: str, found: dict[str, tuple[Any, float]]) -> None:
        for name, (element, value) in found.items():
            self._declare(f"{target}{PARAMS}{name}", value, read_only=element.access == element.RO_ACCESS)

    def _declare(self, name: str, value: Any, *, read_only: bool) -> None:
        self._node.declare_parameter(name, value, ParameterDescriptor(read_only=read_only), ignore_override=True)

    def _robots_with(self, target: str, name: str) -> list[str]:
        """Return the robots of a target (a robot's name or `all`) that have a parameter."""
        return [robot for robot, known in self._elements.items() if target in (ALL, robot) and name in known]

    def _check(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Accept the request if every parameter can be set."""
        for parameter in parameters:
            target, _, name = parameter.name.partition(PARAMS)
            for robot in self._robots_with(target, name):
                problem = why_refused(name, self._elements[robot][name], parameter.value)
                if target != ALL and not self._vehicles[robot].link.can_set:
                    problem = f"{robot} is not connected, or its parameters are being read"
                if problem:
                    self._log("warn", f"parameter {parameter.name}: {problem}")
                    return SetParametersResult(successful=False, reason=problem)
        return SetParametersResult(successful=True)

    def _apply(self, parameters: Sequence[Parameter]) -> None:
        """Send each new value to its Crazyflie; a parameter of `all` is set for each connected robot."""
        for parameter in parameters:
            target, _, name = parameter.name.partition(PARAMS)
            robots = self._robots_with(target, name)
            if target == ALL:
                robots = [robot for robot in robots if self._vehicles[robot].link.can_set]
                self._node.set_parameters([Parameter(f"{r}{PARAMS}{name}", value=parameter.value) for r in robots])
            elif robots:
                self._vehicles[target].link.set_parameter(name, parameter.value)
                if name == GROUPS:
                    self._masks[target] = int(parameter.value)
                self._log("info", f"parameter {parameter.name} = {parameter.value:g}")
