"""Settings that describe themselves: for validation, ROS parameters and the command line."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from dtsa_agent.core.errors import ConfigError

#: What a setting holds. ``text`` values have a one-line notation; ``structure`` values come from YAML only.
KINDS = ("int", "float", "bool", "text", "structure")


@dataclass(frozen=True, slots=True)
class FieldInfo:
    """One setting: enough to declare a ROS parameter or a command-line option from it.

    :param name: name of the dataclass field.
    :param kind: one of :data:`KINDS`.
    :param default: value used when nothing is given; None when the setting is required.
    :param help: one sentence for the user.
    :param unit: unit of the number, empty when it has none.
    :param minimum: smallest allowed number, or None.
    :param maximum: largest allowed number, or None.
    :param choices: allowed values, empty when any value of the range is.
    :param changeable: True when the setting may change while the channel runs.
    """

    name: str
    kind: str
    default: Any
    help: str
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[Any, ...] = ()
    changeable: bool = False

    @property
    def allowed(self) -> str:
        """What may be given, in words."""
        if self.choices:
            return ", ".join(str(choice) for choice in self.choices)
        name = {"int": "a whole number", "float": "a number", "bool": "true or false"}.get(self.kind, self.help)
        if self.minimum is not None and self.maximum is not None:
            name += f" from {self.minimum:g} to {self.maximum:g}"
        elif self.minimum is not None:
            name += f" of {self.minimum:g} or more"
        elif self.maximum is not None:
            name += f" of {self.maximum:g} or less"
        return f"{name} ({self.unit})" if self.unit else name


def option(
    default: Any = dataclasses.MISSING,
    *,
    kind: str,
    help: str,
    unit: str = "",
    minimum: float | None = None,
    maximum: float | None = None,
    choices: Sequence[Any] = (),
    changeable: bool = False,
) -> Any:
    """Declare a dataclass field with its description.

    The keyword arguments are those of :class:`FieldInfo`; they end up in the field's ``metadata``.
    """
    metadata = {
        "kind": kind,
        "help": help,
        "unit": unit,
        "minimum": minimum,
        "maximum": maximum,
        "choices": tuple(choices),
        "changeable": changeable,
    }
    return dataclasses.field(default=default, metadata=metadata)


def fields_of(cls: type) -> tuple[FieldInfo, ...]:
    """Return the descriptions of all settings of a configuration class, in the order of its fields.

    :param cls: a dataclass whose fields were made with :func:`option`.
    """
    return tuple(
        FieldInfo(
            name=field.name,
            default=None if field.default is dataclasses.MISSING else field.default,
            **field.metadata,
        )
        for field in dataclasses.fields(cls)
        if field.metadata
    )


def checked(info: FieldInfo, value: object, name: str | None = None) -> Any:
    """Return a number or flag converted to the setting's type, if it is allowed.

    :param info: the setting.
    :param value: what the user gave; NumPy scalars are welcome, True is not a number.
    :param name: how the user calls the setting, if not by its own name.
    :raises ConfigError: when the value has the wrong type or is out of range.
    """
    name = name or info.name
    if hasattr(value, "item") and getattr(value, "ndim", None) == 0:
        value = value.item()
    result: Any
    if info.kind == "bool":
        if not isinstance(value, bool):
            raise ConfigError(name, value, info.allowed)
        return value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(name, value, info.allowed)
    if info.kind == "int":
        if isinstance(value, float) and not value.is_integer():
            raise ConfigError(name, value, info.allowed)
        result = int(value)
    else:
        result = float(value)
        if not math.isfinite(result):
            raise ConfigError(name, value, info.allowed)
    if (info.minimum is not None and result < info.minimum) or (info.maximum is not None and result > info.maximum):
        raise ConfigError(name, value, info.allowed)
    if info.choices and result not in info.choices:
        raise ConfigError(name, value, info.allowed)
    return result
