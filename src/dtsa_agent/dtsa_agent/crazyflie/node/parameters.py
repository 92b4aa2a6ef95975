"""The firmware's parameters as parameters of the node: `cf1.params.ring.effect`, for all `all.params.ring.effect`."""

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
    kind: str  # the C type
    read_only: bool
    value: float  # an int where the type is one

    def problem(self, value: object) -> str:
        """Why it cannot have a value; empty if it can."""
        if self.read_only:
            return f"{self.name} is read-only"
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            return f"{self.name}: {value!r} is not a number"
        if self.kind in FLOATS:
            return ""
        bits = int("".join(filter(str.isdigit, self.kind)))
        low, high = (0, 2**bits - 1) if self.kind.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        if value != int(value) or not low <= value <= high:
            return f"{self.name}: {value!r} is not a whole number from {low} to {high}"
        return ""


def read_parameters(link: CrazyflieLink) -> dict[str, FirmwareParameter]:
    """Return all parameters of a Crazyflie by their names, as far as they were read."""
    cf = link.crazyflie
    if cf is None:
        return {}
    parameters = {}
    for group, elements in dict(cf.param.toc.toc).items():
        for name, element in dict(elements).items():
            text = cf.param.values.get(group, {}).get(name)
            if text is None:
                continue
            full = f"{group}.{name}"
            value = link.robot.firmware_params.get(full)  # was set a moment ago
            if value is None:
                value = float(text) if element.ctype in FLOATS else int(text)
            parameters[full] = FirmwareParameter(full, element.ctype, element.access == element.RO_ACCESS, value)
    return parameters


class FirmwareParameters:
    """Parameters of the node that are those of the connected Crazyflies.

    :param log: called with a level and a line about each that is set.
    :param masks: the groups of each robot by its name; changed with the firmware's own.
    """

    def __init__(self, node: Node, bridge: Bridge, log: Callable[[str, str], None], masks: dict[str, int]) -> None:
        self._node, self._bridge, self._log, self._masks = node, bridge, log, masks
        self._known: dict[str, dict[str, FirmwareParameter]] = {}

    def declare(self) -> None:
        """Declare all: addresses and places of the robots, and what the connected ones have."""
        common: dict[str, FirmwareParameter] = {}
        for name, vehicle in self._bridge.vehicles.items():
            self._declare(f"robots.{name}.uri", vehicle.robot.uri, read_only=True)
            self._declare(f"robots.{name}.initial_position", list(vehicle.robot.initial_position), read_only=True)
            self._known[name] = read_parameters(vehicle.link)
            for parameter in self._known[name].values():
                self._declare(f"{name}{PARAMS}{parameter.name}", parameter.value, read_only=parameter.read_only)
            common = self._known[name] | common
        for parameter in common.values():
            self._declare(f"{ALL}{PARAMS}{parameter.name}", parameter.value, read_only=parameter.read_only)
        self._node.add_on_set_parameters_callback(self._check)
        self._node.add_post_set_parameters_callback(self._apply)

    def _declare(self, name: str, value: Any, *, read_only: bool) -> None:
        self._node.declare_parameter(name, value, ParameterDescriptor(read_only=read_only), ignore_override=True)

    def _check(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Whether all can be set."""
        for given in parameters:
            owner, separator, name = given.name.partition(PARAMS)
            for robot in self._owners(owner, name) if separator else ():
                problem = self._known[robot][name].problem(given.value)
                if owner != ALL and not self._bridge.vehicles[robot].link.can_set:
                    problem = f"{robot} is not connected, or its parameters are being read"
                if problem:
                    self._log("warn", f"parameter {given.name}: {problem}")
                    return SetParametersResult(successful=False, reason=problem)
        return SetParametersResult(successful=True)

    def _owners(self, owner: str, name: str) -> list[str]:
        """The robots that a parameter belongs to."""
        robots = list(self._known) if owner == ALL else [owner]
        return [robot for robot in robots if name in self._known.get(robot, {})]

    def _apply(self, parameters: Sequence[Parameter]) -> None:
        """Send what was set; for all: set it for each of them."""
        for given in parameters:
            owner, separator, name = given.name.partition(PARAMS)
            if not separator:
                continue
            if owner == ALL:
                robots = [r for r in self._owners(owner, name) if self._bridge.vehicles[r].link.can_set]
                self._node.set_parameters([Parameter(f"{r}{PARAMS}{name}", value=given.value) for r in robots])
                continue
            self._bridge.vehicles[owner].link.set_parameter(name, given.value)
            if name == GROUPS:
                self._masks[owner] = int(given.value)
            self._log("info", f"parameter {given.name} = {given.value:g}")
