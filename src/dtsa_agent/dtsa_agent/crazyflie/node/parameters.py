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


def declare_firmware(node: Node, bridge: Bridge, log: Callable[[str, str], None], masks: dict[str, int]) -> None:
    """Declare address and initial position of each robot, and the parameters of each connected Crazyflie.

    :param log: called with a level and a line for each parameter that is set.
    :param masks: group mask of each robot, by its name; updated when the firmware's mask is set.
    """
    vehicles = bridge.vehicles
    elements: dict[str, dict[str, Any]] = {ALL: {}}  # entries of cflib's table, by target and `group.name`

    def declare(name: str, value: Any, *, read_only: bool) -> None:
        if not node.has_parameter(name):
            node.declare_parameter(name, value, ParameterDescriptor(read_only=read_only), ignore_override=True)

    def check(parameters: Sequence[Parameter]) -> SetParametersResult:
        """Accept the request if every parameter can be set."""
        for parameter in parameters:
            target, _, name = parameter.name.partition(PARAMS)
            if (element := elements.get(target, {}).get(name)) is None:
                continue
            problem = why_refused(name, element, parameter.value)
            if target != ALL and not vehicles[target].link.can_set:
                problem = f"{target} is not connected, or its parameters are being read"
            if problem:
                log("warn", f"parameter {parameter.name}: {problem}")
                return SetParametersResult(successful=False, reason=problem)
        return SetParametersResult(successful=True)

    def apply(parameters: Sequence[Parameter]) -> None:
        """Send each new value to its Crazyflie; a parameter of `all` is set for each connected robot that has it."""
        for parameter in parameters:
            target, _, name = parameter.name.partition(PARAMS)
            if target == ALL:
                robots = [r for r, v in vehicles.items() if v.link.can_set and name in elements[r]]
                node.set_parameters([Parameter(f"{r}{PARAMS}{name}", value=parameter.value) for r in robots])
            elif name in elements.get(target, {}):
                vehicles[target].link.set_parameter(name, parameter.value)
                if name == GROUPS:
                    masks[target] = int(parameter.value)
                log("info", f"parameter {parameter.name} = {parameter.value:g}")

    for robot, vehicle in vehicles.items():
        declare(f"robots.{robot}.uri", vehicle.robot.uri, read_only=True)
        declare(f"robots.{robot}.initial_position", list(vehicle.robot.initial_position), read_only=True)
        found = vehicle.link.parameters()
        elements[robot] = {name: element for name, (element, _) in found.items()}
        elements[ALL] |= elements[robot]
        for name, (element, value) in found.items():
            for target in (robot, ALL):
                declare(f"{target}{PARAMS}{name}", value, read_only=element.access == element.RO_ACCESS)
    node.add_on_set_parameters_callback(check)
    node.add_post_set_parameters_callback(apply)
