"""The firmware's parameters of a connected Crazyflie."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from typing import Any

from dtsa_agent.crazyflie.link import Link

FLOATS = frozenset({"float", "FP16", "double"})


@dataclass(frozen=True, slots=True)
class Parameter:
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


class Onboard:
    """Parameters of one Crazyflie."""

    def __init__(self, link: Link) -> None:
        self._link = link

    def parameters(self) -> dict[str, Parameter]:
        """All parameters by their names, as far as they were read."""
        cf = self._link.crazyflie
        if cf is None:
            return {}
        found = {}
        for group, elements in dict(cf.param.toc.toc).items():
            for name, element in dict(elements).items():
                text = cf.param.values.get(group, {}).get(name)
                if text is None:
                    continue
                full = f"{group}.{name}"
                value = self._link.robot.firmware_params.get(full)  # was set a moment ago
                if value is None:
                    value = float(text) if element.ctype in FLOATS else int(text)
                found[full] = Parameter(full, element.ctype, element.access == element.RO_ACCESS, value)
        return found

    @property
    def settable(self) -> bool:
        """Whether parameters can be set now: it is connected, and its values are known."""
        cf = self._link.crazyflie
        return cf is not None and bool(cf.param.is_updated)

    def set_parameter(self, name: str, value: float) -> None:
        """Set a parameter that exists to a value that it can have; does not wait."""

        def send(cf: Any) -> None:
            parameters = cf.param
            if parameters.is_updated:  # else cflib would keep this thread waiting
                with contextlib.suppress(KeyError, AttributeError):  # the link has just ended
                    parameters.set_value(name, value)

        self._link.order(send)
